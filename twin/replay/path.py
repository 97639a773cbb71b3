"""From waypoints to a dense joint path, and the IK factor of I(tau) (errata resolution 9).

The IK indicator is 1 when joints exist within their limits that reach every pose within the
tolerance, when no joint jumps along the interpolated path, and when no links meet.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.plan import Plan, Waypoint
from bridge.task.robot import ARM_JOINTS, BASE_FRAME, MAX_WIDTH_M
from twin.errors import TwinError
from twin.replay.config import ReplayConfig
from twin.replay.failure import Failure
from twin.robot.collision import RobotHulls
from twin.robot.inverse import pose_error, solve_ik
from twin.robot.model import RobotModel

MAX_DURATION_S = 600.0
"""Longest trajectory that is replayed [s]."""
_LIMIT_SLACK_RAD = 1e-3
_SPEED_SLACK = 1.02
"""Recorded and rounded joints may exceed a limit by as little as this."""


class UnusablePlanError(TwinError):
    """A plan cannot be replayed at all."""

    def __init__(self, *, plan_id: str, found: str, hint: str) -> None:
        """Remember the plan."""
        self.plan_id = plan_id
        super().__init__(f"plan {plan_id!r} {found}. {hint}")


@dataclass(frozen=True, kw_only=True)
class JointPath:
    """Arm joints and commanded gripper width over time, straight lines between the knots."""

    times_ns: Int[np.ndarray, " num_knots"]
    joints_rad: Float[np.ndarray, "num_knots num_joints"]
    width_times_ns: Int[np.ndarray, " num_widths"]
    width_m: Float[np.ndarray, " num_widths"]
    """Each width holds until the next one is commanded."""
    first_close_ns: int | None
    """When the gripper is first told to close."""

    def joints_at(
        self, times_ns: Int[np.ndarray, " num_queries"]
    ) -> Float[np.ndarray, "num_queries num_joints"]:
        """Interpolate linearly; after the end the last posture holds."""
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

    def dense_times_ns(self, step_s: float) -> Int[np.ndarray, " num_times"]:
        """Evenly spaced times from start to end, at most one step apart."""
        count = int(np.ceil(self.end_ns() * 1e-9 / step_s)) + 1
        return np.unique(np.linspace(0, self.end_ns(), count).round().astype(np.int64))


def path_of_plan(
    plan: Plan, robot: RobotModel, config: ReplayConfig
) -> tuple[JointPath, list[Failure], int | None]:
    """Solve a plan's waypoints.

    Joints given by the plan are the warm start and count only where their own forward kinematics
    reaches the waypoint. Waypoints without joints are joined by straight tool motion.

    Returns:
        The path up to the last pose that could be reached, what failed, and the time of the first
        unreachable pose (None when all were reached).

    Raises:
        UnusablePlanError: No waypoints, times that do not increase, another frame or joint order.
    """
    _check_usable(plan)
    times: list[int] = []
    joints: list[Float[np.ndarray, " num_joints"]] = []
    failures: list[Failure] = []
    unreachable_ns = None
    for t_ns, T, given in _targets(plan, config):
        failure = None if given is None else _check_given(robot, t_ns, given, T, config)
        if given is not None and failure is None:
            solved = given
        else:
            warm = given if given is not None else (joints[-1] if joints else None)
            solution = solve_ik(robot, T, config.ik, warm_start_rad=warm)
            solved = solution.joints_rad
            if not solution.reached:
                failure = _unreachable(t_ns, T, solution.position_error_m)
                unreachable_ns = t_ns
        failures += [] if failure is None else [failure]
        if unreachable_ns is None or not joints:
            times.append(t_ns)
            joints.append(solved)
        if unreachable_ns is not None:
            break
    path = JointPath(
        times_ns=np.array(times, dtype=np.int64),
        joints_rad=np.stack(joints),
        width_times_ns=plan.times_ns(),
        width_m=np.array([_width(waypoint) for waypoint in plan.tau]),
        first_close_ns=next((w.t_ns for w in plan.tau if w.g == 1), None),
    )
    return path, failures, unreachable_ns


def _check_usable(plan: Plan) -> None:
    times = plan.times_ns()
    if len(times) == 0:
        raise UnusablePlanError(plan_id=plan.id, found="has no waypoints", hint="Send tau.")
    if times[0] < 0 or np.any(np.diff(times) <= 0):
        raise UnusablePlanError(
            plan_id=plan.id,
            found="has waypoint times that do not increase from 0",
            hint="t_ns counts from the start of the trajectory.",
        )
    if times[-1] > MAX_DURATION_S * 1e9:
        raise UnusablePlanError(
            plan_id=plan.id,
            found=f"lasts {times[-1] * 1e-9:.0f} s",
            hint=f"At most {MAX_DURATION_S:.0f} s are replayed; split it.",
        )
    numbers = np.concatenate([plan.positions_m(), plan.quaternions_wxyz()], axis=1)
    if not np.all(np.isfinite(numbers)) or np.any(np.abs(numbers[:, 3:]).max(axis=1) < 1e-6):
        raise UnusablePlanError(
            plan_id=plan.id,
            found="has poses that are not finite, or quaternions that are zero",
            hint="Send p_m in metres and q_wxyz of unit length.",
        )
    commands = [value for w in plan.tau for value in (w.width_m, *(w.joints_rad or ()))]
    if not np.all(np.isfinite([value for value in commands if value is not None])):
        raise UnusablePlanError(
            plan_id=plan.id,
            found="has joints or gripper widths that are not finite",
            hint="Send joints_rad and width_m as numbers, or leave them out.",
        )
    if plan.frame != BASE_FRAME:
        raise UnusablePlanError(
            plan_id=plan.id,
            found=f"is in the frame {plan.frame!r}",
            hint=f"Transform it to {BASE_FRAME!r}.",
        )
    if plan.joint_names and set(plan.joint_names) != set(ARM_JOINTS):
        raise UnusablePlanError(
            plan_id=plan.id,
            found=f"names the joints {', '.join(plan.joint_names)}",
            hint=f"The robot has {', '.join(ARM_JOINTS)}.",
        )


Target = tuple[int, Float[np.ndarray, "4 4"], Float[np.ndarray, " num_joints"] | None]


def _targets(plan: Plan, config: ReplayConfig) -> list[Target]:
    """Waypoints, and where joints are not given the poses on the straight line between them."""
    times = plan.times_ns()
    quats = plan.quaternions_wxyz()
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)  # slerp needs unit length
    poses = PoseTrajectory(times, plan.positions_m(), quats)
    order = (
        [list(plan.joint_names).index(name) for name in ARM_JOINTS] if plan.joint_names else None
    )
    targets: list[Target] = []
    step_ns = round(config.path_step_s * 1e9)
    for index, waypoint in enumerate(plan.tau):
        given = _given_joints(plan.id, waypoint, order)
        if given is None and index > 0:
            count = int(np.ceil((times[index] - times[index - 1]) / step_ns))
            between = np.linspace(times[index - 1], times[index], count + 1)[1:-1]
            stamps = between.round().astype(np.int64)
            Ts = poses.at(stamps).transforms()
            targets += [(int(t), T, None) for t, T in zip(stamps, Ts, strict=True)]
        q = np.array(waypoint.q_wxyz, dtype=np.float64)
        targets.append((waypoint.t_ns, se3.transform_from(q, np.array(waypoint.p_m)), given))
    return targets


def _given_joints(
    plan_id: str, waypoint: Waypoint, order: list[int] | None
) -> Float[np.ndarray, " num_joints"] | None:
    if waypoint.joints_rad is None:
        return None
    joints = np.array(waypoint.joints_rad, dtype=np.float64)
    if len(joints) != len(ARM_JOINTS):
        raise UnusablePlanError(
            plan_id=plan_id,
            found=f"gives {len(joints)} joints at {waypoint.t_ns * 1e-9:.2f} s",
            hint=f"Give {len(ARM_JOINTS)}, or none.",
        )
    return joints if order is None else joints[order]


def _width(waypoint: Waypoint) -> float:
    if waypoint.width_m is not None:
        return float(waypoint.width_m)
    return 0.0 if waypoint.g == 1 else MAX_WIDTH_M


def _unreachable(t_ns: int, T: Float[np.ndarray, "4 4"], error_m: float) -> Failure:
    x, y, z = T[:3, 3]
    return Failure(
        t_ns=t_ns,
        cause="unreachable",
        detail=f"no joints reach ({x:.3f}, {y:.3f}, {z:.3f}) m; "
        f"the nearest miss it by {error_m * 1e3:.1f} mm",
    )


def _check_given(
    robot: RobotModel,
    t_ns: int,
    given: Float[np.ndarray, " num_joints"],
    T: Float[np.ndarray, "4 4"],
    config: ReplayConfig,
) -> Failure | None:
    """Say why a plan's own joints are no solution for its pose; None when they are."""
    outside = _outside_limits(robot, given[None])[0]
    if np.any(outside):
        return _limit_failure(robot, t_ns, given, int(np.argmax(outside)))
    offset, angle = pose_error(robot, given, T)
    if offset <= config.ik.position_tolerance_m and angle <= config.ik.rotation_tolerance_rad:
        return None
    return Failure(
        t_ns=t_ns,
        cause="joints_disagree",
        detail=f"the plan's joints put the tool {offset * 1e3:.1f} mm and "
        f"{np.degrees(angle):.2f} degrees from its own pose",
    )


