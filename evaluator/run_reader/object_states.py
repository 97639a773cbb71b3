"""Where objects were after a stage: as the plan says, as a replay has it, as it was localised."""

import json
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import PointCloudSample, PoseSample
from bridge.episode.reader import Episode, RawMessage
from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.record import parse_record
from bridge.task.task_file import ObjectModel, Task
from evaluator.metrics.state import soft_box

NEAR_NS = 250_000_000
"""A pose is that of an instant when it is not older than this."""
AFTER = "end"
"""Phase of a localisation made after an execution."""

Key = tuple[str, str]
"""A stage and one of its objects."""


@dataclass(frozen=True, kw_only=True)
class ObjectState:
    """Where one side says an object was, or why it does not say."""

    T_base_object: Float[np.ndarray, "4 4"] | None = None
    middle_m: Float[np.ndarray, "3"] | None = None
    """The origin; of a soft object the middle of the box around it."""
    extents_m: Float[np.ndarray, "3"] | None = None
    """Of a soft object, along the axes of its pose."""
    reason: str | None = None
    """Set exactly when there is no pose."""


@dataclass(frozen=True, kw_only=True)
class Sent:
    """The plan that was sent, when it ended, and what was localised while recording."""

    plan: Plan
    """Without its trajectory."""
    ended_ns: int | None
    localisations: tuple[Mapping[str, Any], ...]

    def last_stages(self) -> dict[str, str]:
        """The last stage that moves each object."""
        return {name: stage.id for stage in self.plan.stages for name in stage.predicted_objects}

    def steps(self) -> list[Key]:
        """Every stage with each object it predicts a pose of."""
        return [(stage.id, name) for stage in self.plan.stages for name in stage.predicted_objects]


def read_sent(recorded: Episode, plan_id: str) -> Sent | None:
    """Find a plan in the recording; None when it is not there."""
    names = (schema.PLAN, schema.EVENT, schema.LOCALISATION)
    topics = [topic for name in names for topic in recorded.topics_of_type(name)]
    plan: Plan | None = None
    named = json.dumps(plan_id, ensure_ascii=False).encode()  # a plan takes long to parse
    events, found = [], []
    for message in recorded.messages(topics):
        if message.type_name == schema.LOCALISATION:
            found.append(parse_record(message.data, name="localisation"))
        elif message.type_name == schema.EVENT:
            if b"execution_" in message.data:
                data = message.data
                events.append(parse_record(data, name="event", package="bridge.episode"))
        elif named in message.data:
            candidate = Plan.outline_from_json(message.data)
            plan = candidate if candidate.id == plan_id else plan
    if plan is None:
        return None
    _, ended_ns = streams.execution_ns(events, plan_id)
    return Sent(plan=plan, ended_ns=ended_ns, localisations=tuple(found))


def predicted_states(plan: Plan) -> dict[Key, ObjectState]:
    """The poses the planner wrote into the plan; it predicts no shapes."""
    return {
        (stage.id, name): _posed(se3.pose_from_record(pose))
        for stage in plan.stages
        for name, pose in stage.predicted_objects.items()
    }


def recorded_states(sent: Sent, localised: Episode | None) -> dict[str, ObjectState]:
    """The poses localised after the execution, from the twin's localisation or the cell's own."""
    records = sent.localisations if localised is None else streams.localisations(localised)
    states = {}
    for record in records:
        if not _is_after(record, sent):
            continue
        pose = record.get("T_base_object")
        if not record["found"] or pose is None:
            reason = f"not found after the execution: {record.get('reason') or 'no reason given'}"
            states[record["object"]] = ObjectState(reason=reason)
            continue
        soft = record.get("soft_shape") or {}
        states[record["object"]] = _posed(
            se3.pose_from_record(pose), middle=soft.get("centroid_m"), extents=soft.get("extents_m")
        )
    return states


def _is_after(record: Mapping[str, Any], sent: Sent) -> bool:
    if "phase" in record:
        return (record["phase"], record.get("plan_id")) == (AFTER, sent.plan.id)
    return sent.ended_ns is not None and record["stamp_ns"] >= sent.ended_ns


