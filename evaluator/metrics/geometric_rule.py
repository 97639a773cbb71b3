"""Answer for a plan by geometry alone: does each grasp enclose its object, where would it fall?

The simplest forecast that a simulation has to beat: no mass, no friction, no contact force. Written
down before its first result, with no number that was fitted to outcomes:

1. When the fingers close, the object stands between the open pads, which reach ``PAD_REACH_M``
   around the tool centre point, and that is within the object's outer box.
2. The closing fingers centre the object; from then on it moves with the tool, whatever it weighs.
3. When the fingers open it drops straight down, unturned, onto what lies under its centre.
4. In a stage that pushes, closed fingers are a disc of ``PAD_REACH_M`` around the tool centre
   point. The pushed object is carried along in front of it, unturned, in the direction of the
   fingers' step and as far as they do not enter its outer box, and stands where they turn back.
   Fingers that come down on it, or pass over it, push nothing.
5. The task's predicates on poses, evaluated where it comes to lie, are the answer.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.predicate import Rollout, all_hold, evaluate_success
from bridge.task.task_file import ObjectModel, Task

PAD_REACH_M = 0.01
"""How far the pads of a usual parallel gripper reach around its tool centre point."""
NEEDS_PHYSICS = ("settled", "no_finger_contact", "shape", "allowed_contacts")
"""Predicates that geometry says nothing of."""
CLOSING_AXIS = 1
"""The fingers close along the tool frame's y axis."""

Poses = dict[str, Float[np.ndarray, "4 4"]]


@dataclass(frozen=True, kw_only=True)
class RuleAnswer:
    """What the rule says of one plan; None where an object's start is not known."""

    value: bool | None
    detail: str


def judge_by_geometry(
    plan: Plan, task: Task, Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]]
) -> RuleAnswer:
    """Say whether a plan with its whole trajectory succeeds as far as geometry alone can tell.

    ``Ts_base_object``: where objects were localised before; a missing one leaves the answer open.
    """
    missing = [n for n in (*task.manipulated, *task.containers) if n not in Ts_base_object]
    if missing:
        return RuleAnswer(value=None, detail=f"{', '.join(missing)}: not localised at the start")
    poses = dict(Ts_base_object)
    open_m: float | None = None
    held: tuple[str, Float[np.ndarray, "4 4"]] | None = None
    closed = False
    Ts_base_tcp = se3.transform_from(plan.quaternions_wxyz(), plan.positions_m())
    before = Ts_base_tcp[0]
    for waypoint, T_base_tcp in zip(plan.tau, Ts_base_tcp, strict=True):
        at = (s.push for s in plan.stages if s.t_start_ns <= waypoint.t_ns <= s.t_end_ns)
        pushed = next(filter(None, at), "")
        if held is not None:
            poses[held[0]] = T_base_tcp @ held[1]
        if pushed in poses and waypoint.g:
            step = T_base_tcp[:3, 3] - before[:3, 3]
            poses[pushed] = _carried_along(task.objects[pushed], poses[pushed], T_base_tcp, step)
        before = T_base_tcp
        if pushed:
            pass  # fingers that close here grasp nothing
        elif waypoint.g and not closed:
            name = _nearest(poses, task, T_base_tcp)
            T_tcp_object = se3.invert(T_base_tcp) @ poses[name]
            if problem := _grasp_problem(task.objects[name], T_tcp_object, open_m):
                return RuleAnswer(value=False, detail=f"grasp of {name}: {problem}")
            held = (name, _centred(task.objects[name], T_tcp_object))
        elif closed and not waypoint.g and held is not None:
            poses[held[0]] = _dropped(held[0], task, poses)
            held = None
        closed = bool(waypoint.g)
        if not closed:
            open_m = waypoint.width_m
    return _final_answer(task, poses)


def _carried_along(
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
    T_base_tcp: Float[np.ndarray, "4 4"],
    step_m: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "4 4"]:
    """Where one step of the closed fingers leaves the object in front of them."""
    length_m = float(np.linalg.norm(step_m[:2]))
    if length_m <= abs(float(step_m[2])):  # up, down or a wait
        return T_base_object
    along = np.array([*step_m[:2], 0.0]) / length_m
    half = np.array(model.size_m) / 2
    T = T_base_object.copy()

    def clear_m(shift_m: float) -> float:
        """From the disc to the outer box, seen from above, were the object moved on."""
        T[:3, 3] = T_base_object[:3, 3] + shift_m * along
        p = se3.apply(se3.invert(T), T_base_tcp[:3, 3]) - _middle(model)
        if abs(p[2]) > half[2] + PAD_REACH_M:
            return np.inf
        return float(np.linalg.norm(np.maximum(np.abs(p[:2]) - half[:2], 0.0))) - PAD_REACH_M

    low_m, high_m = 0.0, float(2 * np.linalg.norm(half)) + 2 * PAD_REACH_M
    ahead = float((T_base_object[:3, 3] - T_base_tcp[:3, 3]) @ along) > 0
    if clear_m(0.0) >= 0 or not ahead:
        return T_base_object
    for _ in range(40):
        middle_m = (low_m + high_m) / 2
        low_m, high_m = (low_m, middle_m) if clear_m(middle_m) >= 0 else (middle_m, high_m)
    T[:3, 3] = T_base_object[:3, 3] + high_m * along
    return T