def check_path(
    path: JointPath, robot: RobotModel, hulls: RobotHulls, config: ReplayConfig
) -> list[Failure]:
    """Find joint limits, jumps, excess speed and self-collision along an interpolated path."""
    failures = []
    outside = _outside_limits(robot, path.joints_rad)
    if np.any(outside):
        knot, joint = (int(i) for i in np.argwhere(outside)[0])
        failures.append(
            _limit_failure(robot, int(path.times_ns[knot]), path.joints_rad[knot], joint)
        )
    times = path.dense_times_ns(config.path_step_s)
    joints = path.joints_at(times)
    failures += _jumps(times, joints, robot, config)
    widths = path.width_at(times)
    for t_ns, row, width in zip(times, joints, widths, strict=True):
        hulls.place(row, float(width))
        closest = hulls.self_distance()
        if closest.distance_m <= 0:
            failures.append(
                Failure(
                    t_ns=int(t_ns),
                    cause="self_collision",
                    bodies=closest.links,
                    detail=f"{closest.links[0]} is {-closest.distance_m * 1e3:.1f} mm inside "
                    f"{closest.links[1]}",
                )
            )
            break
    return failures


def _outside_limits(
    robot: RobotModel, joints_rad: Float[np.ndarray, "num_steps num_joints"]
) -> Bool[np.ndarray, "num_steps num_joints"]:
    return (joints_rad < robot.lower_rad - _LIMIT_SLACK_RAD) | (
        joints_rad > robot.upper_rad + _LIMIT_SLACK_RAD
    )


