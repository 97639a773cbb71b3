"""Read what a motion comparison needs of one episode, in one pass: tool, joints, start and end."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from bridge.episode import schema
from bridge.episode.executions import NO_PLAN, with_execution
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack, execution_ns, joint_track_of, pose_track_of
from bridge.episode.topics import JOINT_STATES, TCP_POSE
from bridge.errors import BridgeError
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.record import parse_record


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
        return replace(self, tool=self._cut_tool(), joints=self._cut_joints())

    def _cut_tool(self) -> PoseTrajectory | None:
        if self.tool is None:
            return None
        keep = self._within(self.tool.stamps_ns)
        if not keep.any():
            return None
        return PoseTrajectory(
            self.tool.stamps_ns[keep], self.tool.p_m[keep], self.tool.q_wxyz[keep]
        )

    def _cut_joints(self) -> JointTrack | None:
        if self.joints is None:
            return None
        keep = self._within(self.joints.stamps_ns)
        if not keep.any():
            return None
        joints = self.joints
        return JointTrack(
            names=joints.names,
            stamps_ns=joints.stamps_ns[keep],
            position=joints.position[keep],
        )

    def _within(self, stamps_ns: Int[np.ndarray, " num_samples"]) -> np.ndarray:
        keep = np.ones(len(stamps_ns), dtype=bool)
        if self.started_ns is not None:
            keep &= stamps_ns >= self.started_ns
        if self.started_ns is not None and self.ended_ns is not None:
            keep &= stamps_ns <= self.ended_ns
        return keep

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
        tool=_tool(of_tool),
        joints=_joints(of_joints),
        started_ns=started_ns,
        ended_ns=ended_ns,
    )


def _tool(payloads: list[bytes]) -> PoseTrajectory | None:
    try:
        return pose_track_of(payloads)
    except BridgeError:
        return None


def _joints(payloads: list[bytes]) -> JointTrack | None:
    try:
        return joint_track_of(payloads)
    except BridgeError:
        return None
