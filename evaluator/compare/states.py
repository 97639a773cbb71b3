"""The predicted final state: where the last stage of each object was to leave it, and where it lay.

The poses that the planner wrote into the plan, those at the end of each replay, and those that were
localised after the execution.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.clock import NS_PER_S
from bridge.episode import schema, streams
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.reader import Episode, RawMessage
from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from evaluator.compare.measure import Part, degrees, ends, grouped, measured_median, millimetres
from evaluator.metrics.state import turn_between_rad, turns_alike
from evaluator.motion_measurements import STATES
from evaluator.result import Cell, Exclusion, Measurement, Table
from evaluator.statistics.intervals import cluster_means

PLAN, RECORDED = "plan", "recorded"
PREDICTED_BY = (PLAN, "planned", "executed")
"""Who predicts: the planner, or a dynamic replay of the planned or the executed motion."""
AFTER = "end"
"""Phase of a localisation after the execution."""
TAIL_NS = 2 * NS_PER_S
"""Read of a replay before all of it is."""
NOT_LOCALISED = "it was not localised after the execution"

Pose = Float[np.ndarray, "4 4"] | str
"""Pose of an object in the robot's base, or why it is not known."""


@dataclass(frozen=True, kw_only=True)
class StateSummary:
    """One predicted final pose of one object against where it was localised afterwards."""

    episode: str
    task: str
    condition: str
    object_id: str
    predicted_by: str
    """plan, planned or executed."""
    position_m: float | None = None
    """Distance of the origins."""
    rotation_rad: float | None = None
    """Angle modulo the object's symmetry; None where the task file is not known."""
    reason: str | None = None
    """Why there is no position."""


def summarise_states(
    recorded: Episode,
    replays: Mapping[str, Episode],
    localised: Episode | None,
    *,
    plan_id: str,
    task: Task | None,
) -> tuple[StateSummary, ...]:
    """Compare what a plan, and its replays, predict of each object with where it lay afterwards.

    Nothing is found when the plan predicts no object. Without its task no symmetry is known.
    """
    plan = sent_plan(recorded, plan_id, Plan.outline_from_json)
    if plan is None:
        return ()
    info = recorded.info
    last = {name: pose for stage in plan.stages for name, pose in stage.predicted_objects.items()}
    seen = _seen(recorded, localised, plan_id)
    sides: dict[str, Mapping[str, Pose]] = {
        PLAN: {name: se3.pose_from_record(pose) for name, pose in last.items()},
        **{side: _settled(replay, last) for side, replay in replays.items()},
    }
    return tuple(
        StateSummary(
            episode=info.id,
            task=info.task,
            condition=info.condition,
            object_id=name,
            predicted_by=side,
            **_difference(sides[side][name], seen.get(name, NOT_LOCALISED), task, name),
        )
        for name in last
        for side in PREDICTED_BY
        if side in sides
    )


def sent_plan(recorded: Episode, plan_id: str, read: Callable[[bytes], Plan]) -> Plan | None:
    """Find a plan in the recording; only one that names the id is read, which takes long."""
    named = json.dumps(plan_id, ensure_ascii=False).encode()
    messages = recorded.messages(recorded.topics_of_type(schema.PLAN))
    plans = (read(message.data) for message in messages if named in message.data)
    return next((plan for plan in plans if plan.id == plan_id), None)


def _seen(recorded: Episode, localised: Episode | None, plan_id: str) -> dict[str, Pose]:
    """Return where objects were localised after the execution, or that they were not found.

    By the twin, or else by the cell itself.
    """
    ended_ns: int | None = None
    if localised is None:
        ended_ns = streams.execution_ns(list(streams.events(recorded)), plan_id)[1]
    states: dict[str, Pose] = {}
    for record in streams.localisations(recorded if localised is None else localised):
        if "phase" in record:
            is_after = (record["phase"], record.get("plan_id")) == (AFTER, plan_id)
        else:
            is_after = ended_ns is not None and record["stamp_ns"] >= ended_ns
        pose = record.get("T_base_object")
        if is_after and record["found"] and pose is not None:
            states[record["object"]] = se3.pose_from_record(pose)
        elif is_after:
            why = record.get("reason") or "no reason given"
            states[record["object"]] = f"not found after the execution: {why}"
    return states


