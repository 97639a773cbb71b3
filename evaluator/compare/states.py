"""The predicted final state: where each stage was to leave its object, and where it lay."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median

import numpy as np

from bridge.episode.reader import Episode
from bridge.task.task_file import ObjectModel, Task
from evaluator.compare.known_task import recorded_task
from evaluator.compare.measure import (
    Part,
    degrees,
    ends,
    interval_or_reason,
    measured,
    millimetres,
)
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import Defined
from evaluator.metrics.state import extents_difference_m, turn_between_rad, turns_alike
from evaluator.motion_measurements import STATES
from evaluator.result import Exclusion, Interval, Measurement, Table
from evaluator.run_reader.object_states import (
    ObjectState,
    predicted_states,
    read_sent,
    recorded_states,
    replayed_states,
)
from evaluator.statistics.intervals import cluster_means, median_interval

PLAN, PLANNED, EXECUTED, RECORDED = "plan", "planned", "executed", "recorded"
PAIRS = (
    (PLAN, RECORDED),
    (PLAN, PLANNED),
    (PLAN, EXECUTED),
    (PLANNED, RECORDED),
    (PLANNED, EXECUTED),
    (EXECUTED, RECORDED),
)
"""Who predicts, and what it is held against. ``plan``: the poses the planner wrote into it."""
NOT_LOCALISED = "it was not localised after the execution"


@dataclass(frozen=True, kw_only=True)
class StateSummary:
    """One predicted pose of one object against where it lay."""

    episode: str
    task: str
    condition: str
    plan_id: str
    stage: str
    object_id: str
    predicted_by: str
    """plan, planned or executed."""
    against: str
    """planned, executed or recorded."""
    is_last: bool
    """Whether no later stage moves the object: its final state, after settling."""
    soft: bool
    position_m: float | None
    """Distance of the origins; of a soft object, of the middles."""
    rotation_rad: float | None
    """Angle modulo the object's symmetry; None where the task file is not known."""
    extents_m: float | None
    """Largest difference of an extent, of soft objects whose shape both sides know."""
    reason: str | None
    """Why there is no position."""


def summarise_states(
    recorded: Episode,
    replays: Mapping[str, Episode],
    localised: Episode | None,
    *,
    plan_id: str,
    task: Task | None = None,
) -> tuple[StateSummary, ...]:
    """Compare what a plan, and its replays, predict of each stage's objects with what came out.

    Objects are localised only after an execution, so only their final states are held against the
    recording. Nothing is found when the plan predicts no object.
    """
    sent = read_sent(recorded, plan_id)
    if sent is None:
        return ()
    info = recorded.info
    task = recorded_task(recorded) if task is None else task
    last = sent.last_stages()
    seen = recorded_states(sent, localised)
    missing = ObjectState(reason=NOT_LOCALISED)
    sides = {side: replayed_states(replays[side], sent, task) for side in replays}
    sides[PLAN] = predicted_states(sent.plan)
    sides[RECORDED] = {
        (stage, name): seen.get(name, missing)
        for stage, name in sent.steps()
        if last[name] == stage
    }
    found = []
    for stage, name in sent.steps():
        model = None if task is None else task.objects.get(name)
        for predicted_by, against in PAIRS:
            first, second = (
                sides.get(side, {}).get((stage, name)) for side in (predicted_by, against)
            )
            if first is None or second is None:
                continue
            position, rotation, extents, reason = _differences(first, second, model)
            found.append(
                StateSummary(
                    episode=info.id,
                    task=info.task,
                    condition=info.condition,
                    plan_id=plan_id,
                    stage=stage,
                    object_id=name,
                    predicted_by=predicted_by,
                    against=against,
                    is_last=last[name] == stage,
                    soft=model is not None and model.soft is not None,
                    position_m=position,
                    rotation_rad=rotation,
                    extents_m=extents,
                    reason=reason,
                )
            )
    return tuple(found)


def _differences(
    first: ObjectState, second: ObjectState, model: ObjectModel | None
) -> tuple[float | None, float | None, float | None, str | None]:
    """Return position, rotation and extents, as far as both sides know them, or why not."""
    T_first, T_second = first.T_base_object, second.T_base_object
    middle_first, middle_second = first.middle_m, second.middle_m
    if T_first is None or T_second is None or middle_first is None or middle_second is None:
        return None, None, None, first.reason or second.reason
    rotation = extents = None
    if model is not None:
        rotation = turn_between_rad(T_first[:3, :3], T_second[:3, :3], turns_alike(model))
    if first.extents_m is not None and second.extents_m is not None:
        extents = extents_difference_m(first.extents_m, second.extents_m)
    return float(np.linalg.norm(middle_first - middle_second)), rotation, extents, None


Group = tuple[str, str, str, str]
"""Who predicts, what it is held against, task, condition."""


def _defined(key: Group, name: str, **words: object) -> Defined:
    predicted_by, against, task, condition = key
    return STATES[name].of(
        by=predicted_by,
        against=against,
        task=task,
        condition=condition,
        **{"quantity": "", "who": "", "other": "", "where": "", "count": 0} | words,
    )


