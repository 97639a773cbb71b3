"""The predicted final state: where each stage was to leave its object, and where it lay."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bridge.episode.reader import Episode
from bridge.task.task_file import ObjectModel, Task
from evaluator.compare.known_task import known_task
from evaluator.compare.object_states import (
    ObjectState,
    predicted_states,
    read_sent,
    recorded_states,
    replayed_states,
)
from evaluator.metrics.state import extents_apart_m, turn_between_rad, turns_alike

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

    Args:
        recorded: The recorded episode, with the plan.
        replays: Its dynamic replays, ``planned`` and ``executed``, as far as there are any.
        localised: Its localisation by the twin; the cell's own records count without it.
        plan_id: The plan that was sent.
        task: Says which objects are soft or symmetric; the one the episode names without it.

    Raises:
        EpisodeError: When a file turns out to be damaged.
    """
    sent = read_sent(recorded, plan_id)
    if sent is None:
        return ()
    info = recorded.info
    task = known_task(info.task) if task is None else task
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
            position, rotation, extents, reason = _apart(first, second, model)
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


def _apart(
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
        extents = extents_apart_m(first.extents_m, second.extents_m)
    return float(np.linalg.norm(middle_first - middle_second)), rotation, extents, None