def _settled(replay: Episode, wanted: Mapping[str, Any]) -> dict[str, Pose]:
    """Return where a replay leaves each object, when all has settled."""
    topics = streams.object_pose_topics(replay)
    named = [topics[name] for name in wanted if name in topics]
    last: dict[str, RawMessage] = {}
    for start_ns in (replay.end_ns - TAIL_NS, None):
        for message in replay.messages(named, start_ns=start_ns):
            held = last.get(message.topic)
            if held is None or message.publish_time_ns >= held.publish_time_ns:
                last[message.topic] = message
        if len(last) == len(named):
            break
    found: dict[str, Pose] = dict.fromkeys(wanted, "the replay holds no poses of it")
    for name in (name for name in wanted if topics.get(name) in last):
        try:
            T = PoseSample.from_cdr(last[topics[name]].data).T_frame_body
            found[name] = T if np.isfinite(T).all() else "its replayed pose is not a number"
        except BridgeError as error:
            found[name] = str(error)
    return found


def _difference(first: Pose, second: Pose, task: Task | None, name: str) -> dict[str, Any]:
    """Return position and rotation, as far as both sides know them, or why not."""
    if isinstance(first, str) or isinstance(second, str):
        return {"reason": first if isinstance(first, str) else second}
    found: dict[str, Any] = {"position_m": float(np.linalg.norm(first[:3, 3] - second[:3, 3]))}
    if task is not None and name in task.objects:
        turns = turns_alike(task.objects[name])
        found["rotation_rad"] = turn_between_rad(first[:3, :3], second[:3, :3], turns)
    return found


WHO = {
    PLAN: "the plan's predicted pose",
    "planned": "the planned replay's",
    "executed": "the executed replay's",
}
NO_TURN = "the task file is not known, so neither is the symmetry"
QUANTITIES = (
    ("position_m", "distance of the object", "no position is known"),
    ("rotation_rad", "angle modulo the object's symmetry", NO_TURN),
)
"""Field, words, and why there is no value although there is a position."""


def state_results(states: Sequence[StateSummary]) -> Part:
    """Measure final states per task and condition.

    Objects of one episode share its calibration and its start, so an episode counts once: the mean
    over its objects.
    """
    if not states:
        reason = "no plan that was sent predicts where a stage leaves its objects"
        return Part(missing=(f"final states: no data ({reason})",))
    groups = grouped(states, lambda s: (s.task, s.condition, PREDICTED_BY.index(s.predicted_by)))
    measurements: list[Measurement] = []
    rows: list[dict[str, Cell]] = []
    for key, members in sorted(groups.items(), key=itemgetter(0)):
        position, rotation = _measure(members)
        low, high = (millimetres(end) for end in ends(position.interval))
        measurements += [position, rotation]
        rows.append(
            {
                "task": key[0],
                "condition": key[1].replace("_", " "),
                "predicted by": PREDICTED_BY[key[2]],
                "objects": position.n,
                "median distance (mm)": millimetres(position.value),
                "low (mm)": low,
                "high (mm)": high,
                "median rotation (deg)": degrees(rotation.value),
            }
        )
    table = Table.of(
        rows,
        id="final_states",
        title="Predicted against final object states",
        note="Where each object was localised after the execution, against the pose that the "
        "planner wrote into the plan, and that of the planned and the executed dynamic replay when "
        "all had settled. Medians over episodes with 95 % intervals from order statistics; "
        "rotation is modulo symmetry.",
    )
    left_out = (
        Exclusion(episode=s.episode, scope="final states", reason=f"{s.object_id}: {s.reason}")
        for s in states
        if s.reason is not None
    )
    return Part(
        measurements=tuple(measurements), tables=(table,), exclusions=tuple(dict.fromkeys(left_out))
    )


def _measure(states: Sequence[StateSummary]) -> list[Measurement]:
    found = []
    first = states[0]
    for field, quantity, unknown in QUANTITIES:
        known = [state for state in states if getattr(state, field) is not None]
        episodes = [state.episode for state in known]
        of_episode = cluster_means([getattr(state, field) for state in known], episodes)
        why = "; ".join(sorted({state.reason for state in states if state.reason})) or unknown
        found.append(
            measured_median(
                STATES[field.partition("_")[0]].of(
                    by=first.predicted_by,
                    against=RECORDED,
                    task=first.task,
                    condition=first.condition,
                    quantity=quantity,
                    who=WHO[first.predicted_by],
                    where=f"{first.task}, {first.condition.replace('_', ' ')}",
                    count=len(of_episode),
                ),
                of_episode,
                reason_if_undefined=why,
                n=len(known),
                counted="object",
                episodes=dict.fromkeys(episodes),
            )
        )
    return found
