"""From waypoints to a dense joint path, and the IK factor of I(tau) (errata resolution 9).

The IK indicator is 1 when joints exist within their limits that reach every pose within the
tolerance, when no joint jumps along the interpolated path, and when no links meet.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby, pairwise
from math import factorial
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline, PPoly, make_interp_spline

from bridge.episode.executions import whose
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.robots.robot import Robot
from bridge.task.causes import Cause
from bridge.task.plan import Plan, Waypoint
from twin.errors import TwinError
from twin.replay.clearance.bodies import own_links_touch
from twin.replay.config import PATH_RATE_HZ, PATH_STEP_S
from twin.replay.failure import Failure
from twin.robot import inverse
from twin.robot.collision import RobotHulls
from twin.robot.follow import Clearance, follow_poses
from twin.robot.inverse import pose_error, solve_ik
from twin.robot.model import RobotModel

MAX_JOINT_STEP_RAD = 0.3
"""Largest change of a joint within one path step; more is a jump [rad]."""
_LIMIT_SLACK_RAD = 1e-3
"""Recorded and rounded joints may exceed a limit by as little as this."""


def outside_limits(
    robot: RobotModel,
    times_ns: Int[np.ndarray, " num_steps"],
    joints_rad: Float[np.ndarray, "num_steps num_joints"],
) -> list[Failure]:
    """Name the first joint that is beyond its limits by more than rounding."""
    beyond = np.maximum(robot.lower_rad - joints_rad, joints_rad - robot.upper_rad)
    return [
        Failure(
            t_ns=int(times_ns[index]),
            cause=Cause.JOINT_LIMIT,
            bodies=(robot.joints[joint],),
            detail=f"{robot.joints[joint]} is at {joints_rad[index, joint]:.3f} rad, "
            f"{beyond[index, joint]:.3f} rad beyond its limits, "
            f"{robot.lower_rad[joint]:.3f} to {robot.upper_rad[joint]:.3f} rad",
        )
        for index, joint in np.argwhere(~(beyond <= _LIMIT_SLACK_RAD)).tolist()[:1]
    ]


def jumps(
    times_ns: Int[np.ndarray, " num_times"],
    joints_rad: Float[np.ndarray, "num_times num_joints"],
    robot: RobotModel,
) -> list[Failure]:
    """Find the first jump between neighbouring postures."""
    steps = np.abs(np.diff(joints_rad, axis=0))
    over = np.argwhere(~(steps <= MAX_JOINT_STEP_RAD)).tolist()
    return [
        Failure(
            t_ns=int(times_ns[index]),
            cause=Cause.JOINT_JUMP,
            bodies=(robot.joints[joint],),
            detail=f"{robot.joints[joint]} changes by {steps[index, joint]:.2f} rad within "
            f"{PATH_STEP_S:g} s, the limit is {MAX_JOINT_STEP_RAD:g} rad",
        )
        for index, joint in over[:1]
    ]


MAX_DURATION_S = 600.0
"""Longest trajectory that is replayed [s]."""
STANDS_M = 0.002
MAX_WAIT_S = 10.0
"""A plan that has waited for longer before it moves was judged in another world."""
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
        super().__init__(f"{whose(plan_id)} {found}. {hint}")


def check_usable(plan: Plan, robot: RobotModel) -> None:
    """Refuse what no robot, or not this one, could follow."""
    wrong = (
        _about_times(plan)
        or _about_whose(plan, robot)
        or _about_numbers(plan, robot.record)
        or _about_waiting(plan)
        or _about_grasps(plan, robot.record)
    )
    if wrong is not None:
        found, hint = wrong
        raise UnusablePlanError(plan_id=plan.id, found=found, hint=hint)


_Wrong = tuple[str, str]
"""What was found, and what to do."""


def _about_times(plan: Plan) -> _Wrong | None:
    if not plan.tau:
        return "has no waypoints", "Send tau."
    times = [waypoint.t_ns for waypoint in plan.tau]  # of any size: JSON has no largest integer
    if times[0] < 0 or any(b <= a for a, b in pairwise(times)):
        found = "has waypoint times that do not increase from 0"
        return found, "t_ns counts from the start of the trajectory."
    if times[0] > MAX_WAIT_S * 1e9:
        found = f"begins at {times[0] * 1e-9:.0f} s"
        return found, "t_ns counts from the start of the trajectory, not from 1970."
    if times[-1] > MAX_DURATION_S * 1e9:
        found = f"lasts {times[-1] * 1e-9:.0f} s"
        return found, f"At most {MAX_DURATION_S:.0f} s are replayed; split it."
    return None


def _about_numbers(plan: Plan, robot: Robot) -> _Wrong | None:
    try:
        p, q = np.abs(plan.positions_m()), np.abs(plan.quaternions_wxyz()).max(axis=1)
        widths = np.array([w.width_m for w in plan.tau if w.width_m is not None], dtype=np.float64)
        joints = np.array([v for w in plan.tau for v in w.joints_rad or ()], dtype=np.float64)
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
    most_m = robot.gripper.max_width_m
    if low < -WIDTH_SLACK_M or high > most_m + WIDTH_SLACK_M:
        found = f"has gripper widths from {low:.3f} to {high:.3f}"
        return found, f"width_m is the distance between the pads in metres, 0 to {most_m}."
    return None


def _about_waiting(plan: Plan) -> _Wrong | None:
    places, first = plan.positions_m(), plan.tau[0]
    moves = np.linalg.norm(places - places[0], axis=1) > STANDS_M
    moves |= np.array([waypoint.g != first.g for waypoint in plan.tau])
    begins = int(np.argmax(moves)) - 1 if moves.any() else len(moves) - 1
    wait_s = plan.tau[max(begins, 0)].t_ns * 1e-9
    if wait_s <= MAX_WAIT_S:
        return None
    hint = f"At most {MAX_WAIT_S:.0f} s are judged ahead; send it when it is to move."
    return f"waits {wait_s:.0f} s before it moves", hint


def _about_grasps(plan: Plan, robot: Robot) -> _Wrong | None:
    grasps = any(w.g == 1 for w in plan.tau) or any(stage.grasp for stage in plan.stages)
    if grasps and not robot.gripper.fingers:
        found = f"closes a gripper, and the tool of {robot.name!r} has no fingers"
        return found, "Send plans without grasps, g = 0 throughout, or describe its gripper."
    return None


def _about_whose(plan: Plan, robot: RobotModel) -> _Wrong | None:
    base = robot.record.base_frame
    if plan.frame != base:
        return f"is in the frame {plan.frame!r}", f"Transform it to {base!r}."
    if plan.robot != robot.name:
        hint = f"The robot that was described is {robot.name!r}."
        return f"is for the robot {plan.robot!r}", hint
    if plan.joint_names and set(plan.joint_names) != set(robot.joints):
        hint = f"The robot has {', '.join(robot.joints)}."
        return f"names the joints {', '.join(plan.joint_names)}", hint
    return None


@dataclass(frozen=True, kw_only=True)
class JointPath:
    """Arm joints and commanded gripper width over time; how the controller goes between knots."""

    times_ns: Int[np.ndarray, " num_knots"]
    joints_rad: Float[np.ndarray, "num_knots num_joints"]
    width_times_ns: Int[np.ndarray, " num_widths"]
    width_m: Float[np.ndarray, " num_widths"]
    """Each width holds until the next one is commanded."""
    first_close_ns: int | None
    """When the gripper is first told to close."""
    interpolation: Literal["linear", "cubic", "quintic"] = "linear"
    waypoints_ns: Int[np.ndarray, " _"] | None = None
    """Knots that a plan gave; those between them are ours. None: all are given."""
    moving: bool = False
    """A part of a motion: not at rest before its start and after its end."""

    @cached_property
    def curve(self) -> PPoly | None:
        """Joints over seconds, at rest at both ends; None: straight lines."""
        if self.interpolation == "linear" or len(self.times_ns) < 2:
            return None
        times_s = self.times_ns * 1e-9
        if self.interpolation == "cubic":
            return CubicSpline(times_s, self.joints_rad, bc_type="clamped")
        rest = [(order, np.zeros(self.joints_rad.shape[1])) for order in (1, 2)]
        spline = make_interp_spline(times_s, self.joints_rad, k=5, bc_type=(rest, rest))
        knots = spline.t[5:-5]
        return PPoly([spline(knots[:-1], 5 - k) / factorial(5 - k) for k in range(6)], knots)

    def joints_at(
        self, times_ns: Int[np.ndarray, " num_queries"]
    ) -> Float[np.ndarray, "num_queries num_joints"]:
        """Where they are commanded; after the end the last posture holds."""
        if self.curve is not None:
            ends_s = self.times_ns[[0, -1]] * 1e-9
            return np.asarray(self.curve(np.clip(times_ns * 1e-9, *ends_s)))
        columns = [np.interp(times_ns, self.times_ns, column) for column in self.joints_rad.T]
        return np.stack(columns, axis=1)

    def width_at(
        self, times_ns: Int[np.ndarray, " num_queries"]
    ) -> Float[np.ndarray, " num_queries"]:
        """Commanded widths."""
        index = np.searchsorted(self.width_times_ns, times_ns, side="right") - 1
        return self.width_m[np.clip(index, 0, len(self.width_m) - 1)]

    def with_late_gripper(self, delay_s: float) -> "JointPath":
        """The same motion with every gripper command this much later."""
        delay_ns = round(delay_s * 1e9)
        if delay_ns == 0:
            return self
        first = self.first_close_ns
        return replace(
            self,
            width_times_ns=self.width_times_ns + delay_ns,
            first_close_ns=None if first is None else first + delay_ns,
        )

    def end_ns(self) -> int:
        """Time of the last knot."""
        return int(self.times_ns[-1])

    def dense_times_ns(self, rate_hz: int = PATH_RATE_HZ) -> Int[np.ndarray, " num_times"]:
        """Evenly spaced times from start to end, at least so many a second."""
        count = int(np.ceil(self.end_ns() * 1e-9 * rate_hz)) + 1
        return np.unique(np.linspace(0, self.end_ns(), count).round().astype(np.int64))


def path_of_plan(
    plan: Plan,
    robot: RobotModel,
    *,
    clearance: Clearance | None = None,
    start_rad: Float[np.ndarray, " num_joints"] | None = None,  # a plan without joints begins here
) -> tuple[JointPath, list[Failure], int | None]:
    """Solve a plan's waypoints.

    Joints given by the plan are the warm start and count only where their own forward kinematics
    reaches the waypoint. Waypoints without joints are joined by straight tool motion.

    Returns the path up to the last pose that could be reached, what failed, and the time of the
    first unreachable pose (None when all were reached).
    """
    check_usable(plan, robot)
    knots = _Knots()
    for is_open, group in groupby(_targets(plan, robot), key=lambda target: target.given is None):
        run = list(group)
        if is_open:
            begin_rad = knots.joints[-1] if knots.joints else start_rad
            Ts = np.stack([target.T for target in run])
            ways = follow_poses(robot, Ts, start_rad=begin_rad, clearance=clearance)
            for target, joints, reached in zip(run, ways.joints_rad, ways.reached, strict=True):
                if not reached:
                    knots.stop(robot, target, joints)
                    break
                knots.add(target.t_ns, joints)
        else:
            _take_given(knots, run, robot)
        if knots.unreachable_ns is not None:
            break
    path = JointPath(
        times_ns=np.array(knots.times_ns, dtype=np.int64),
        joints_rad=np.stack(knots.joints),
        width_times_ns=plan.times_ns(),
        width_m=np.array([_width(waypoint, robot.record) for waypoint in plan.tau]),
        first_close_ns=next((w.t_ns for w in plan.tau if w.g == 1), None),
        interpolation=robot.record.interpolation,
        waypoints_ns=plan.times_ns(),
    )
    return path, knots.failures, knots.unreachable_ns


@dataclass(frozen=True, kw_only=True)
class _Target:
    """A pose to pass, with joints where the plan gives some."""

    t_ns: int
    T: Float[np.ndarray, "4 4"]
    given: Float[np.ndarray, " num_joints"] | None = None


@dataclass
class _Knots:
    """What has been solved so far."""

    times_ns: list[int] = field(default_factory=list)
    joints: list[Float[np.ndarray, " num_joints"]] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    unreachable_ns: int | None = None

    def add(self, t_ns: int, joints: Float[np.ndarray, " num_joints"]) -> None:
        self.times_ns.append(t_ns)
        self.joints.append(joints)

    def stop(
        self, robot: RobotModel, target: _Target, nearest: Float[np.ndarray, " num_joints"]
    ) -> None:
        """Note a pose that cannot be reached; a path needs at least one knot."""
        self.unreachable_ns = target.t_ns
        (error_m, _), (x, y, z) = pose_error(robot, nearest, target.T), target.T[:3, 3]
        detail = f"no joints reach ({x:.3f}, {y:.3f}, {z:.3f}) m; the nearest miss it by "
        detail += f"{error_m * 1e3:.1f} mm"
        failure = Failure(t_ns=target.t_ns, cause=Cause.UNREACHABLE, detail=detail)
        self.failures.append(failure)
        if not self.joints:
            self.add(target.t_ns, nearest)


def _take_given(knots: _Knots, run: list[_Target], robot: RobotModel) -> None:
    """Take the plan's joints where they reach its own poses, and the nearest that do elsewhere."""
    for target in run:
        given = target.given
        if given is None:
            continue
        failure = _check_given(robot, target.t_ns, given, target.T)
        if failure is not None:
            solution = solve_ik(robot, target.T, warm_start_rad=given)
            given = solution.joints_rad
            if not solution.reached:
                knots.stop(robot, target, given)
                return
            knots.failures.append(failure)
        knots.add(target.t_ns, given)


