"""A run's trials as one LeRobotDataset v3.0, each on a grid of equal steps.

Row k is at ``t_0 + k / fps``. State: joints and gripper, interpolated at that time. Image: the one
nearest in time. Action: the plan's command for the next row, or the next row's state.
"""

import fnmatch
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.catalogue import outcome_of
from bridge.episode.cdr.messages import color_from_message
from bridge.episode.clocks import open_episode
from bridge.episode.metadata import ROLLOUT
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import (
    JointTrack,
    camera_ids,
    events,
    execution_ns,
    find_camera_topic,
    joint_track,
    lens_of,
    plans,
)
from bridge.episode.topics import COLOR_IMAGE, GRIPPER_STATE, RENDERED_IMAGE, RENDERED_TOPIC
from bridge.errors import EpisodeError, UsageError
from bridge.exchange.lerobot import layout
from bridge.exchange.lerobot.layout import LeRobotConfig
from bridge.exchange.lerobot.writer import DatasetShape, DatasetWriter
from bridge.exchange.output import message_named, new_folder, safe_names, write_note
from bridge.task.plan import Plan
from bridge.terminal import Advance

ActionKind = Literal["plan", "next_state"]
Sizes = dict[str, tuple[int, int]]
"""Height and width by camera."""
DEFAULT_FPS = 30
"""Rate of an episode without cameras."""


@dataclass(frozen=True, kw_only=True)
class Samples:
    """One episode on the grid."""

    names: tuple[str, ...]
    """Joints in the order of ``state`` and ``action``, the gripper last."""
    stamps_ns: Int[np.ndarray, " num_rows"]
    state: Float[np.ndarray, "num_rows num_joints"]
    command: Float[np.ndarray, "num_rows num_joints"] | None
    """What an executed plan commands for the next row; None where no plan says it all."""
    images: dict[str, Int[np.ndarray, " num_rows"]]
    """By camera: which of its images belongs to each row."""
    max_image_offset_ns: dict[str, int]

    def action(self, kind: ActionKind) -> Float[np.ndarray, "num_rows num_joints"]:
        """Return the actions; the last row of ``next_state`` repeats its own state."""
        if kind == "plan" and self.command is not None:
            return self.command
        return np.vstack([self.state[1:], self.state[-1:]])


def choose_fps(episode: Episode) -> int:
    """Return the rate of the first camera, to the nearest whole number per second."""
    for camera in _cameras(episode):
        stamps, _ = _image_stamps(episode, camera)
        if len(stamps) > 1:
            return max(1, round(NS_PER_S / float(np.median(np.diff(stamps)))))
    return DEFAULT_FPS


