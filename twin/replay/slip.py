"""Whether a plan's grasps hold: how far a carried object moves in the hand.

What moves in the hand is barely held: a little less friction or force, and it is dropped. On
soft toys this margin tells right yes from wrong yes about as well as swing and lever do, and better
than forces and contacts (docs/decisions/0018-replay-and-gate.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.geometry import se3
from bridge.geometry.signals import runs_of_true
from bridge.task.plan import Plan
from bridge.task.verdict import Factor
from twin.replay.failure import Failure, factor_from
from twin.replay.path import JointPath
from twin.replay.result import ReplayResult

LEAVES_M = 0.002
"""The hand carries once its tool is this far from where it was told to close."""


@dataclass(frozen=True, kw_only=True)
class GraspedObject:
    """One object from when the hand leaves with it until it is let go."""

    object_id: str
    stamps_ns: Int[np.ndarray, " num_steps"]
    moved_m: Float[np.ndarray, " num_steps"]
    """How far its middle is from where it was in the hand at the beginning."""


def grasped_objects(plan: Plan, path: JointPath, result: ReplayResult) -> list[GraspedObject]:
    """Every object that a stage of the plan grasps and a finger touches as the hand leaves.

    A grasp that misses is none: where the object ends is for the predicates to say.

    Args:
        plan: Which object each stage grasps, and when the gripper is to be closed.
        path: The plan's, with the gripper as late as it is replayed.
        result: Where hand and objects were.
    """
    stamps = result.stamps_ns
    holds = []
    for first, end in _closed(plan, path, stamps):
        name = _grasped(plan, int(stamps[first]))
        if name is None or name not in result.finger_contact:
            continue
        tool = result.Ts_base_tcp[first:end]
        left = np.linalg.norm(tool[:, :3, 3] - tool[0, :3, 3], axis=1) > LEAVES_M
        if not left.any():
            continue
        start = first + int(left.argmax())
        if not result.finger_contact[name][start]:
            continue
        T_tool_object = (
            se3.invert(result.Ts_base_tcp[start:end]) @ (result.Ts_base_object[name][start:end])
        )
        moved = np.linalg.norm(T_tool_object[:, :3, 3] - T_tool_object[0, :3, 3], axis=1)
        holds.append(GraspedObject(object_id=name, stamps_ns=stamps[start:end], moved_m=moved))
    return holds


def _closed(
    plan: Plan, path: JointPath, stamps: Int[np.ndarray, " num_steps"]
) -> list[tuple[int, int]]:
    """First step and the one after the last of each stretch with the gripper told to be closed."""
    told: Bool[np.ndarray, " num_waypoints"] = np.array([w.g == 1 for w in plan.tau])
    index = np.searchsorted(path.width_times_ns, stamps, side="right") - 1
    closed = (index >= 0) & told[np.clip(index, 0, len(told) - 1)]
    return runs_of_true(closed)


def _grasped(plan: Plan, t_ns: int) -> str | None:
    """The object of the newest stage that grasps one and has begun."""
    begun = [stage for stage in plan.stages if stage.grasp and stage.t_start_ns <= t_ns]
    return max(begun, key=lambda stage: stage.t_start_ns).grasp if begun else None


def grasps_seen(plan: Plan, path: JointPath, result: ReplayResult) -> tuple[dict[str, object], ...]:
    """What became of each grasp of a plan, for whoever plans again; as verdicts keep it.

    Args:
        plan: Which object each stage grasps, and when the gripper is to be closed.
        path: The plan's, with the gripper as late as it is replayed.
        result: Where hand and objects were.
    """
    held = {hold.object_id for hold in grasped_objects(plan, path, result)}
    seen = []
    for first, end in _closed(plan, path, result.stamps_ns):
        name = _grasped(plan, int(result.stamps_ns[first]))
        if name is None or name not in result.finger_contact:
            continue
        contact = result.finger_contact[name][first:end]
        p_object_m = None
        if contact.any():
            when = first + int(contact.argmax())
            T_object_base = se3.invert(result.Ts_base_object[name][when])
            tool_m = se3.apply(T_object_base, result.Ts_base_tcp[when][None, :3, 3])[0]
            p_object_m = tool_m.round(6).tolist()
        seen.append(
            {
                "object": name,
                "touched": bool(contact.any()),
                "held": name in held,
                "p_object_m": p_object_m,
            }
        )
    return tuple(seen)


def slips(holds: Sequence[GraspedObject], limit_m: float) -> list[Failure]:
    """The holds in which an object moves farther than a limit, from when it does.

    Args:
        holds: Objects that were carried.
        limit_m: How far one may move in the hand.
    """
    failures = []
    for hold in holds:
        beyond = hold.moved_m > limit_m
        if not beyond.any():
            continue
        detail = (
            f"{hold.object_id} moves by {hold.moved_m.max() * 1e3:.0f} mm in the hand that carries "
            f"it; up to {limit_m * 1e3:.0f} mm is held"
        )
        failures.append(
            Failure(
                t_ns=int(hold.stamps_ns[beyond.argmax()]),
                cause="slipped",
                bodies=(hold.object_id,),
                detail=detail,
            )
        )
    return failures


def unless_slipped(factor: Factor, failures: Sequence[Failure]) -> Factor:
    """The terminal factor, false where it is not yet and an object slipped.

    Args:
        factor: What the success predicates say.
        failures: The slips that were found.
    """
    return factor if factor.value is False or not failures else factor_from(failures)
