"""Pick and place as movements: around, straight down, straight up, around, straight down, away.

Straight lines are planned from the contact outwards and followed the other way where the arm goes
in: the branch of the inverse kinematics is then that of the grasp. Where nothing may touch, the
search plans; it ends and begins a short way above each contact.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.task_file import Task
from twin.plan.path.planner import (
    Movement,
    NoPathError,
    PathConfig,
    plan_move,
    plan_straight,
    reversed_path,
)
from twin.plan.path.world import Carried
from twin.plan.problem import Grasp, Problem, Release
from twin.replay.clearance.bodies import GRIPPER
from twin.replay.clearance.monitor import Allowed
from twin.robot.config import IkConfig
from twin.robot.inverse import UrInverse, solutions
from twin.robot.model import RobotModel

LIFT_M = 0.06
"""How far an object is lifted, and let down, straight [m]."""
_LEAST_LIFT_M = 0.02
_SAME_RAD = 0.001
_LEAVE_MORE_M = (0.1, 0.05, 0.0)
"""Beyond the length of the approach, how far the hand goes straight back."""
_TURN = 2 * np.pi


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One movement of a pick and place, with what the gripper does meanwhile."""

    name: str
    """around, approach, lift, carry, lower or leave."""
    movement: Movement
    g: int
    """1 closed, 0 open."""


def contacts_of(task: Task, object_id: str, *, grasp: bool) -> Allowed:
    """Pairs that a task's stage allows which grasps, or releases, an object.

    Args:
        task: Its stages say what may touch.
        object_id: What is taken.
        grasp: The grasp's; else the release's.
    """
    key = "grasp" if grasp else "release"
    return frozenset(
        frozenset(pair)
        for stage in task.stages
        if stage.get(key) == object_id
        for pair in stage.get("allowed_contacts", ())
    )


def plan_transfer(
    problem: Problem,
    grasp: Grasp,
    release: Release,
    start_rad: Float[np.ndarray, " num_joints"],
    config: PathConfig,
    *,
    lift_m: float = LIFT_M,
    straight: bool = False,
) -> tuple[Leg, ...]:
    """Plan all movements from where the arm stands to where it has let go and left.

    Args:
        problem: Scene and robot, the object where the grasp was planned.
        grasp: How it is taken.
        release: Where it is let go.
        start_rad: Where the arm stands.
        config: Of every movement.
        lift_m: How far the object is lifted, and let down, straight; less where that is not free.
        straight: Carry it along a straight line of the tool, turned evenly; else around.

    Raises:
        NoPathError: One of the movements does not exist; its name comes first.
    """
    name = grasp.object_id
    task = problem.scene.task
    held = Carried(object_id=name, T_tcp_object=se3.invert(grasp.T_object_tcp))
    open_m, closed_m = grasp.open_m, grasp.width_m
    taking = contacts_of(task, name, grasp=True) | {frozenset((GRIPPER, name))}
    leaving = contacts_of(task, name, grasp=False) | {frozenset((GRIPPER, name))}
    robot = problem.robot
    with _named("approach"):
        T_base_tcp = robot.T_base_tcp(grasp.joints_rad)
        back = T_base_tcp @ _along_z(-grasp.pregrasp_m)
        out = plan_straight(problem, grasp.joints_rad, back, config, width_m=open_m, allowed=taking)
    with _named("around"):
        ends = out.path.joints_rad[-1:]
        around = plan_move(problem, start_rad, ends, config, width_m=open_m)
    with _named("lift"):
        lift = _straight_up(problem, grasp.joints_rad, config, closed_m, held, taking, lift_m)
    lifted = lift.path.joints_rad[-1]
    placed = replace(
        problem,
        scene=replace(
            problem.scene,
            Ts_base_object={**problem.scene.Ts_base_object, name: release.T_base_object},
        ),
    )
    grip: Allowed = frozenset({frozenset((GRIPPER, name))})
    failure = NoPathError(reason="unreachable", detail="no joints reach the release pose")
    for joints in nearest_solutions(robot, release.T_base_tcp, lifted, config.replay.ik):
        try:
            with _named("lower"):
                rise = _straight_up(problem, joints, config, closed_m, held, leaving, lift_m)
            with _named("carry"):
                over = rise.path.joints_rad[-1]
                carry = (
                    _carried_straight(problem, lifted, over, config, closed_m, held, grip)
                    if straight
                    else plan_move(
                        problem, lifted, over[None], config, width_m=closed_m,
                        carried=held, allowed=grip,
                    )
                )  # fmt: skip
            with _named("leave"):
                leave = _leave(placed, release, joints, config, open_m, leaving, grasp.pregrasp_m)
        except NoPathError as error:
            failure = error
            continue
        return (
            Leg(name="around", movement=around, g=0),
            Leg(name="approach", movement=_backwards(out), g=0),
            Leg(name="lift", movement=lift, g=1),
            Leg(name="carry", movement=carry, g=1),
            Leg(name="lower", movement=_backwards(rise), g=1),
            Leg(name="leave", movement=leave, g=0),
        )
    raise failure


