"""The visual gap: how a policy acts on the cell's pictures, and on the twin's of the same states.

A policy that acts otherwise because it sees something else is no judge of the twin's physics. The
yardstick is the policy itself: how much its answer changes from one recorded picture to the next,
and when it is asked the same thing twice. States are the same until the fingers first close: what
they have touched may then lie elsewhere than the twin draws it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from twin.policies.errors import PolicyError
from twin.policies.mapping import Interpreter
from twin.policies.policy import Policy
from twin.policies.views import Gains, Pictures, lit
from twin.robot.posture import Posture
from twin.scene.movable_scene import Frame
from twin.scene.raster.backend import open_rasteriser
from twin.scene.standpoint import poses_in_scene
from twin.scene.store.folder import read_scene
from twin.scene.trial import open_trial

INSTANTS, CLOSES_M = 12, 0.001
"""So many states of a trial are looked at; fingers that close by less have touched nothing."""


@dataclass(frozen=True, kw_only=True)
class State:
    """One recorded instant, and the picture that came next."""

    posture: Posture
    recorded: Pictures
    following: Pictures
    rendered: Pictures


def visual_gap(
    run: RunFolder,
    episode: Episode,
    policy: Policy,
    speak: Interpreter,
    seed: int,
    gains: Gains,
) -> dict[str, Any]:
    """Ask a policy about recorded states, in pictures of the cell and of the twin.

    Returns:
        Root mean squares over an answer's numbers, the gripper's left out, and over instants:
        ``rendered`` pictures instead of recorded ones (all, and of each camera alone; ``lit``: all
        of them in the light of other trials), the ``following`` picture, and the same one
        ``again``; empty where nothing was recorded.
    """
    names = speak.cameras() or tuple(streams.camera_ids(episode))
    states = list(recorded_states(run, episode, names, INSTANTS))
    if not states:
        return {}

    def answer(pictures: Pictures, posture: Posture) -> Float[np.ndarray, "num_rows num_values"]:
        policy.reset(seed)
        told = speak.observation(pictures, posture.joints_rad, posture.width_m)
        rows = speak.rows(policy.infer(told))[: speak.mapping.horizon or None]
        return rows[:, : speak.num_values() - (speak.mapping.actions.gripper != "none")]

    squares: dict[str, list[float]] = {}
    for state in states:
        first = answer(state.recorded, state.posture)
        others = {"again": state.recorded, "following": state.following, "all": state.rendered}
        others |= {"lit": lit(state.rendered, gains)} if gains else {}
        others |= {name: {**state.recorded, name: state.rendered[name]} for name in names}
        for what, pictures in others.items():
            rows = answer(pictures, state.posture)
            if rows.shape != first.shape:
                shapes = f"{first.shape} and {rows.shape}"
                raise PolicyError(f"the policy's answers differ in length: {shapes}")
            squares.setdefault(what, []).append(float(np.mean((rows - first) ** 2)))
    found = {what: float(np.sqrt(np.mean(values))) for what, values in squares.items()}
    return {
        "episode": episode.info.id,
        "instants": len(states),
        "again": found.pop("again"),
        "following": found.pop("following"),
        "rendered": found,
    }


def recorded_states(
    run: RunFolder, episode: Episode, names: Sequence[str], instants: int
) -> Iterator[State]:
    """Instants of a trial until its fingers close, as cameras saw them and as the twin draws."""
    scene = read_scene(run)
    trial = open_trial(run, scene, episode)
    pictures = {name: list(streams.color_images(episode, name)) for name in names}
    if trial.postures is None or not all(len(items) > 1 for items in pictures.values()):
        return
    seen = [t.stamp_ns for t in pictures[names[0]][:-1] if trial.postures.covers(t.stamp_ns)]
    widths_m = np.array([trial.postures.at(t).width_m for t in seen])
    seen = seen[: int((np.maximum.accumulate(widths_m) - widths_m < CLOSES_M).cumprod().sum())]
    if not seen:
        return
    chosen = np.unique(np.linspace(0, len(seen) - 1, instants).round().astype(int))
    cameras = {name: streams.camera_info(episode, name) for name in names}
    rasteriser = open_rasteriser()
    stamps = np.array([seen[k] for k in chosen], dtype=np.int64)
    trees = {name: poses_in_scene(run, scene, episode, name, stamps) for name in names}
    for stamp_ns in stamps.tolist():
        places, posture = trial.places(stamp_ns), trial.postures.at(stamp_ns)
        frames = {
            name: Frame(
                stamp_ns=stamp_ns,
                T_base_camera=tree.T_root_frame(cameras[name].frame_id, stamp_ns),
                Ts_base_object=places,
                posture=posture,
                urdf=trial.postures.urdf,
            )
            for name, tree in trees.items()
        }
        near = {
            name: min(range(len(items) - 1), key=lambda k: abs(items[k].stamp_ns - stamp_ns))
            for name, items in pictures.items()
        }
        yield State(
            posture=posture,
            recorded={name: pictures[name][k].image_u8() for name, k in near.items()},
            following={name: pictures[name][k + 1].image_u8() for name, k in near.items()},
            rendered={
                name: trial.parts.drawn_as(rasteriser, cameras[name].camera, frame).image_u8
                for name, frame in frames.items()
            },
        )


def describe_gap(gap: Mapping[str, Any]) -> list[str]:
    """What the twin's pictures change, beside what the cell's own do."""
    if not gap:
        return ["visual gap: not measured, the trial has no pictures and joints of its motion"]
    rendered, step = gap["rendered"], max(gap["following"], gap["again"])
    if not max(step, rendered["all"]):
        return ["visual gap: not measured, the policy's first answer is the same whatever it sees"]
    times = f", {rendered['all'] / step:.1f} x as much" if step > 0 else ""
    other = {name: value for name, value in rendered.items() if name not in ("all", "lit")}
    alone = ", ".join(f"{name} {value:.3g}" for name, value in other.items())
    if "lit" in rendered:
        alone += f"; in the light of other trials {rendered['lit']:.3g}"
    return [
        f"visual gap, until the fingers close: the twin's pictures of {gap['instants']} states of "
        f"{gap['episode']} change its actions by {rendered['all']:.3g} (rms; {alone}); the next "
        f"recorded picture does by {gap['following']:.3g}, asking again by {gap['again']:.3g}"
        f"{times}"
    ]
