"""Hard success predicates: data in the task file, one evaluation for recorded and replayed states.

Errata resolution 9 and 10: the predicate reads the settled final state x_{T+1}; its semantics
(terminal, held for t seconds, over the whole execution) are part of the predicate itself.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.errors import UsageError
from bridge.task.check import REFERENCES, TABLE
from bridge.task.relations import RELATIONS, Box
from bridge.task.task_file import Task


@dataclass(frozen=True, kw_only=True)
class Contact:
    """One stretch of time in which two bodies were closer than the margin."""

    start_ns: int
    """From the start of the trajectory."""
    end_ns: int
    bodies: tuple[str, str]
    allowed: bool
    """Whether the active stage allowed them to touch."""
    min_distance_m: float
    """Smallest signed distance; negative where they overlapped."""


ALLOWED_CONTACTS = "allowed_contacts"
"""No contact outside the allowed pairs over the whole execution."""


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """Object states over time, recorded or replayed."""

    stamps_ns: Int[np.ndarray, " num_steps"]
    Ts_base_object: Mapping[str, Float[np.ndarray, "num_steps 4 4"]]
    finger_contact: Mapping[str, Bool[np.ndarray, " num_steps"]]
    """Per object: whether a finger touches it. An object may be missing: unknown."""
    extents_m: Mapping[str, Float[np.ndarray, "num_steps 3"]] = field(default_factory=dict)
    """Per soft object: its extents along its own axes [m]. May be missing: unknown."""
    broken: Mapping[str, str] = field(default_factory=dict)
    """Soft objects that are no bodies any more (burst, turned inside out), and what was found."""
    contacts: Sequence[Contact] | None = None
    """Who was closer than the margin to whom over the whole execution; None: unknown."""


@dataclass(frozen=True, kw_only=True)
class PredicateResult:
    """What one predicate said. ``value`` is None when the states do not decide it."""

    kind: str
    value: bool | None
    detail: str
    object_id: str = ""
    short_m: float | None = None
    """How far it is from holding [m], negative where it holds; None: no length decides it."""


def evaluate_success(task: Task, rollout: Rollout) -> list[PredicateResult]:
    """Evaluate every success predicate of a task on a rollout's final state."""
    return [_evaluate(spec, task, rollout) for spec in task.success]


def evaluate_contacts(task: Task, rollout: Rollout) -> PredicateResult:
    """Say whether nothing touched what it may not, from the start of the execution to its end.

    Asked of every rollout; the tolerance of a task that lists the predicate itself counts.
    """
    listed = (spec for spec in task.success if spec["kind"] == ALLOWED_CONTACTS)
    return _evaluate(next(listed, {"kind": ALLOWED_CONTACTS}), task, rollout)


def all_hold(findings: list[PredicateResult]) -> bool | None:
    """Conjunction in three-valued logic."""
    values = [finding.value for finding in findings]
    if False in values:
        return False
    return None if None in values or not values else True


def is_goal(spec: Mapping[str, Any]) -> bool:
    """Say whether a predicate asks for a change of place: it does not hold by doing nothing."""
    asks = any(key in spec for key in ("at_least_m", "by_m", "target_m"))
    return spec["kind"] in RELATIONS and (spec["kind"] != "moved" or asks)


def already_true_at_start(task: Task, rollout: Rollout) -> bool:
    """Say whether the geometric part of the goal held before anything moved (a useless trial)."""
    start = Rollout(
        stamps_ns=rollout.stamps_ns[:1],
        Ts_base_object={key: Ts[:1] for key, Ts in rollout.Ts_base_object.items()},
        finger_contact={},
    )
    goals = [_evaluate(spec, task, start).value for spec in task.success if is_goal(spec)]
    return bool(goals) and all(value is True for value in goals)


def _evaluate(spec: Mapping[str, Any], task: Task, rollout: Rollout) -> PredicateResult:
    kind, rule = spec["kind"], _RULES.get(spec["kind"])
    if rule is None:
        raise UsageError(f"success predicate {kind!r} is unknown. Known: {', '.join(_RULES)}.")
    asked = [] if kind == ALLOWED_CONTACTS else bodies_of(spec)
    lost = [key for key in asked if key not in rollout.Ts_base_object]
    found = (None, f"{lost[0]} was not localised") if lost else rule(spec, task, rollout)
    value, detail, short_m = (*found, None)[:3]
    name = str(spec.get("object", ""))
    return PredicateResult(kind=kind, value=value, detail=detail, object_id=name, short_m=short_m)


Found = tuple[bool | None, str] | tuple[bool | None, str, float | None]
"""Whether a predicate holds, None where nobody can tell, what was found, and how short it is."""


