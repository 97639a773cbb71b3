"""What one episode file holds, read part by part so that a broken part does not hide the rest."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int

from bridge.episode import schema, streams
from bridge.episode.executions import executed_events
from bridge.episode.metadata import Derived, EpisodeInfo, Outcome
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack
from bridge.episode.topics import CLEARANCE, GRIPPER_STATE, JOINT_STATES, TCP_POSE, is_truth
from bridge.errors import GstError
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.plan import Plan
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict
from dashboards.frames import CameraTrack, camera_tracks

Part = TypeVar("Part")


@dataclass
class Problems:
    """Messages about what could not be read."""

    texts: list[str] = field(default_factory=list)

    def attempt(self, read: Callable[[], Part], otherwise: Part) -> Part:
        """Return what ``read`` gives; on one of our errors, note it and return the fallback."""
        try:
            return read()
        except GstError as error:
            if str(error) not in self.texts:
                self.texts.append(str(error))
            return otherwise


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One episode file, decoded for the page. Empty or None where the file has nothing."""

    path: Path
    sha256: str
    size_bytes: int
    info: EpisodeInfo
    outcome: Outcome | None
    derived: Derived | None
    software: dict[str, Any]
    num_messages: int
    plans: tuple[tuple[int, Plan], ...]
    verdicts: tuple[tuple[int, Verdict], ...]
    events: tuple[dict[str, Any], ...]
    contacts: tuple[dict[str, Any], ...]
    """What touched what in a replay, on its own clock."""
    divergence: dict[str, Any] | None
    """What a replay says of where planned, executed and recorded part."""
    joints: JointTrack | None
    widths: JointTrack | None
    clearance: JointTrack | None
    tcp: PoseTrajectory | None
    objects: dict[str, PoseTrajectory]
    cameras: dict[str, CameraTrack]
    problems: tuple[str, ...]

    def first_stamp_ns(self) -> int | None:
        """Earliest source time of robot, camera, tool or event; the page's zero."""
        return min(self._stamps_at(0), default=None)

    def last_stamp_ns(self) -> int | None:
        """Latest source time of the same streams."""
        return max(self._stamps_at(-1), default=None)

    def _stamps_at(self, index: int) -> list[int]:
        robot = [track for track in (self.joints, self.tcp) if track is not None]
        tracks = [*robot, *self.objects.values(), *self.cameras.values()]
        return [int(track.stamps_ns[index]) for track in tracks] + [
            int(event["stamp_ns"]) for event in self.events
        ]

    def executed_ns(self, plan_id: str) -> tuple[int, int | None] | None:
        """Source times at which a plan's execution started and, if it did, ended."""
        start, end = streams.execution_ns(self.events, plan_id)
        return None if start is None else (start, end)


def read_recording(path: Path) -> Recording:
    """Read an episode; kept in memory until the file changes.

    Raises:
        GstError: When the file cannot be opened at all.
    """
    status = path.stat()
    return _read(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=32)
def _read(path: Path, _mtime_ns: int, size: int) -> Recording:
    episode = Episode.open(path)
    problems = Problems()
    topics = {name: topic for name, topic in episode.topics().items() if not is_truth(name)}

    def joints(ending: str) -> JointTrack | None:
        if not any(topic.endswith(ending) for topic in topics):
            return None
        return problems.attempt(lambda: streams.joint_track(episode, ending), None)

    def poses(topic: str | None) -> PoseTrajectory | None:
        if topic is None or topics[topic].count == 0:
            return None
        return problems.attempt(lambda: streams.pose_track(episode, topic), None)

    divergences: list[dict[str, Any]] = problems.attempt(
        lambda: _records(episode, schema.DIVERGENCE), []
    )
    tracked = {name: poses(topic) for name, topic in streams.object_pose_topics(episode).items()}
    return Recording(
        path=path,
        sha256=episode.sha256(),
        size_bytes=size,
        info=episode.info,
        outcome=episode.outcome,
        derived=episode.derived,
        software=episode.metadata_records.get("software", {}),
        num_messages=sum(topic.count for topic in episode.topics().values()),
        plans=tuple(problems.attempt(lambda: streams.plans(episode), [])),
        verdicts=tuple(problems.attempt(lambda: streams.verdicts(episode), [])),
        events=tuple(problems.attempt(lambda: executed_events(episode), [])),
        contacts=tuple(problems.attempt(lambda: _records(episode, schema.CONTACT), [])),
        divergence=divergences[-1] if divergences else None,
        joints=joints(JOINT_STATES),
        widths=joints(GRIPPER_STATE),
        clearance=joints(CLEARANCE),
        tcp=poses(next((topic for topic in topics if topic.endswith(TCP_POSE)), None)),
        objects={name: track for name, track in tracked.items() if track is not None},
        cameras=problems.attempt(lambda: camera_tracks(path), {}),
        problems=tuple(problems.texts),
    )


