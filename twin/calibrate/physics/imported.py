"""Replays of imported recordings that have poses and a script, and neither joints nor a plan.

``planned`` follows the joint schedule the arm was given, ``executed`` the measured tool. There is
no plan and so no verdict: what comes out is an episode that ``evaluate`` lays over the recording.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bridge.episode import schema
from bridge.episode.cdr.batch import pose_messages
from bridge.episode.metadata import Derived
from bridge.episode.provenance import hash_settings
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import TCP_POSE, cell_topic, object_topic
from bridge.episode.writer import EpisodeWriter
from bridge.errors import GstError
from bridge.process_pool import Failed
from bridge.terminal import Output
from twin.calibrate.motion import Motion
from twin.calibrate.physics.arm_motion import PART, motion_for
from twin.calibrate.physics.push_fit import load_push
from twin.calibrate.physics.pushes import Push, PushResult, Trajectory, motion_of, replay_push
from twin.physics.config import PhysicsConfig
from twin.physics.engine import ENGINE_VERSION
from twin.replay.config import ReplayConfig, ReplayRunConfig
from twin.replay.rebuilt_scene import calibrated
from twin.replay.runner import chosen_episodes, runner_for
from twin.scene.store.calibration import read_calibration

ENGINE = "twin-pybullet"
"""Beside simulators of others, which may have used PyBullet too."""
MOTION_REPLAY_VERSION = 1
FRAME = "world"


@dataclass(frozen=True, kw_only=True)
class MotionReplay:
    """One recording along one trajectory."""

    run_path: Path
    episode_id: str
    trajectory: Trajectory
    physics: PhysicsConfig
    finger_rad: float
    fitted_to: tuple[str, ...]
    """Recordings from which friction or the arm's motion was identified."""
    calibration_id: str | None
    motion: Motion | None = None
    """Of the arm that follows the schedule, where held-out recordings confirmed it."""
    force: bool = False

    def settings(self) -> dict[str, Any]:
        """What decides the result; part of the episode's provenance."""
        return {
            "version": MOTION_REPLAY_VERSION,
            "engine_version": ENGINE_VERSION,
            "physics": asdict(self.physics),
            "finger_rad": self.finger_rad,
            "fitted_to": list(self.fitted_to),
            "motion": None if self.motion is None else self.motion.to_record(),
        }

    def needed_paths(self) -> tuple[Path, ...]:
        """What a process on another machine must see."""
        return (self.run_path,)

    def path(self, sha256: str) -> Path:
        """Of the derived episode."""
        key = hash_settings({**self.settings(), "source": sha256, "id": self.calibration_id})
        name = f"{self.episode_id}.replay.{self.trajectory}.dynamic.{ENGINE}.{key}.mcap"
        return RunFolder(self.run_path).derived_dir / name


def motion_replays(
    run: RunFolder, names: list[str], config: ReplayConfig, *, force: bool
) -> tuple[list[MotionReplay], dict[str, str]]:
    """List what can be replayed of imported recordings, and why others cannot."""
    calibration = read_calibration(run)
    known_parts = {} if calibration is None else calibration.record
    arm, fit = known_parts.get(PART) or {}, known_parts.get("physics") or {}
    fit = fit if fit.get("promoted") else {}
    with_boxes = calibrated(config, calibration, None).physics
    items: list[MotionReplay] = []
    skipped: dict[str, str] = {}
    for name in names:
        try:
            episode = Episode.open(run.episodes_dir / f"{name}.mcap")
            motion = motion_of(episode)
        except GstError as error:
            skipped[name] = str(error)
            continue
        if motion is None:
            continue
        used = fit if motion.boxes else {}  # a tool alone meets no friction
        angle = used.get("parameters", {}).get("finger_rad", {}).get("value", 0.0)
        moved = motion_for(arm, episode.info.task)
        trajectories: dict[Trajectory, Motion | None] = {"planned": moved, "executed": None}
        for trajectory, known in trajectories.items():
            if trajectory == "executed" and not motion.boxes:
                continue
            fitted = {*used.get("fitted_to", ()), *(arm["fitted_to"] if known else ())}
            items.append(
                MotionReplay(
                    run_path=run.path.resolve(),
                    episode_id=name,
                    trajectory=trajectory,
                    physics=with_boxes if motion.boxes else config.physics,
                    finger_rad=float(angle),
                    fitted_to=tuple(sorted(fitted)),
                    calibration_id=calibration.calibration_id if calibration and fitted else None,
                    motion=known,
                    force=force,
                )
            )
    return items, skipped


def run_motion_replay(item: MotionReplay) -> dict[str, Any]:
    """Replay, write the episode, and return its row."""
    push = load_push(item.run_path, item.episode_id)
    if push is None:  # the list was made of others
        raise GstError(f"{item.episode_id} is not an imported recording with a script.")
    path = item.path(push.sha256)
    kept = path.is_file() and not item.force
    if kept:
        path.touch()  # the newest replay of a trajectory is the one that counts
    else:
        result = replay_push(push, item.trajectory, item.physics, item.finger_rad, item.motion)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        _write(path, item, push, result)
    return {
        "episode": item.episode_id,
        "trajectory": item.trajectory,
        "path": str(path),
        "skipped": kept,
    }


def _write(path: Path, item: MotionReplay, push: Push, result: PushResult) -> None:
    episode = Episode.open(RunFolder(item.run_path).episodes_dir / f"{item.episode_id}.mcap")
    cell = episode.info.cell or "cell"
    derived = Derived(
        kind="replay",
        source_episode=item.episode_id,
        source_sha256=push.sha256,
        trajectory=item.trajectory,
        mode="dynamic",
        engine=ENGINE,
        calibration_id=item.calibration_id,
        settings=item.settings(),
    )
    tracks = {cell_topic(cell, TCP_POSE): result.Ts_world_tool}
    if result.Ts_world_box is not None:
        tracks[object_topic(cell, push.box, "pose")] = result.Ts_world_box
    with EpisodeWriter(path) as writer:
        writer.describe(episode.info, derived=derived)
        for topic, Ts in tracks.items():
            rows = pose_messages(result.stamps_ns, FRAME, Ts)
            for stamp_ns, data in zip(result.stamps_ns.tolist(), rows, strict=True):
                writer.write(topic, data, type_name=schema.POSE_STAMPED, log_time_ns=stamp_ns)


def replay_imported(
    run: RunFolder, config: ReplayRunConfig, output: Output
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Replay a run's recordings that have no plan; rows, and why others cannot be replayed."""
    names = chosen_episodes(run, config)
    items, skipped = motion_replays(run, names, config.replay, force=config.force)
    if not items:
        return [], skipped
    rows = []
    with runner_for(config) as runner, output.progress("imported", len(items)) as advance:
        for done, (item, answer) in enumerate(
            runner.run(run_motion_replay, items, lambda _: 1.0), start=1
        ):
            if isinstance(answer, Failed):
                skipped[item.episode_id] = answer.message
                output.detail(answer.trace)
            else:
                rows.append(answer)
            advance(done, f"{item.episode_id} {item.trajectory}")
    rows.sort(key=lambda row: (row["episode"], row["trajectory"]))
    return rows, skipped