def _middle(model: ObjectModel) -> Float[np.ndarray, "3"]:
    """Middle of the outer box in the object's frame [m]."""
    return np.array([0.0, 0.0, 0.0 if model.origin_at_centre else model.size_m[2] / 2])


def _nearest(
    poses: Mapping[str, Float[np.ndarray, "4 4"]], task: Task, T_base_tcp: Float[np.ndarray, "4 4"]
) -> str:
    """The manipulated object whose middle is nearest to the tool."""
    return min(
        task.manipulated,
        key=lambda name: float(
            np.linalg.norm(se3.apply(poses[name], _middle(task.objects[name])) - T_base_tcp[:3, 3])
        ),
    )


def _grasp_problem(
    model: ObjectModel, T_tcp_object: Float[np.ndarray, "4 4"], open_m: float | None
) -> str:
    """Why the fingers would not enclose it; empty where they do."""
    half = np.array(model.size_m) / 2
    p_object = se3.apply(se3.invert(T_tcp_object), np.zeros(3)) - _middle(model)
    if model.shape != "box" or open_m is None:
        return _outside(p_object, half)
    axis_object = T_tcp_object[CLOSING_AXIS, :3]  # in the object frame
    along_m = float(p_object @ axis_object)
    extent_m = float(2 * half @ np.abs(axis_object))
    if abs(along_m) + extent_m / 2 > open_m / 2:
        found = f"{extent_m * 1e3:.0f} mm wide and {abs(along_m) * 1e3:.0f} mm off the middle"
        return f"{found}, it is not between pads {open_m * 1e3:.0f} mm apart"
    return _outside(p_object - along_m * axis_object, half)


def _outside(p_object: Float[np.ndarray, "3"], half_m: Float[np.ndarray, "3"]) -> str:
    excess_m = float(np.max(np.abs(p_object) - half_m)) - PAD_REACH_M
    return f"the pads are {excess_m * 1e3:.0f} mm beside it" if excess_m > 0 else ""


def _centred(
    model: ObjectModel, T_tcp_object: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Where a box is in the closed hand: the pads push its middle to theirs."""
    T = T_tcp_object.copy()
    if model.shape == "box":
        T[CLOSING_AXIS, 3] -= se3.apply(T_tcp_object, _middle(model))[CLOSING_AXIS]
    return T


def _dropped(
    name: str, task: Task, poses: Mapping[str, Float[np.ndarray, "4 4"]]
) -> Float[np.ndarray, "4 4"]:
    """Straight down onto the highest surface under its centre: table, floor of a box, or top."""
    T = poses[name].copy()
    heights = [0.0]
    for other, T_base_other in poses.items():
        model = task.objects.get(other)
        if other == name or model is None:
            continue
        p = se3.apply(se3.invert(T_base_other), T[:3, 3])
        if np.all(np.abs(p[:2]) <= np.array(model.size_m[:2]) / 2):
            heights.append(float(T_base_other[2, 3]) + _surface_m(model, p))
    T[2, 3] = max(heights) + task.objects[name].rest_height_m
    return T


def _surface_m(model: ObjectModel, p_object: Float[np.ndarray, "3"]) -> float:
    """Height above its origin of what carries a point over it: a cavity's floor, or its top [m]."""
    inner = np.array(model.inner_m[:2]) / 2
    if model.wall_m > 0 and np.all(np.abs(p_object[:2]) <= inner):
        return model.wall_m
    return model.size_m[2] - model.rest_height_m


def _final_answer(task: Task, poses: Poses) -> RuleAnswer:
    rollout = Rollout(
        stamps_ns=np.array([0, 1]),
        Ts_base_object={name: np.stack([T, T]) for name, T in poses.items()},
        finger_contact={},
    )
    findings = [f for f in evaluate_success(task, rollout) if f.kind not in NEEDS_PHYSICS]
    if not findings:
        return RuleAnswer(value=None, detail="the task asks for nothing that geometry decides")
    wrong = [finding.detail for finding in findings if finding.value is not True]
    return RuleAnswer(value=all_hold(findings), detail="; ".join(wrong) or findings[0].detail)