def _targets(plan: Plan, robot: RobotModel) -> list[_Target]:
    """Waypoints, and where joints are not given the poses on the straight line between them."""
    times = plan.times_ns()
    quats = plan.quaternions_wxyz()
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)  # slerp needs unit length
    poses = PoseTrajectory(times, plan.positions_m(), quats)
    order = (
        [list(plan.joint_names).index(name) for name in robot.joints] if plan.joint_names else None
    )
    targets: list[_Target] = []
    step_ns = round(PATH_STEP_S * 1e9)
    for index, waypoint in enumerate(plan.tau):
        given = _given_joints(plan.id, waypoint, len(robot.joints), order)
        if given is None and index > 0:
            count = int(np.ceil((times[index] - times[index - 1]) / step_ns))
            between = np.linspace(times[index - 1], times[index], count + 1)[1:-1]
            stamps = between.round().astype(np.int64)
            Ts = poses.at(stamps).transforms()
            targets += [_Target(t_ns=int(t), T=T) for t, T in zip(stamps, Ts, strict=True)]
        q = np.array(waypoint.q_wxyz, dtype=np.float64)
        T_waypoint = se3.transform_from(q, np.array(waypoint.p_m))
        targets.append(_Target(t_ns=waypoint.t_ns, T=T_waypoint, given=given))
    return targets


