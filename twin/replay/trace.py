"""Traces of an execution, to be compared: planned in the twin, executed in the twin, recorded.

Times count from the start of the execution, so that the three can be laid over each other.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from bridge.episode import schema, streams
from bridge.episode.reader import Episode
from bridge.episode.topics import GRIPPER_STATE, TCP_POSE
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.plan import Plan
from bridge.task.predicate import Rollout
from bridge.task.record import parse_record
from twin.replay.clearance.bodies import GRIPPER
from twin.replay.execution import closed_mask
from twin.replay.path import JointPath
from twin.replay.result import ReplayResult, stretches_ns
from twin.replay.scene import ReplayScene, StartState
from twin.robot.model import RobotModel

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
    """The trace of a replay in memory until ``end_ns`` from its start: what settles is left out."""
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
    """The trace of a written replay: time 0 is ``start_ns`` (source time), the end is after it."""
    episode = Episode.open(path)
    width = streams.joint_track(episode, GRIPPER_STATE)
    tool = next(t for t in episode.topics_of_type(schema.POSE_STAMPED) if t.endswith(TCP_POSE))
    spans: dict[str, list[Touch]] = {}
    for message in episode.messages(episode.topics_of_type(schema.CONTACT)):
        record = parse_record(message.data, name="contact")
        first, second = record["bodies"]
        if record["source"] == "physics" and first == GRIPPER:
            span = (int(record["stamp_ns"]) - start_ns, int(record["end_ns"]) - start_ns)
            spans.setdefault(second, []).append(span)
    tool_track = streams.pose_track(episode, tool).shifted(-start_ns)
    objects = {
        name: streams.pose_track(episode, topic).shifted(-start_ns)
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


EMPTY_M = 0.003
"""Fingers that come within this of the width they were sent to hold nothing."""
REACH_M = 0.07
"""What the fingers hold has its origin within this of the tool."""
AWAY_M = 0.12
"""Fingers that are farther than this from an object's origin do not touch it."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What was measured during one execution, times from its start: objects before and after."""

    plan: Plan
    """With the stages at the times at which they were executed."""
    path: JointPath
    """Recorded joints and widths, as they were."""
    scene: ReplayScene
    """Where the objects were localised before."""
    end: StartState
    """Where they were localised afterwards."""
    end_seen_ns: int
    """When that was."""

    def grasps(self) -> list[Touch]:
        """When the fingers were closed and had been stopped by something."""
        times, widths = self.path.width_times_ns, self.path.width_m
        sent = min((w.width_m or 0.0 for w in self.plan.tau if w.g == 1), default=0.0)
        found = []
        for first_ns, last_ns in stretches_ns(times, closed_mask(times, widths, self.plan)):
            inside = (times >= first_ns) & (times <= last_ns)
            if float(np.median(widths[inside])) > sent + EMPTY_M:
                found.append((first_ns, last_ns))
        return found

    def touches(self, robot: RobotModel) -> dict[str, Touch | None]:
        """Per object that can move when the fingers held it longest; None: never.

        A grasp is of the object whose origin is nearest to the tool when the fingers stop.
        """
        places = {name: T[:3, 3] for name, T in self.scene.movable().items()}
        spans: dict[str, list[Touch]] = {name: [] for name in places}
        for first_ns, last_ns in self.grasps():
            p = robot.T_base_tcp(self.path.joints_at(np.array([first_ns]))[0])[:3, 3]
            near = {name: float(np.linalg.norm(p - place)) for name, place in places.items()}
            name = min(near, key=lambda key: near[key], default="")
            if name and near[name] <= REACH_M:
                spans[name].append((first_ns, last_ns))
        return {name: longest(found) for name, found in spans.items()}


def trace_of_recording(recording: Recording, robot: RobotModel, rate_hz: int) -> Trace:
    """The recorded trace; objects only at the instants at which they were localised."""
    times = recording.path.dense_times_ns(rate_hz)
    movable = recording.scene.movable()
    seen = np.array([0, max(recording.end_seen_ns, recording.path.end_ns() + 1)])
    return Trace(
        side="recorded",
        tool=poses_over(times, robot.Ts_base_tcp(recording.path.joints_at(times))),
        width_times_ns=recording.path.width_times_ns,
        width_m=recording.path.width_m,
        objects={
            name: poses_over(seen, np.stack([movable[name], T]))
            for name, T in recording.end.Ts_base_object.items()
            if name in movable
        },
        touches=recording.touches(robot),
        end_ns=recording.path.end_ns(),
    )


def states_of_recording(recording: Recording, robot: RobotModel) -> Rollout:
    """The recorded states that success predicates read: localised before and after.

    One look afterwards does not say whether anything still moves or what touched what before:
    ``settled`` and ``allowed_contacts`` stay undecided.
    """
    scene, end = recording.scene, recording.end
    fixed = scene.containers()
    places = {
        name: np.stack([T, end.Ts_base_object.get(name, T)])
        for name, T in scene.Ts_base_object.items()
        if name in fixed or name in end.Ts_base_object
    }
    seen = np.array([0, max(recording.end_seen_ns, recording.path.end_ns() + 1)])
    tool = robot.T_base_tcp(recording.path.joints_rad[-1])[:3, 3]
    away = {
        name: np.zeros(2, dtype=bool)
        for name, Ts in places.items()
        if float(np.linalg.norm(Ts[-1, :3, 3] - tool)) > AWAY_M
    }
    rest = {name: np.array(scene.task.objects[name].size_m) for name in end.extents_m}
    return Rollout(
        stamps_ns=seen,
        Ts_base_object=places,
        finger_contact=away,
        extents_m={
            name: np.stack([rest[name], extents]) for name, extents in end.extents_m.items()
        },
    )