def _records(episode: Episode, kind: str) -> list[dict[str, Any]]:
    """All records of one kind, in log order."""
    return [
        parse_record(message.data, name=kind.rpartition("/")[2].lower())
        for message in episode.messages(episode.topics_of_type(kind))
    ]


@dataclass(frozen=True, kw_only=True)
class PageClock:
    """Convert source stamps [ns] to the page's time (seconds since the first sample) and back."""

    zero_ns: int
    end_s: float
    recorded_ns: tuple[int, int]
    starts_ns: dict[str, int]
    """When each executed plan started."""

    @staticmethod
    def of(recording: Recording) -> "PageClock":
        """Start at the first sample of the recording."""
        first, last = recording.first_stamp_ns(), recording.last_stamp_ns()
        zero = 0 if first is None else first
        end = zero if last is None else last
        starts = {}
        for event in recording.events:
            interval = recording.executed_ns(str(event.get("plan_id")))
            if interval is not None:
                starts[str(event["plan_id"])] = interval[0]
        return PageClock(
            zero_ns=zero,
            end_s=max((end - zero) * 1e-9, 1e-3),
            recorded_ns=(zero, end),
            starts_ns=starts,
        )

    @property
    def span_s(self) -> tuple[float, float]:
        """The whole time axis."""
        return 0.0, self.end_s

    def clamp(self, t_s: float) -> float:
        """Return the nearest time on the axis."""
        return min(max(t_s, 0.0), self.end_s)

    def seconds(self, stamp_ns: int) -> float:
        """Return the page time of a source stamp."""
        return (stamp_ns - self.zero_ns) * 1e-9

    def stamp_ns(self, t_s: float) -> int:
        """Return the source stamp of a page time."""
        return self.zero_ns + round(t_s * 1e9)

    def all_seconds(
        self, stamps_ns: Int[np.ndarray, " num_samples"]
    ) -> Float[np.ndarray, " num_samples"]:
        """Return the page times of many source stamps."""
        return (np.asarray(stamps_ns) - self.zero_ns) * 1e-9

    def of_plan_time(self, plan_id: str, t_ns: int | None) -> float | None:
        """Return the page time of an instant of a plan; None if it never ran.

        Args:
            t_ns: Time since that plan's start [ns]; None stays None.
        """
        if t_ns is None or plan_id not in self.starts_ns:
            return None
        return self.seconds(self.starts_ns[plan_id] + t_ns)

    def replay_seconds(
        self, replay: Recording, stamps_ns: Int[np.ndarray, " num_samples"]
    ) -> Float[np.ndarray, " num_samples"] | None:
        """Return a replay's page times; its clock starts with the plan or is the recording's.

        None when the replayed plan was never executed: it has no time on this axis.

        Args:
            replay: The replay, for where its clock starts and which plan it replays.
            stamps_ns: Instants on the replay's own clock [ns].
        """
        first = replay.first_stamp_ns()
        if first is None:
            return None
        if self.recorded_ns[0] <= first <= self.recorded_ns[1]:
            return self.all_seconds(stamps_ns)
        plan_id = replay.derived.plan_id if replay.derived else None
        if plan_id is None or plan_id not in self.starts_ns:
            return None
        return self.all_seconds(np.asarray(stamps_ns) - first + self.starts_ns[plan_id])
