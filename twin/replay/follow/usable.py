"""Whether a plan can be replayed at all, before anything is computed from it."""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from bridge.task.plan import Plan
from bridge.task.robot import ARM_JOINTS, BASE_FRAME, MAX_WIDTH_M
from twin.errors import TwinError
from twin.robot.model import RobotModel

MAX_DURATION_S = 600.0
"""Longest trajectory that is replayed [s]."""
MAX_WAYPOINTS = 100_000
"""Ten minutes at 125 Hz are fewer; all branches of one pose take a few kilobytes."""
WIDTH_SLACK_M = 0.01
"""A gripper may say that it is open or shut by this much more than it can be."""
_FARTHEST_M = 1e4
_SHORTEST, _LONGEST = 1e-6, 1e6
"""A quaternion whose largest number is not between these is none."""


class UnusablePlanError(TwinError):
    """A plan, or what was recorded of its execution, cannot be replayed at all."""

    def __init__(self, *, plan_id: str, found: str, hint: str) -> None:
        """Remember the plan."""
        self.plan_id = plan_id
        super().__init__(f"plan {plan_id!r} {found}. {hint}")


def check_usable(plan: Plan, robot: RobotModel) -> None:
    """Refuse what no robot, or not this one, could follow.

    Raises:
        UnusablePlanError: Naming the first thing that is wrong.
    """
    wrong = _about_times(plan) or _about_numbers(plan) or _about_whose(plan, robot)
    if wrong is not None:
        found, hint = wrong
        raise UnusablePlanError(plan_id=plan.id, found=found, hint=hint)


_Wrong = tuple[str, str]
"""What was found, and what to do."""


def _about_times(plan: Plan) -> _Wrong | None:
    count = len(plan.tau)
    if count == 0:
        return "has no waypoints", "Send tau."
    if count > MAX_WAYPOINTS:
        return f"has {count} waypoints", f"At most {MAX_WAYPOINTS} are replayed; send fewer."
    times = [waypoint.t_ns for waypoint in plan.tau]  # of any size: JSON has no largest integer
    if times[0] < 0 or any(b <= a for a, b in pairwise(times)):
        found = "has waypoint times that do not increase from 0"
        return found, "t_ns counts from the start of the trajectory."
    if times[-1] > MAX_DURATION_S * 1e9:
        found = f"lasts {times[-1] * 1e-9:.0f} s"
        return found, f"At most {MAX_DURATION_S:.0f} s are replayed; split it."
    return None


def _about_numbers(plan: Plan) -> _Wrong | None:
    try:
        p, q = np.abs(plan.positions_m()), np.abs(plan.quaternions_wxyz()).max(axis=1)
        widths = _floats(w.width_m for w in plan.tau if w.width_m is not None)
        joints = _floats(value for w in plan.tau for value in w.joints_rad or ())
    except OverflowError:  # an integer of hundreds of digits
        return "has numbers that are too large", "Send metres, radians and unit quaternions."
    # Comparisons that what is no number fails.
    if not (np.all(p < _FARTHEST_M) and np.all((q > _SHORTEST) & (q < _LONGEST))):
        found = "has poses that are not finite or out of this world, or quaternions that are none"
        return found, "Send p_m in metres and q_wxyz of unit length."
    if not (np.isfinite(widths).all() and np.isfinite(joints).all()):
        found = "has joints or gripper widths that are not finite"
        return found, "Send joints_rad and width_m as numbers, or leave them out."
    low, high = (float(f(widths)) if len(widths) else 0.0 for f in (np.min, np.max))
    if low < -WIDTH_SLACK_M or high > MAX_WIDTH_M + WIDTH_SLACK_M:
        found = f"has gripper widths from {low:.3f} to {high:.3f}"
        return found, f"width_m is the distance between the pads in metres, 0 to {MAX_WIDTH_M}."
    return None


def _floats(values: Iterable[float]) -> Float[np.ndarray, " num_values"]:
    return np.array(list(values), dtype=np.float64)


def _about_whose(plan: Plan, robot: RobotModel) -> _Wrong | None:
    if plan.frame != BASE_FRAME:
        return f"is in the frame {plan.frame!r}", f"Transform it to {BASE_FRAME!r}."
    if plan.robot != robot.name:
        hint = f"The robot that was described is {robot.name!r}."
        return f"is for the robot {plan.robot!r}", hint
    if plan.joint_names and set(plan.joint_names) != set(ARM_JOINTS):
        hint = f"The robot has {', '.join(ARM_JOINTS)}."
        return f"names the joints {', '.join(plan.joint_names)}", hint
    return None