def bodies_of(spec: Mapping[str, Any]) -> list[str]:
    """Objects that a predicate is about, the one that is to move first; the table is none."""
    return [spec[key] for key in REFERENCES if key in spec and spec[key] != TABLE]


def _relation(spec: Mapping[str, Any], task: Task, rollout: Rollout) -> Found:
    """Whether objects stand to each other, and to where they were, as asked at the end."""
    boxes, said = {TABLE: Box(T_base_box=np.eye(4), half_m=np.zeros(3))}, ""
    for key in bodies_of(spec):
        first, T = rollout.Ts_base_object[key][[0, -1]]
        extents = rollout.extents_m.get(key)
        size_m = None if extents is None else extents[-1]
        box = Box.around(task.objects[key], T, extents_m=size_m, before_m=first[:3, 3])
        if not (np.isfinite(T).all() and np.isfinite(box.half_m).all()):
            return None, f"the pose of {key} is not a number"
        if spec["kind"] == "moved":
            if not np.isfinite(first).all():
                return None, f"{key} was not localised before"
            said = f"{key} moved {np.linalg.norm(T[:3, 3] - first[:3, 3]) * 1e3:.0f} mm; "
        boxes[key] = box
    found = RELATIONS[spec["kind"]](spec, boxes)
    holds = all(bool(each.excess <= 0) for each in found)
    short_m = max((float(each.excess) for each in found if each.unit == "m"), default=None)
    return holds, said + "; ".join(each.told() for each in found), short_m


def _settled(spec: Mapping[str, Any], task: Task, rollout: Rollout) -> Found:
    held_ns = round(spec["for_s"] * 1e9)
    stamps = rollout.stamps_ns
    tail = stamps >= stamps[-1] - held_ns
    if tail.sum() < 2 or stamps[-1] - stamps[0] < held_ns:
        return None, "too short to tell"
    p = rollout.Ts_base_object[spec["object"]][tail][:, :3, 3]
    seconds = np.diff(stamps[tail]) * 1e-9
    speed = float(np.max(np.linalg.norm(np.diff(p, axis=0), axis=1) / seconds))
    detail = f"{spec['object']} moves at up to {speed * 1e3:.0f} mm/s in the last {spec['for_s']} s"
    return bool(speed <= spec["max_speed_m_s"]), detail


def _no_finger_contact(spec: Mapping[str, Any], task: Task, rollout: Rollout) -> Found:
    contact = rollout.finger_contact.get(spec["object"])
    if contact is None:
        return None, "finger contact is not known"
    touching = bool(contact[-1])
    verb = "touches" if touching else "does not touch"
    return not touching, f"a finger {verb} {spec['object']} at the end"


def _shape(spec: Mapping[str, Any], task: Task, rollout: Rollout) -> Found:
    object_id = spec["object"]
    model = task.objects[object_id]
    if model.soft is None:
        return True, f"{object_id} is rigid"
    if object_id in rollout.broken:
        return False, f"{object_id} {rollout.broken[object_id]}"
    extents = rollout.extents_m.get(object_id)
    if extents is None:
        return None, f"the shape of {object_id} is not known"
    change = float(np.max(np.abs(extents[-1] / np.array(model.size_m) - 1.0)))
    if not np.isfinite(change):
        return False, f"the extents of {object_id} are no numbers"
    detail = f"an extent of {object_id} differs by {change:.0%} from rest"
    return bool(change <= spec["tolerance_fraction"]), detail


def _allowed_contacts(spec: Mapping[str, Any], task: Task, rollout: Rollout) -> Found:
    if rollout.contacts is None:
        return None, "contacts are not known"
    only, deepest = spec.get("object"), -float(spec.get("tolerance_m", 0.0))
    wrong = [
        contact
        for contact in rollout.contacts
        if not contact.allowed
        and contact.min_distance_m <= deepest
        and (only is None or only in contact.bodies)
    ]
    if not wrong:
        return True, "nothing touched what it may not touch"
    first = min(wrong, key=lambda contact: contact.start_ns)
    told = f"{' touched '.join(first.bodies)} at {first.start_ns * 1e-9:.2f} s"
    return False, f"{told}, {-first.min_distance_m * 1e3:.1f} mm deep"


def objects_done(
    findings: list[PredicateResult], manipulated: tuple[str, ...]
) -> dict[str, bool | None]:
    """Per manipulated object: whether everything asked of it holds."""
    return {
        key: all_hold([finding for finding in findings if finding.object_id == key])
        for key in manipulated
    }


_RULES: dict[str, Callable[[Mapping[str, Any], Task, Rollout], Found]] = {
    **dict.fromkeys(RELATIONS, _relation),
    "settled": _settled,
    "no_finger_contact": _no_finger_contact,
    "shape": _shape,
    ALLOWED_CONTACTS: _allowed_contacts,
}