def sample(episode: Episode, fps: int) -> Samples:
    """Put an episode on the grid, over the time in which joints and all cameras are there."""
    tracks = [joint_track(episode)]
    if any(topic.endswith(GRIPPER_STATE) for topic in episode.topics_of_type(schema.JOINT_STATE)):
        tracks.append(joint_track(episode, GRIPPER_STATE))
    cameras = {camera: _image_stamps(episode, camera) for camera in _cameras(episode)}
    spans = [track.stamps_ns for track in tracks] + [stamps for stamps, _ in cameras.values()]
    if any(not len(span) for span in spans):
        empty = [camera for camera, (stamps, _) in cameras.items() if not len(stamps)]
        raise EpisodeError(
            path=episode.path, found=f"camera {empty[0]} has no images", hint="Leave it out."
        )
    start_ns = max(int(span[0]) for span in spans)
    # The last image also serves a row half a step later; joints are never extended.
    reach_ns = [0] * len(tracks) + [NS_PER_S // (2 * fps)] * len(cameras)
    end_ns = min(int(span[-1]) + reach for span, reach in zip(spans, reach_ns, strict=True))
    if end_ns < start_ns:
        raise EpisodeError(
            path=episode.path,
            found="joints and cameras were never recorded at the same time",
            hint="robot-gst info shows what it holds.",
        )
    num_rows = (end_ns - start_ns) * fps // NS_PER_S + 1
    stamps_ns = start_ns + np.arange(num_rows, dtype=np.int64) * NS_PER_S // fps
    images, offsets = {}, {}
    for camera, (stamps, numbers) in cameras.items():
        nearest = _nearest(stamps, stamps_ns)
        images[camera] = numbers[nearest]
        offsets[camera] = int(np.abs(stamps[nearest] - stamps_ns).max())
    names = tuple(name for track in tracks for name in track.names)
    return Samples(
        names=names,
        stamps_ns=stamps_ns,
        state=np.hstack([_at(track, stamps_ns) for track in tracks]),
        command=_commands(episode, tracks, stamps_ns + NS_PER_S // fps),
        images=images,
        max_image_offset_ns=offsets,
    )


def _at(
    track: JointTrack, stamps_ns: Int[np.ndarray, " num_rows"]
) -> Float[np.ndarray, "num_rows num_joints"]:
    """Interpolate; times since the first row, for 64-bit floats round today's stamps to 256 ns."""
    origin_ns = stamps_ns[0]
    near = replace(track, stamps_ns=track.stamps_ns - origin_ns)
    return near.at(stamps_ns - origin_ns)


def row_images(
    episode: Episode, camera: str, wanted: Int[np.ndarray, " num_rows"]
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield the decoded image of each row; ``wanted`` never decreases."""
    row, lens = 0, lens_of(episode, camera)
    for number, message in enumerate(episode.messages([_topic(episode, camera)])):
        if row == len(wanted):
            return
        if number != wanted[row]:
            continue
        with message_named(episode, message.topic, number + 1):
            image_u8 = color_from_message(message.type_name, message.data, lens).image_u8()
        while row < len(wanted) and number == wanted[row]:
            yield image_u8
            row += 1


def _cameras(episode: Episode) -> list[str]:
    """Those that recorded; of what happened in the twin those through which it was seen."""
    found = (RENDERED_TOPIC.search(topic) for topic in episode.topics())
    return camera_ids(episode) or sorted({match[1] for match in found if match is not None})


def _topic(episode: Episode, camera: str) -> str:
    tails = (COLOR_IMAGE[1:], RENDERED_IMAGE[1:])
    topics = (find_camera_topic(episode, camera, tail) for tail in tails)
    return next(topic for topic in topics if topic is not None)


def _image_stamps(
    episode: Episode, camera: str
) -> tuple[Int[np.ndarray, " num_images"], Int[np.ndarray, " num_images"]]:
    """Stamps of a camera's images and their place in the file; those out of order left out."""
    stamps: list[int] = []
    numbers: list[int] = []
    for number, message in enumerate(episode.messages([_topic(episode, camera)])):
        with message_named(episode, message.topic, number + 1):
            stamp_ns = color_from_message(message.type_name, message.data).stamp_ns
        if not stamps or stamp_ns > stamps[-1]:
            stamps.append(stamp_ns)
            numbers.append(number)
    return np.array(stamps, dtype=np.int64), np.array(numbers, dtype=np.int64)


def _nearest(
    stamps: Int[np.ndarray, " num_images"], wanted: Int[np.ndarray, " num_rows"]
) -> Int[np.ndarray, " num_rows"]:
    after = np.clip(np.searchsorted(stamps, wanted), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(wanted - stamps[before]) <= np.abs(stamps[after] - wanted)
    return np.where(earlier, before, after)


def _commands(
    episode: Episode, tracks: list[JointTrack], times_ns: Int[np.ndarray, " num_rows"]
) -> Float[np.ndarray, "num_rows num_joints"] | None:
    """What the plan in force commands at each time; None where one of them does not say it all."""
    if episode.derived is not None:
        return None  # its plan tells what happened, not what was commanded
    records = events(episode)
    executed: list[tuple[int, Plan]] = []
    for _, plan in plans(episode):
        start_ns, _ = execution_ns(records, plan.id)
        if start_ns is not None:
            executed.append((start_ns, plan))
    if not executed:
        return None
    executed.sort(key=lambda item: item[0])
    starts = np.array([start_ns for start_ns, _ in executed], dtype=np.int64)
    in_force = np.maximum(np.searchsorted(starts, times_ns, side="right") - 1, 0)
    commands = np.zeros((len(times_ns), sum(len(track.names) for track in tracks)))
    for number, (start_ns, plan) in enumerate(executed):
        mask = in_force == number
        columns = _plan_columns(plan, tracks, times_ns[mask] - start_ns)
        if columns is None:
            return None
        commands[mask] = columns
    return commands


def _plan_columns(
    plan: Plan, tracks: list[JointTrack], t_ns: Int[np.ndarray, " num_times"]
) -> Float[np.ndarray, "num_times num_joints"] | None:
    rows = [waypoint.joints_rad for waypoint in plan.tau]
    arm = tracks[0].names
    if not rows or any(row is None or len(row) != len(plan.joint_names) for row in rows):
        return None
    if not set(arm) <= set(plan.joint_names):
        return None
    waypoints_ns = plan.times_ns()
    joints = np.array(rows, dtype=np.float64)
    columns = [
        np.interp(t_ns, waypoints_ns, joints[:, plan.joint_names.index(name)]) for name in arm
    ]
    if len(tracks) > 1:
        widths = [waypoint.width_m for waypoint in plan.tau]
        if len(tracks[1].names) != 1 or any(width is None for width in widths):
            return None
        # A gripper command holds until the next one; it is not a ramp.
        held = np.clip(np.searchsorted(waypoints_ns, t_ns, side="right") - 1, 0, None)
        columns.append(np.array(widths, dtype=np.float64)[held])
    return np.stack(columns, axis=1)


_HEAD = """---
task_categories:
- robotics
tags:
- LeRobot
configs:
- config_name: default
  data_files: data/*/*.parquet
---

"""
_ACTIONS = {
    "plan": (
        "what the executed plan commands for the time of the next row (joints interpolated "
        "between waypoints, the gripper's width held until the next command)"
    ),
    "next_state": "the measured state of the next row; the last row repeats its own",
}


def card_text(shape: DatasetShape, kind: ActionKind, table: list[dict[str, Any]]) -> str:
    """Return the text; every choice that changes a number is in it."""
    cameras = ", ".join(shape.cameras) or "none"
    stand_in, in_twin = (sum(bool(row[k]) for row in table) for k in ("stand_in", "rollout"))
    origin = "Recorded from a real cell, as its episodes say."
    if stand_in:
        origin = (
            f"{stand_in} of {len(table)} episodes come from a stand-in cell (simulated), not from "
            "a real robot."
        )
    if in_twin:
        origin = f"{in_twin} of {len(table)} episodes were acted in the twin (simulated, rendered)."
    success = (
        f"`{layout.SUCCESS}` is true in the last row of an episode whose operator said success."
        if shape.labelled
        else f"No `{layout.SUCCESS}`: not every episode is labelled success or failure; "
        "the labels there are stand in `robot_gst_export.json`."
    )
    return (
        f"{_HEAD}# {len(table)} episodes in LeRobotDataset {layout.VERSION}\n\n"
        f"Written by robot-gst. {origin}\n\n"
        f"- Rows are 1/{shape.fps} s apart, from the first instant at which joints and all cameras "
        "were there; `robot_gst_export.json` has that instant of every episode [ns].\n"
        f"- `{layout.STATE}`: {', '.join(shape.names)} as measured, linearly interpolated at the "
        "row's time [rad; m for the gripper's width].\n"
        f"- `{layout.ACTION}`: {_ACTIONS[kind]}.\n"
        f"- Cameras: {cameras}. A row has the image nearest in time, re-encoded as H.264 "
        f"(crf {shape.crf}, lossy).\n"
        f"- `{layout.DONE}` is true in the last row. {success}\n"
        "- Left out: depth, plans, events, verdicts.\n"
        "- Image statistics look at every fourth pixel of both axes.\n"
    )


KINDS = ("trial", "imported")
"""What is exported unless episodes are named: scans and probes are no demonstrations."""


@dataclass(frozen=True, kw_only=True)
class ExportReport:
    """What was written."""

    episodes: int
    frames: int
    fps: int
    action: ActionKind
    labelled: bool
    left_out: tuple[str, ...]
    """Episodes of other kinds."""
    max_image_offset_ns: int


def select_episodes(source: Path, config: LeRobotConfig) -> tuple[list[Path], list[str]]:
    """Return the files to export and the ids left out because they are no demonstrations.

    Args:
        config: Its ``episodes``, where given, are taken whatever their kind.
    """
    if not source.is_dir():
        return [source], []
    files = {path.stem: path for path in RunFolder.open(source).episodes()}
    if config.episodes:
        files |= {path.stem: path for path in RunFolder(source).derived(f"*.{ROLLOUT}.*")}
        wanted = {name: fnmatch.filter(files, name) for name in config.episodes}
        absent = [name for name, found in wanted.items() if not found]
        if absent:
            message = (
                f"{source} has no episode {', '.join(absent)}. "
                f"There are: {', '.join(list(files)[:10]) or 'none'}."
            )
            raise UsageError(message)
        return [files[name] for name in dict.fromkeys(chain(*wanted.values()))], []
    kinds = {name: Episode.open(path).info.kind for name, path in files.items()}
    chosen = [files[name] for name, kind in kinds.items() if kind in KINDS]
    left_out = [name for name, kind in kinds.items() if kind not in KINDS]
    if not chosen:
        message = (
            f"{source} has no trial to export ({len(left_out)} episodes of other kinds). "
            "Name episodes with --episodes ID to export them all the same."
        )
        raise UsageError(message)
    return chosen, left_out


def export_lerobot(
    source: Path, out: Path, *, config: LeRobotConfig, force: bool, advance: Advance
) -> ExportReport:
    """Write the dataset.

    Args:
        advance: Told how many episodes are done; each counts twice, once for looking at it.
    """
    files, left_out = select_episodes(source, config)
    run = RunFolder(source) if source.is_dir() else None
    with new_folder(out, force=force) as folder:
        layout.parquet()  # says what is missing before the long look
        first = open_episode(files[0], clock=config.clock)
        fps = config.fps or choose_fps(first)
        success = [_success(run, Episode.open(path)) for path in files]
        kind, sizes = _look(files, fps, config, advance)
        cameras = safe_names(sizes)
        shape = DatasetShape(
            fps=fps,
            names=sample(first, fps).names,
            cameras={safe: sizes[camera] for camera, safe in cameras.items()},
            robot_type=first.info.robot or first.info.cell,
            labelled=None not in success,
            crf=config.crf,
        )
        writer = DatasetWriter(folder, shape)
        try:
            table = []
            for row in _add_all(writer, files, success, kind, cameras, shape, config):
                table.append(row)
                advance(len(files) + len(table), str(row["id"]))
            writer.close()
        except BaseException:
            writer.abandon()
            raise
        _write_about(folder, files, shape, kind, table)
    return ExportReport(
        episodes=len(files),
        frames=sum(row["frames"] for row in table),
        fps=fps,
        action=kind,
        labelled=shape.labelled,
        left_out=tuple(left_out),
        max_image_offset_ns=max(
            (offset for row in table for offset in row["max_image_offset_ns"].values()), default=0
        ),
    )


def _add_all(
    writer: DatasetWriter,
    files: Sequence[Path],
    success: Sequence[bool | None],
    kind: ActionKind,
    cameras: dict[str, str],
    shape: DatasetShape,
    config: LeRobotConfig,
) -> Iterator[dict[str, Any]]:
    """Write one episode after another; yields what there is to say of each."""
    for number, path in enumerate(files):
        episode = open_episode(path, clock=config.clock)
        samples = sample(episode, shape.fps)
        writer.add(
            task=_task(episode),
            state=samples.state,
            action=samples.action(kind),
            success=success[number],
            images={
                safe: _images(episode, camera, samples.images[camera], shape.cameras[safe])
                for camera, safe in cameras.items()
            },
        )
        yield _row(number, episode, samples, success[number])


def _look(
    files: Sequence[Path], fps: int, config: LeRobotConfig, advance: Advance
) -> tuple[ActionKind, Sizes]:
    """Check that all episodes agree before anything is written; decide what the actions are.

    Returns:
        The actions, and the sizes of images by camera.
    """
    names: tuple[str, ...] = ()
    sizes: Sizes = {}
    without_plan: list[Path] = []
    for number, path in enumerate(files):
        episode = open_episode(path, clock=config.clock)
        samples = sample(episode, fps)
        found = {camera: _size(episode, camera, samples) for camera in samples.images}
        if number == 0:
            names, sizes = samples.names, found
        if (samples.names, found) != (names, sizes):
            raise EpisodeError(
                path=path,
                found=f"joints {', '.join(samples.names)}, cameras {_words(found)}, "
                f"but {files[0].name} has {', '.join(names)}, {_words(sizes)}",
                hint="One dataset has one robot and one set of cameras; choose with --episodes.",
            )
        if samples.command is None:
            without_plan.append(path)
        advance(number + 1, path.stem)
    if config.action == "next-state" or (config.action == "auto" and without_plan):
        return "next_state", sizes
    if without_plan:
        raise EpisodeError(
            path=without_plan[0],
            found="no executed plan that says every joint and the gripper's width",
            hint="Leave --action plan out; the next state is the action then.",
        )
    return "plan", sizes


def _words(sizes: dict[str, tuple[int, int]]) -> str:
    return ", ".join(f"{name} {w}x{h}" for name, (h, w) in sizes.items()) or "none"


def _size(episode: Episode, camera: str, samples: Samples) -> tuple[int, int]:
    image_u8 = next(row_images(episode, camera, samples.images[camera][:1]))
    return image_u8.shape[0], image_u8.shape[1]


def _images(
    episode: Episode, camera: str, wanted: Int[np.ndarray, " num_rows"], size: tuple[int, int]
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    for row, image_u8 in enumerate(row_images(episode, camera, wanted)):
        if image_u8.shape[:2] != size:
            raise EpisodeError(
                path=episode.path,
                found=f"camera {camera}, row {row}: {image_u8.shape[1]} x {image_u8.shape[0]} "
                f"pixels, before {size[1]} x {size[0]}",
                hint="A video has one size; leave the episode out.",
            )
        yield image_u8


def _success(run: RunFolder | None, episode: Episode) -> bool | None:
    if episode.derived is not None:
        done: bool | None = episode.derived.settings.get(ROLLOUT, {}).get("success")
        return done
    outcome = episode.outcome if run is None else outcome_of(run, episode)
    return {"success": True, "failure": False}.get(outcome.result if outcome else "")


def _task(episode: Episode) -> str:
    info = episode.info
    return info.instruction or info.task.replace("_", " ") or "not named"


def _row(number: int, episode: Episode, samples: Samples, success: bool | None) -> dict[str, Any]:
    return {
        "episode_index": number,
        "id": episode.info.id if episode.derived is None else episode.path.stem,
        "rollout": episode.derived is not None,
        "start_ns": int(samples.stamps_ns[0]),
        "frames": len(samples.stamps_ns),
        "success": success,
        "stand_in": episode.info.stand_in,
        "max_image_offset_ns": samples.max_image_offset_ns,
    }


def _write_about(
    folder: Path,
    files: list[Path],
    shape: DatasetShape,
    kind: ActionKind,
    table: list[dict[str, Any]],
) -> None:
    choices = {
        "format": f"LeRobotDataset {layout.VERSION}",
        "action": kind,
        "left_out": ["depth"],
        "episodes": table,
    }
    write_note(folder, made_by="export lerobot", sources=files, choices=choices)
    (folder / "README.md").write_text(card_text(shape, kind, table), encoding="utf-8")