def _limit_failure(
    robot: RobotModel, t_ns: int, joints_rad: Float[np.ndarray, " num_joints"], joint: int
) -> Failure:
    return Failure(
        t_ns=t_ns,
        cause="joint_limit",
        bodies=(ARM_JOINTS[joint],),
        detail=f"{ARM_JOINTS[joint]} is at {joints_rad[joint]:.3f} rad, its limits are "
        f"{robot.lower_rad[joint]:.3f} to {robot.upper_rad[joint]:.3f} rad",
    )


def _jumps(
    times_ns: Int[np.ndarray, " num_times"],
    joints_rad: Float[np.ndarray, "num_times num_joints"],
    robot: RobotModel,
    config: ReplayConfig,
) -> list[Failure]:
    if len(times_ns) < 2:
        return []
    steps = np.abs(np.diff(joints_rad, axis=0))
    speeds = steps / (np.diff(times_ns)[:, None] * 1e-9)
    failures = []
    for cause, values, limit, unit in (
        ("joint_jump", steps, np.full(len(ARM_JOINTS), config.max_joint_step_rad), "rad"),
        ("joint_speed", speeds, robot.velocity_limit_rad_s * _SPEED_SLACK, "rad/s"),
    ):
        over = values > limit
        if np.any(over):
            index, joint = (int(i) for i in np.argwhere(over)[0])
            failures.append(
                Failure(
                    t_ns=int(times_ns[index]),
                    cause=cause,
                    bodies=(ARM_JOINTS[joint],),
                    detail=f"{ARM_JOINTS[joint]} changes by {values[index, joint]:.2f} {unit}, "
                    f"the limit is {limit[joint]:.2f} {unit}",
                )
            )
    return failures
