"""One telling of an execution: planned in the twin, executed in the twin, or recorded.

Times count from the start of the execution, so that the three can be laid over each other.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from bridge.episode import schema, streams
from bridge.episode.reader import Episode
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.record import parse_record
from bridge.task.robot import GRIPPER
from twin.replay.stretches import stretches_ns
from twin.replay.verdict.result import ReplayResult

Touch = tuple[int, int]
"""When the fingers first and last touched an object, of the longest touch [ns]."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """What one side says happened."""

    side: str
    """planned, executed or recorded."""
    tool: PoseTrajectory
    """``T_base_tcp``."""
    width_times_ns: Int[np.ndarray, " num_widths"]
    width_m: Float[np.ndarray, " num_widths"]
    objects: Mapping[str, PoseTrajectory] = field(default_factory=dict)
    """``T_base_object``; the recorded side knows only the instants at which it was localised."""
    touches: Mapping[str, Touch | None] = field(default_factory=dict)
    """Per object the longest touch, None when there was none; an object not listed: unknown."""
    end_ns: int = 0
    """When the trajectory ended and settling began."""


def trace_of_result(result: ReplayResult, side: str, end_ns: int) -> Trace:
    """The trace of a replay in memory."""
    return Trace(
        side=side,
        tool=poses_over(result.stamps_ns, result.Ts_base_tcp),
        width_times_ns=result.stamps_ns,
        width_m=result.width_m,
        objects={
            name: poses_over(result.stamps_ns, Ts)
            for name, Ts in result.Ts_base_object.items()
            if name in result.finger_contact
        },
        touches={
            name: longest(stretches_ns(result.stamps_ns, touches))
            for name, touches in result.finger_contact.items()
        },
        end_ns=min(end_ns, int(result.stamps_ns[-1])),
    )


def trace_of_file(path: Path, side: str, start_ns: int, end_ns: int) -> Trace:
    """The trace of a replay that was written before.

    Args:
        path: The derived episode.
        side: What it replays.
        start_ns: Source time that is time 0.
        end_ns: When the trajectory ended, from time 0.

    Raises:
        EpisodeError: When it is damaged or no replay.
    """
    episode = Episode.open(path)
    width = streams.joint_track(episode, "/gripper/state")
    tool = next(t for t in episode.topics_of_type(schema.POSE_STAMPED) if t.endswith("/tcp/pose"))
    spans: dict[str, list[Touch]] = {}
    for message in episode.messages(episode.topics_of_type(schema.CONTACT)):
        record = parse_record(message.data, name="contact")
        first, second = record["bodies"]
        if record["source"] == "physics" and first == GRIPPER:
            span = (int(record["stamp_ns"]) - start_ns, int(record["end_ns"]) - start_ns)
            spans.setdefault(second, []).append(span)
    tool_track = _since(streams.pose_track(episode, tool), start_ns)
    objects = {
        name: _since(streams.pose_track(episode, topic), start_ns)
        for name, topic in streams.object_pose_topics(episode).items()
    }
    return Trace(
        side=side,
        tool=tool_track,
        width_times_ns=width.stamps_ns - start_ns,
        width_m=width.position[:, 0],
        objects=objects,
        touches={name: longest(spans.get(name, [])) for name in objects},
        end_ns=min(end_ns, int(tool_track.stamps_ns[-1])),  # a burst body ends it early
    )


def poses_over(
    stamps_ns: Int[np.ndarray, " num_poses"], Ts: Float[np.ndarray, "num_poses 4 4"]
) -> PoseTrajectory:
    """Transforms over time as a trajectory."""
    q, p = se3.split(Ts)
    return PoseTrajectory(stamps_ns, p, q)


def longest(spans: list[Touch]) -> Touch | None:
    """The longest of several stretches of time; the earlier of two that are as long."""
    return max(spans, key=lambda span: span[1] - span[0], default=None)


def _since(track: PoseTrajectory, start_ns: int) -> PoseTrajectory:
    return PoseTrajectory(track.stamps_ns - start_ns, track.p_m, track.q_wxyz)
