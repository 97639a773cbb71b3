"""Read what a motion comparison needs of one episode, in one pass: tool, joints, start and end."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Int

from bridge.episode import schema
from bridge.episode.executions import NO_PLAN, with_execution
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack, execution_ns, joint_track_of, pose_track_of
from bridge.episode.topics import JOINT_STATES, TCP_POSE
from bridge.errors import BridgeError
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.record import parse_record

Track = TypeVar("Track", PoseTrajectory, JointTrack)


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """One motion of the arm over source time."""

    tool: PoseTrajectory | None
    """The tool centre point in the robot's base; None where it was not recorded."""
    joints: JointTrack | None
    started_ns: int | None
    """When the plan's execution started; None where no event says so."""
    ended_ns: int | None

    def cut(self) -> "Tracks":
        """Return what lies within the execution; everything where its start is not known."""
        first = self.started_ns
        last = None if first is None else self.ended_ns
        tool, joints = self.tool, self.joints
        if tool is not None:
            keep = _within(tool.stamps_ns, first, last)
            tool = PoseTrajectory(tool.stamps_ns[keep], tool.p_m[keep], tool.q_wxyz[keep])
        if joints is not None:
            keep = _within(joints.stamps_ns, first, last)
            joints = replace(
                joints, stamps_ns=joints.stamps_ns[keep], position=joints.position[keep]
            )
        return replace(
            self,
            tool=None if tool is None or not len(tool) else tool,
            joints=None if joints is None or not len(joints.stamps_ns) else joints,
        )

    def shifted(self, shift_ns: int) -> "Tracks":
        """Return the same motion on a clock that is so much ahead."""
        tool, joints = self.tool, self.joints
        return Tracks(
            tool=None if tool is None else tool.shifted(shift_ns),
            joints=None
            if joints is None
            else replace(joints, stamps_ns=joints.stamps_ns + shift_ns),
            started_ns=None if self.started_ns is None else self.started_ns + shift_ns,
            ended_ns=None if self.ended_ns is None else self.ended_ns + shift_ns,
        )


def _within(
    stamps_ns: Int[np.ndarray, " num_samples"], first_ns: int | None, last_ns: int | None
) -> Bool[np.ndarray, " num_samples"]:
    keep = np.ones(len(stamps_ns), dtype=bool)
    if first_ns is not None:
        keep &= stamps_ns >= first_ns
    if last_ns is not None:
        keep &= stamps_ns <= last_ns
    return keep


def read_tracks(episode: Episode, plan_id: str) -> Tracks:
    """Read tool and joints, and when a plan was executed; other topics stay unread.

    A stream that is not there, or is broken, is None.
    """
    poses = [t for t in episode.topics_of_type(schema.POSE_STAMPED) if t.endswith(TCP_POSE)]
    joints = [t for t in episode.topics_of_type(schema.JOINT_STATE) if t.endswith(JOINT_STATES)]
    events = episode.topics_of_type(schema.EVENT)
    of_tool, of_joints, of_events = episode.payloads(poses[:1], joints, events)
    records = [
        parse_record(data, name="event", package="bridge.episode")
        for data in of_events
        if b"execution_" in data
    ]
    if plan_id == NO_PLAN:
        records = with_execution(episode, records)
    started_ns, ended_ns = execution_ns(records, plan_id)
    return Tracks(
        tool=_known(pose_track_of, of_tool),
        joints=_known(joint_track_of, of_joints),
        started_ns=started_ns,
        ended_ns=ended_ns,
    )


def _known(read: Callable[[list[bytes]], Track | None], payloads: list[bytes]) -> Track | None:
    try:
        return read(payloads)
    except BridgeError:
        return None