def _given_joints(
    plan_id: str, waypoint: Waypoint, count: int, order: list[int] | None
) -> Float[np.ndarray, " num_joints"] | None:
    if waypoint.joints_rad is None:
        return None
    joints = np.array(waypoint.joints_rad, dtype=np.float64)
    if len(joints) != count:
        raise UnusablePlanError(
            plan_id=plan_id,
            found=f"gives {len(joints)} joints at {waypoint.t_ns * 1e-9:.2f} s",
            hint=f"Give {count}, or none.",
        )
    return joints if order is None else joints[order]


def _width(waypoint: Waypoint, robot: Robot) -> float:
    if waypoint.width_m is not None:
        return float(waypoint.width_m)
    return 0.0 if waypoint.g == 1 else robot.gripper.max_width_m


def _check_given(
    robot: RobotModel,
    t_ns: int,
    given: Float[np.ndarray, " num_joints"],
    T: Float[np.ndarray, "4 4"],
) -> Failure | None:
    """Say why a plan's own joints are no solution for its pose; None when they are."""
    outside = outside_limits(robot, np.array([t_ns]), given[None])
    if outside:
        return outside[0]
    offset, angle = pose_error(robot, given, T)
    if offset <= inverse.POSITION_TOLERANCE_M and angle <= inverse.ROTATION_TOLERANCE_RAD:
        return None
    return Failure(
        t_ns=t_ns,
        cause=Cause.JOINTS_DISAGREE,
        detail=f"the plan's joints put the tool {offset * 1e3:.1f} mm and "
        f"{np.degrees(angle):.2f} degrees from its own pose",
    )


def check_path(path: JointPath, robot: RobotModel, hulls: RobotHulls) -> list[Failure]:
    """Find joint limits, jumps, self-collision on an interpolated path; the hulls are moved."""
    times = path.dense_times_ns()
    joints = path.joints_at(times)
    failures = outside_limits(robot, path.times_ns, path.joints_rad)
    if path.curve is not None and not failures:  # it may swing out between its knots
        failures = outside_limits(robot, times, joints)
    failures += jumps(times, joints, robot)
    widths = path.width_at(times)
    links_touch = own_links_touch(hulls)
    for t_ns, row, width in zip(times, joints, widths, strict=True):
        hulls.place(row, float(width))
        if links_touch():
            distance_m, links = hulls.self_distance()
            failures.append(
                Failure(
                    t_ns=int(t_ns),
                    cause=Cause.SELF_COLLISION,
                    bodies=links,
                    detail=f"{links[0]} is {-distance_m * 1e3:.1f} mm inside {links[1]}",
                )
            )
            break
    return failures
