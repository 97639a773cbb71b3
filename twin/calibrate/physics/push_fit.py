"""Friction of imported pushes, identified on every other run and scored on those between.

What is fitted is searched for on a grid, all of it: the angle of the fingers, which nobody
recorded, and the two frictions. Of the runs of a task in the order of their numbers the first,
third, fifth ... identify, the others are held out. docs/real_number.md gives the reasons.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import provenance
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.process_pool import Failed, Runner, runner_of
from bridge.terminal import Output
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics.pushes import Push, UnusablePushError, motion_of, read_push, replay_push
from twin.physics.config import PhysicsConfig
from twin.physics.engine import ENGINE_VERSION
from twin.robot.hand import Hand
from twin.scene.store.calibration import write_physics

FINGER_FRICTION = "finger_pair_friction"
SURFACE_FRICTION = "surface_pair_friction"
FINGERS_RAD = np.linspace(0.0, 0.25, 6)
SURFACE = np.geomspace(0.05, 1.6, 9)
"""Effective friction of box on table."""
HAND = np.geomspace(0.1, 1.6, 7)
"""Effective friction of hand on box."""
RESAMPLES = 2000
FEWEST = 3
"""Identifying runs from which an interval can be given."""
LOG_95 = 2 * 1.96


_hand = lru_cache(maxsize=4)(Hand)


@lru_cache(maxsize=32)
def load_push(run_path: Path, episode_id: str) -> Push | None:
    """Read an imported recording once per process; None for any other episode."""
    run = RunFolder.open(run_path)
    episode = Episode.open(run.episodes_dir / f"{episode_id}.mcap")
    motion = motion_of(episode)
    if motion is None:
        return None
    hand = _hand(run.path / motion.robot, motion.joints, motion.hand_link)
    return read_push(run, episode, motion, hand)


def frictions(surface: float, hand: float, config: PhysicsConfig) -> PhysicsConfig:
    """Set effective frictions; the engine multiplies both partners'."""
    own = config.object_friction
    return replace(config, surface_friction=surface / own, finger_friction=hand / own)


def end_point_error_m(push: Push, config: PhysicsConfig, finger_rad: float) -> float:
    """Distance of recorded and replayed end of the box."""
    result = replay_push(push, "executed", config, finger_rad)
    if result.Ts_world_box is None or push.box_track is None:
        raise UnusablePushError(f"{push.episode} has no box.")
    return float(np.linalg.norm(result.Ts_world_box[-1, :3, 3] - push.box_track.p_m[-1]))


Item = tuple[Path, str, float, float]
"""Run folder, recording, angle of the fingers and friction of the table of a row of the grid."""


def errors_of(item: Item) -> list[float]:
    """End point errors [m], one for each friction of the hand."""
    run_path, episode, finger_rad, surface = item
    push = load_push(run_path, episode)
    if push is None:
        raise UnusablePushError(f"{episode} is not an imported push.")
    configs = [frictions(surface, hand, PhysicsConfig()) for hand in HAND.tolist()]
    return [end_point_error_m(push, config, finger_rad) for config in configs]


def split(episodes: Sequence[str]) -> tuple[list[str], list[str]]:
    """Identifying runs (first, third, fifth ... in name order) and held-out ones (the others)."""
    ordered = sorted(episodes)
    return ordered[::2], ordered[1::2]


Grid = Float[np.ndarray, "num_runs num_fingers num_surface num_hand"]


def least(grid: Grid, runs: Sequence[int]) -> tuple[int, int, int]:
    """Indices of the point with the least mean squared error over some runs."""
    cost = (grid[list(runs)] ** 2).mean(axis=0)
    a, b, c = np.unravel_index(int(cost.argmin()), cost.shape)
    return int(a), int(b), int(c)


def resampled(grid: Grid) -> np.ndarray:
    """Points found again on resamples of the runs: ``RESAMPLES`` rows of three indices."""
    rng = np.random.default_rng(0)
    draws = rng.integers(0, len(grid), size=(RESAMPLES, len(grid)))
    return np.array([least(grid, draw.tolist()) for draw in draws])


def calibrate_pushes(
    run: RunFolder, config: CalibrateConfig, output: Output
) -> tuple[Mapping[str, Any], str]:
    """Identify friction on half of a run's pushes, score it on the others, write the calibration.

    Returns:
        The physics record, and the id of the calibration that holds now.
    """
    pushes, skipped = _pushes(run)
    fitted, held_out = split(list(pushes))
    if len(fitted) < FEWEST or not held_out:
        raise UnusablePushError(
            f"{len(pushes)} pushes in {run.path}; at least {2 * FEWEST} are needed. Trials of a "
            "cell teach through --posterior."
        )
    output.say(f"{len(pushes)} pushes: {len(fitted)} identify, {len(held_out)} are held out")
    with runner_of(config.workers) as runner:
        grid = _simulate(run, fitted, runner, output)
    best = least(grid, range(len(fitted)))
    rubs = frictions(float(SURFACE[best[1]]), float(HAND[best[2]]), PhysicsConfig())
    scores = {
        "nominal": _score(pushes, held_out, PhysicsConfig(), 0.0),
        "calibrated": _score(pushes, held_out, rubs, float(FINGERS_RAD[best[0]])),
    }
    record = _record(best, resampled(grid), scores)
    record |= {
        "fitted_to": fitted,
        "held_out": {"episodes": held_out, **scores},
        "sources": {name: {"kind": "push", "sha256": pushes[name].sha256} for name in pushes},
        "skipped": skipped,
    }
    record["id"] = provenance.hash_settings(record)
    return record, str(write_physics(run, record)["calibration_id"])


