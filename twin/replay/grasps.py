"""What became of each grasp of a plan: whether the object was carried along."""

import numpy as np
from jaxtyping import Bool, Float

from bridge.geometry import se3
from bridge.geometry.signals import runs_of_true
from bridge.task.plan import Plan
from twin.replay.path import JointPath
from twin.replay.result import States

LEAVES_M = 0.002
"""The hand carries once its tool is this far from where it was told to close."""


def grasps_seen(
    plan: Plan, path: JointPath, states: States, Ts_base_tcp: Float[np.ndarray, "num_steps 4 4"]
) -> tuple[dict[str, object], ...]:
    """What became of each grasp of a plan, for whoever plans again; as verdicts keep it."""
    stretches, told = [], np.array([waypoint.g == 1 for waypoint in plan.tau])
    newest = np.searchsorted(path.width_times_ns, states.stamps_ns, side="right") - 1
    closed = (newest >= 0) & told[np.clip(newest, 0, len(told) - 1)]
    for first, end in runs_of_true(closed):
        name = grasped(plan, int(states.stamps_ns[first]))
        if name is not None and name in states.finger_contact:
            stretches.append((name, first, end))
    held = {
        name
        for name, first, end in stretches
        if _carries(Ts_base_tcp[first:end, :3, 3], states.finger_contact[name][first:end])
    }
    return tuple(
        {
            "object": name,
            "held": name in held,
            "T_base_object": se3.pose_record(states.Ts_base_object[name][-1]),
        }
        for name, _, _ in stretches
    )


def _carries(
    tool_m: Float[np.ndarray, "num_closed 3"], contact: Bool[np.ndarray, " num_closed"]
) -> bool:
    """Whether a finger touches the object as the hand leaves; a grasp that misses carries none."""
    left = np.linalg.norm(tool_m - tool_m[0], axis=1) > LEAVES_M
    return bool(left.any() and contact[int(left.argmax())])


def grasped(plan: Plan, t_ns: int) -> str | None:
    """The object of the newest stage that grasps one and has begun."""
    begun = [stage for stage in plan.stages if stage.grasp and stage.t_start_ns <= t_ns]
    return max(begun, key=lambda stage: stage.t_start_ns).grasp if begun else None
