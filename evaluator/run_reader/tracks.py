"""Read what a motion comparison needs of one episode, in one pass: tool, start and end."""

from dataclasses import dataclass, replace

from bridge.episode import schema
from bridge.episode.executions import NO_PLAN, with_execution
from bridge.episode.reader import Episode
from bridge.episode.streams import execution_ns, pose_track_of
from bridge.episode.topics import TCP_POSE
from bridge.errors import BridgeError
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.record import parse_record


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """One motion of the arm over source time."""

    tool: PoseTrajectory | None
    """The tool centre point in the robot's base; None where it was not recorded."""
    started_ns: int | None
    """When the plan's execution started; None where no event says so."""
    ended_ns: int | None

    def cut(self) -> "Tracks":
        """Return what lies within the execution; everything where its start is not known."""
        tool, first, last = self.tool, self.started_ns, self.ended_ns
        if tool is None or first is None:
            return self
        keep = tool.stamps_ns >= first
        if last is not None:
            keep &= tool.stamps_ns <= last
        kept = PoseTrajectory(tool.stamps_ns[keep], tool.p_m[keep], tool.q_wxyz[keep])
        return replace(self, tool=kept if len(kept) else None)

    def shifted(self, shift_ns: int) -> "Tracks":
        """Return the same motion on a clock that is so much ahead."""
        ends = (self.started_ns, self.ended_ns)
        started_ns, ended_ns = (None if end is None else end + shift_ns for end in ends)
        tool = None if self.tool is None else self.tool.shifted(shift_ns)
        return Tracks(tool=tool, started_ns=started_ns, ended_ns=ended_ns)


def read_tracks(episode: Episode, plan_id: str) -> Tracks:
    """Read the tool, and when a plan was executed; other topics stay unread.

    A stream that is not there, or is broken, is None.
    """
    poses = [t for t in episode.topics_of_type(schema.POSE_STAMPED) if t.endswith(TCP_POSE)]
    of_tool, of_events = episode.payloads(poses[:1], episode.topics_of_type(schema.EVENT))
    known = (data for data in of_events if b"execution_" in data)
    records = [parse_record(data, name="event", package="bridge.episode") for data in known]
    if plan_id == NO_PLAN:
        records = with_execution(episode, records)
    started_ns, ended_ns = execution_ns(records, plan_id)
    try:
        tool = pose_track_of(of_tool)
    except BridgeError:
        tool = None
    return Tracks(tool=tool, started_ns=started_ns, ended_ns=ended_ns)