def recordings(run: RunFolder) -> tuple[list[Push], dict[str, str]]:
    """Imported recordings with a script, in name order, and why others cannot be replayed."""
    found: list[Push] = []
    skipped: dict[str, str] = {}
    for path in run.episodes():
        try:
            push = load_push(run.path.resolve(), path.stem)
        except GstError as error:
            skipped[path.stem] = str(error)
            continue
        found += [] if push is None else [push]
    return found, skipped


def _pushes(run: RunFolder) -> tuple[dict[str, Push], dict[str, str]]:
    every, skipped = recordings(run)
    found = {push.episode: push for push in every if push.T_world_box is not None}
    tasks = sorted({push.task for push in found.values()})
    if len(tasks) > 1:
        raise UnusablePushError(
            f"pushes of several tasks in {run.path}: {', '.join(tasks)}; calibrate them apart."
        )
    return found, skipped


def _simulate(run: RunFolder, fitted: Sequence[str], runner: Runner, output: Output) -> Grid:
    there = run.path.resolve()
    items = [(there, *point) for point in product(fitted, FINGERS_RAD.tolist(), SURFACE.tolist())]
    errors: dict[Item, list[float]] = {}
    with output.progress("physics", len(items)) as advance:
        answers = runner.run(errors_of, items, lambda _: 1.0)
        for done, (item, answer) in enumerate(answers, start=1):
            if isinstance(answer, Failed):
                raise UnusablePushError(answer.message)
            errors[item] = answer
            advance(done, item[1])
    shape = (len(fitted), len(FINGERS_RAD), len(SURFACE), len(HAND))
    return np.array([errors[item] for item in items]).reshape(shape)


def _score(
    pushes: Mapping[str, Push], names: Sequence[str], config: PhysicsConfig, finger_rad: float
) -> dict[str, Any]:
    errors = {name: end_point_error_m(pushes[name], config, finger_rad) for name in names}
    return {
        "n": len(errors),
        "end_point_error_median_m": float(np.median(list(errors.values()))),
        "by_episode_m": errors,
    }


def _record(
    best: tuple[int, int, int], again: np.ndarray, scores: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    nominal, found = (scores[key]["end_point_error_median_m"] for key in ("nominal", "calibrated"))
    promoted, own = bool(found < nominal), PhysicsConfig().object_friction
    parameters, identified = {}, {}
    rows = (
        ("finger_rad", FINGERS_RAD, "rad", None),
        (SURFACE_FRICTION, SURFACE, "1", "surface_friction"),
        (FINGER_FRICTION, HAND, "1", "finger_friction"),
    )
    for index, (name, values, unit, field) in enumerate(rows):
        low, high = np.quantile(values[again[:, index]], [0.025, 0.975], method="nearest")
        whole = bool(low == values[0] and high == values[-1])
        parameters[name] = {
            "unit": unit,
            "value": float(values[best[index]]),
            "low": float(low),
            "high": float(high),
            "identified": not whole,
            "why": "every value tried fits as well" if whole else "resampled identifying runs",
        }
        if field is not None and promoted:
            spread = max(float(np.log(high / low)), float(np.log(values[1] / values[0]))) / LOG_95
            identified[field] = {
                "value": float(values[best[index]]) / own,
                "low": float(low) / own,
                "high": float(high) / own,
                "sigma_log": spread,
            }
    words = "nearer" if promoted else "no nearer"
    return {
        "promoted": promoted,
        "why": f"held-out end points are {words} than at nominal friction",
        "engine": ENGINE_VERSION,
        "identified": identified,
        "parameters": parameters,
    }


def describe_pushes(record: Mapping[str, Any], calibration_id: str) -> str:
    """Say in a line per parameter what was found, and how far off held-out boxes end."""
    lines = [f"physics: {record['why']}; calibration {calibration_id}, {record['engine']}"]
    for name, item in record["parameters"].items():
        word = "identified" if item["identified"] else "not identified"
        lines.append(
            f"  {name:<22} {item['value']:>8.4g} [{item['low']:.4g}, {item['high']:.4g}] "
            f"{item['unit']:<3} {word}: {item['why']}"
        )
    held = record["held_out"]
    for name in ("nominal", "calibrated"):
        off_m, errors = held[name]["end_point_error_median_m"], held[name]["by_episode_m"].values()
        lines.append(
            f"  held out, {name}: end points off by {off_m * 1e3:.1f} mm "
            f"(median of {len(errors)}; {min(errors) * 1e3:.1f} to {max(errors) * 1e3:.1f})"
        )
    lines += [f"  {name}: {why}" for name, why in record["skipped"].items()]
    return "\n".join(lines)
