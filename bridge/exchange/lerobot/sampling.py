"""An episode on a grid of equal steps: what was measured, what was commanded, which image.

Row k is at ``t_0 + k / fps``. State: joints and gripper, interpolated at that time. Image: the one
nearest in time. Action: the plan's command for the next row, or the next row's state.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.reader import Episode
from bridge.episode.records import color_from_message
from bridge.episode.streams import (
    JointTrack,
    camera_ids,
    events,
    execution_ns,
    find_camera_topic,
    joint_track,
    plans,
)
from bridge.errors import EpisodeError
from bridge.exchange.naming import message_named
from bridge.task.plan import Plan

ActionKind = Literal["plan", "next_state"]
GRIPPER_ENDING = "/gripper/state"
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
    for camera in camera_ids(episode):
        stamps, _ = _image_stamps(episode, camera)
        if len(stamps) > 1:
            return max(1, round(NS_PER_S / float(np.median(np.diff(stamps)))))
    return DEFAULT_FPS


def sample(episode: Episode, fps: int) -> Samples:
    """Put an episode on the grid, over the time in which joints and all cameras are there.

    Raises:
        EpisodeError: When it has no joints, or its streams never overlap.
    """
    tracks = [joint_track(episode)]
    if any(topic.endswith(GRIPPER_ENDING) for topic in episode.topics_of_type(schema.JOINT_STATE)):
        tracks.append(joint_track(episode, GRIPPER_ENDING))
    cameras = {camera: _image_stamps(episode, camera) for camera in camera_ids(episode)}
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
    row = 0
    for number, message in enumerate(episode.messages([_topic(episode, camera)])):
        if row == len(wanted):
            return
        if number != wanted[row]:
            continue
        with message_named(episode, message.topic, number + 1):
            image_u8 = color_from_message(message.type_name, message.data).image_u8()
        while row < len(wanted) and number == wanted[row]:
            yield image_u8
            row += 1


def _topic(episode: Episode, camera: str) -> str:
    topic = find_camera_topic(episode, camera, "color/image")
    assert topic is not None  # noqa: S101  # camera_ids found it
    return topic


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