def replayed_states(replay: Episode, sent: Sent, task: Task | None) -> dict[Key, ObjectState]:
    """The poses at the end of each stage; after an object's last stage, when all has settled.

    Args:
        sent: The plan; its stages name the objects whose poses are wanted.
        task: Knows which objects are soft; None takes all of them as rigid.
    """
    wanted, last = sent.steps(), sent.last_stages()
    topics = {
        name: topic for name, topic in streams.object_pose_topics(replay).items() if name in last
    }
    poses: dict[str, list[RawMessage]] = defaultdict(list)
    ended: dict[str, int] = {}
    events = replay.topics_of_type(schema.EVENT)
    for message in replay.messages([*topics.values(), *events]):
        if message.type_name == schema.POSE_STAMPED:
            poses[message.topic].append(message)
        elif b"stage_ended" in message.data:
            record = parse_record(message.data, name="event", package="bridge.episode")
            if record.get("plan_id") == sent.plan.id:
                ended[str(record.get("stage_id"))] = int(record["stamp_ns"])
    states = {}
    for stage_id, name in wanted:
        track = sorted(poses[topics.get(name, "")], key=lambda message: message.publish_time_ns)
        instant = ended.get(stage_id)
        if track and last[name] == stage_id:
            instant = track[-1].publish_time_ns
        model = None if task is None else task.objects.get(name)
        states[stage_id, name] = _state_at(replay, track, instant, model)
    return states


def _state_at(
    replay: Episode, track: list[RawMessage], instant_ns: int | None, model: ObjectModel | None
) -> ObjectState:
    if not track:
        return ObjectState(reason="the replay holds no poses of it")
    if instant_ns is None:
        return ObjectState(reason="the replay ended before the stage did")
    place = bisect_right([message.publish_time_ns for message in track], instant_ns) - 1
    if place < 0 or instant_ns - track[place].publish_time_ns > NEAR_NS:
        return ObjectState(reason="the replay holds no pose of it at the end of the stage")
    try:
        T = PoseSample.from_cdr(track[place].data).T_frame_body
        if not np.isfinite(T).all():
            return ObjectState(reason="its replayed pose is not a number")
        if model is None or model.soft is None:
            return _posed(T)
        return _soft_state(replay, track[0], track[place], T, model)
    except BridgeError as error:
        return ObjectState(reason=str(error))


def _soft_state(
    replay: Episode,
    first: RawMessage,
    chosen: RawMessage,
    T_base_object: Float[np.ndarray, "4 4"],
    model: ObjectModel,
) -> ObjectState:
    topic = chosen.topic.removesuffix("pose") + "nodes"
    rest = _nodes(replay, topic, first.log_time_ns, first.log_time_ns + NEAR_NS, last=False)
    now = _nodes(replay, topic, chosen.log_time_ns - NEAR_NS, chosen.log_time_ns + 1, last=True)
    if rest is None or now is None or not np.isfinite(now).all():
        return _posed(T_base_object)
    T_base_rest = PoseSample.from_cdr(first.data).T_frame_body
    middle, extents = soft_box(now, T_base_object, rest, T_base_rest, model.size_m)
    return ObjectState(T_base_object=T_base_object, middle_m=middle, extents_m=extents)


def _nodes(
    replay: Episode, topic: str, start_ns: int, end_ns: int, *, last: bool
) -> Float[np.ndarray, "num_nodes 3"] | None:
    found = [m.data for m in replay.messages([topic], start_ns=start_ns, end_ns=end_ns)]
    if not found:
        return None
    return PointCloudSample.from_cdr(found[-1 if last else 0]).points_m


def _posed(
    T: Float[np.ndarray, "4 4"],
    *,
    middle: list[float] | None = None,
    extents: list[float] | None = None,
) -> ObjectState:
    return ObjectState(
        T_base_object=T,
        middle_m=T[:3, 3] if middle is None else np.array(middle, dtype=np.float64),
        extents_m=None if extents is None else np.array(extents, dtype=np.float64),
    )