def final_table(keys: Sequence[Group], by_id: dict[str, Measurement]) -> Table:
    """Medians of each group."""
    rows = []
    for key in keys:
        position = by_id[_defined(key, "position").id]
        rotation = by_id.get(_defined(key, "rotation").id)
        extents = by_id.get(_defined(key, "extents").id)
        low, high = (millimetres(end) for end in ends(position.interval))
        rows.append(
            {
                "task": key[2],
                "condition": key[3].replace("_", " "),
                "predicted by": key[0],
                "against": key[1],
                "objects": position.n,
                "median distance (mm)": millimetres(position.value),
                "low (mm)": low,
                "high (mm)": high,
                "median rotation (deg)": None if rotation is None else degrees(rotation.value),
                "median extents (mm)": None if extents is None else millimetres(extents.value),
            }
        )
    return Table.of(
        rows,
        id="final_states",
        title="Predicted against final object states",
        note="After each object's last stage, when all has settled. plan: the poses the planner "
        "wrote into it; planned, executed: the dynamic replays; recorded: localised after the "
        "execution. Medians over episodes with 95 % intervals from order statistics; rotation is "
        "modulo symmetry; distance of soft objects is that of their middles.",
    )


WHO = {
    PLAN: "the plan's predicted pose",
    PLANNED: "the planned replay's",
    EXECUTED: "the executed replay's",
    RECORDED: "the localised recording's",
}
QUANTITIES: tuple[tuple[str, str, Callable[[StateSummary], float | None]], ...] = (
    ("position", "distance of the object", lambda s: s.position_m),
    ("rotation", "angle modulo the object's symmetry", lambda s: s.rotation_rad),
    ("extents", "largest difference of a soft object's extents", lambda s: s.extents_m),
)
UNKNOWN = {
    "position": "no position is known",
    "rotation": "the task file is not known, so neither is the symmetry",
    "extents": "not both sides know the shape",
}
"""Why a quantity has no value although its position has."""


def state_results(states: Sequence[StateSummary]) -> Part:
    """Measure final states per task and condition; each stage's goes into a table.

    Objects of one episode share its calibration and its start, so an episode counts once: the mean
    over its objects.
    """
    if not states:
        reason = "no plan that was sent predicts where a stage leaves its objects"
        return Part(missing=(f"final states: no data ({reason})",))
    groups: dict[Group, list[StateSummary]] = {}
    for state in states:
        if state.is_last:
            key = (state.predicted_by, state.against, state.task, state.condition)
            groups.setdefault(key, []).append(state)
    ordered = sorted(groups, key=lambda key: (key[2], key[3], PAIRS.index((key[0], key[1]))))
    measurements = [m for key in ordered for m in _measure(key, groups[key])]
    by_id = {measurement.id: measurement for measurement in measurements}
    return Part(
        measurements=tuple(measurements),
        tables=(final_table(ordered, by_id),),
        exclusions=_left_out(states),
    )


def _measure(key: Group, states: Sequence[StateSummary]) -> list[Measurement]:
    predicted_by, against, task, condition = key
    found = []
    for name, quantity, read in QUANTITIES:
        pairs = [(value, s.episode) for s in states if (value := read(s)) is not None]
        if name == "extents" and (predicted_by == PLAN or not any(s.soft for s in states)):
            continue  # a plan predicts a pose and no shape
        values, episodes = [value for value, _ in pairs], [episode for _, episode in pairs]
        of_episode = cluster_means(values, episodes)
        words = {
            "quantity": quantity,
            "who": WHO[predicted_by],
            "other": WHO[against],
            "where": f"{task}, {condition.replace('_', ' ')}",
            "count": len(of_episode),
        }
        found.append(
            measured(
                _defined(key, name, **words),
                partial(_median, of_episode, states, name),
                n=len(values),
                counted="object",
                episodes=list(dict.fromkeys(episodes)),
                reason_without_interval=interval_or_reason(median_interval, of_episode)[1],
            )
        )
    return found


def _median(
    values: Sequence[float], states: Sequence[StateSummary], quantity: str
) -> float | tuple[float, Interval | None]:
    _some(values, states, quantity)
    return float(median(values)), interval_or_reason(median_interval, values)[0]


def _some(values: Sequence[float], states: Sequence[StateSummary], quantity: str) -> None:
    if values:
        return
    reasons = {state.reason for state in states if state.reason}
    raise UndefinedStatisticError(
        statistic="final state", reason="; ".join(sorted(reasons)) or UNKNOWN[quantity]
    )


def _left_out(states: Sequence[StateSummary]) -> tuple[Exclusion, ...]:
    found = {
        (state.episode, f"{state.object_id}: {state.reason}"): None
        for state in states
        if state.reason is not None and state.is_last
    }
    return tuple(
        Exclusion(episode=episode, scope="final states", reason=reason) for episode, reason in found
    )