@contextmanager
def _named(leg: str) -> Iterator[None]:
    """Say which movement does not exist."""
    try:
        yield
    except NoPathError as error:
        error.leg = leg
        raise


def _along_z(way_m: float) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[2, 3] = way_m
    return T


def _backwards(movement: Movement) -> Movement:
    return replace(
        movement,
        path=reversed_path(movement.path),
        decision=replace(movement.decision, clearance_m=movement.decision.clearance_m[::-1]),
    )


def _leave(
    placed: Problem,
    release: Release,
    joints_rad: Float[np.ndarray, " num_joints"],
    config: PathConfig,
    width_m: float,
    allowed: Allowed,
    least_m: float,
) -> Movement:
    """Straight back; the farther the better, for next to a rim nothing else may be planned."""
    for more_m in _LEAVE_MORE_M:
        away = release.T_base_tcp @ _along_z(-least_m - more_m)
        try:
            return plan_straight(placed, joints_rad, away, config, width_m=width_m, allowed=allowed)
        except NoPathError:
            if more_m == _LEAVE_MORE_M[-1]:
                raise
    raise NoPathError(reason="unreachable", detail="no way to leave is tried")


def _carried_straight(
    problem: Problem,
    start_rad: Float[np.ndarray, " num_joints"],
    goal_rad: Float[np.ndarray, " num_joints"],
    config: PathConfig,
    width_m: float,
    held: Carried,
    allowed: Allowed,
) -> Movement:
    """Carry along a straight line that ends on the branch on which the object is let down."""
    goal = problem.robot.T_base_tcp(goal_rad)
    movement = plan_straight(
        problem, start_rad, goal, config, width_m=width_m, carried=held, allowed=allowed
    )
    off_rad = float(np.abs(movement.path.joints_rad[-1] - goal_rad).max())
    if off_rad > _SAME_RAD:
        detail = f"the straight line ends {off_rad:.2f} rad from how the arm lets down"
        raise NoPathError(reason="branch", detail=detail)
    return movement


def _straight_up(
    problem: Problem,
    joints_rad: Float[np.ndarray, " num_joints"],
    config: PathConfig,
    width_m: float,
    held: Carried,
    allowed: Allowed,
    lift_m: float,
) -> Movement:
    """Lift as far as is free and within reach, at least two centimetres."""
    rise_m = lift_m
    while True:
        T = problem.robot.T_base_tcp(joints_rad)
        T[2, 3] += rise_m
        try:
            return plan_straight(
                problem, joints_rad, T, config, width_m=width_m, carried=held, allowed=allowed
            )
        except NoPathError:
            if rise_m / 2 < _LEAST_LIFT_M:
                raise
        rise_m /= 2


def nearest_solutions(
    robot: RobotModel,
    T_base_tcp: Float[np.ndarray, "4 4"],
    near_rad: Float[np.ndarray, " num_joints"],
    config: IkConfig,
) -> list[Float[np.ndarray, " num_joints"]]:
    """Joints that reach a pose, each turned as near as its limits let it, nearest first.

    Args:
        robot: Any arm; one with the geometry of a UR gives all its branches.
        T_base_tcp: Where the tool is wanted.
        near_rad: Where the arm comes from.
        config: When a pose counts as reached.
    """
    inverse = UrInverse.for_robot(robot)
    if inverse is not None:
        raw, valid, _ = inverse.solve(T_base_tcp[None])
        found = list(raw[0, valid[0]])
    else:
        found = [item.joints_rad for item in solutions(robot, T_base_tcp, config) if item.reached]
    turned = []
    for joints in found:
        wanted = joints + _TURN * np.rint((near_rad - joints) / _TURN)
        inside = (wanted >= robot.lower_rad) & (wanted <= robot.upper_rad)
        turned.append(np.where(inside, wanted, joints))
    return sorted(turned, key=lambda joints: float(np.abs(joints - near_rad).sum()))
