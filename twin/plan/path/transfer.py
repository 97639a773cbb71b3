"""Pick and place as movements: around, straight down, straight up, around, straight down, away."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from bridge.geometry import se3
from twin.plan.grasp.reach import nearest_solutions
from twin.plan.path.planner import (
    Movement,
    NoPathError,
    PathConfig,
    plan_move,
    plan_straight,
    reversed_path,
)
from twin.plan.path.world import Carried
from twin.plan.problem import Grasp, Joints, Pose, Problem, Release
from twin.replay.clearance.bodies import GRIPPER
from twin.replay.clearance.monitor import Allowed

LIFT_M = 0.06
_LEAST_LIFT_M = 0.02
_SAME_RAD = 0.001
_LEAVE_MORE_M = (0.1, 0.05, 0.0)
"""Beyond the length of the approach, how far the hand goes straight back."""


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One movement of a pick and place, with what the gripper does meanwhile."""

    name: str
    """around, approach, lift, carry, lower or leave."""
    movement: Movement
    g: int
    """1 closed, 0 open."""


def plan_transfer(
    problem: Problem,
    grasp: Grasp,
    release: Release,
    start_rad: Joints,
    config: PathConfig,
    *,
    lift_m: float = LIFT_M,
    straight: bool = False,
    tool_m_s: Mapping[str, float] | None = None,
) -> tuple[Leg, ...]:
    """Plan all movements from where the arm stands to where it has let go and left.

    Args:
        lift_m: How far the object is lifted, and let down, straight; less where that is not free.
        straight: Carry it along a straight line of the tool, turned evenly; else around.
        tool_m_s: How fast the tool may be on some legs.
    """
    transfer = _Transfer(
        problem=problem,
        grasp=grasp,
        release=release,
        config=config,
        lift_m=lift_m,
        straight=straight,
        tool_m_s=tool_m_s or {},
    )
    taken = transfer.take(start_rad)
    lifted_rad = taken[-1].movement.path.joints_rad[-1]
    failure = NoPathError(reason="unreachable", detail="no joints reach the release pose")
    for joints_rad in nearest_solutions(problem.robot, release.T_base_tcp, lifted_rad):
        try:
            return (*taken, *transfer.put(lifted_rad, joints_rad))
        except NoPathError as error:
            failure = error
    raise failure


@dataclass(frozen=True, kw_only=True)
class _Transfer:
    """One object from where it is to where it is let go."""

    problem: Problem
    grasp: Grasp
    release: Release
    config: PathConfig
    lift_m: float
    straight: bool
    tool_m_s: Mapping[str, float]

    def _driven(self, leg: str) -> PathConfig:
        return replace(self.config, tool_m_s=self.tool_m_s.get(leg, 0.0))

    def take(self, start_rad: Joints) -> tuple[Leg, Leg, Leg]:
        """From where the arm stands to the lifted object."""
        grasp = self.grasp
        taking = self._touching("grasp")
        with _named("approach"):
            T_base_tcp = self.problem.robot.T_base_tcp(grasp.joints_rad)
            back = T_base_tcp @ _along_z(-grasp.pregrasp_m)
            out = plan_straight(
                self.problem, grasp.joints_rad, back, self._driven("approach"),
                width_m=grasp.open_m, allowed=taking,
            )  # fmt: skip
        with _named("around"):
            ends = out.path.joints_rad[-1:]
            driven = self._driven("around")
            around = plan_move(self.problem, start_rad, ends, driven, width_m=grasp.open_m)
        with _named("lift"):
            lift = self._straight_up(grasp.joints_rad, taking, self._driven("lift"))
        return (
            Leg(name="around", movement=around, g=0),
            Leg(name="approach", movement=_backwards(out), g=0),
            Leg(name="lift", movement=lift, g=1),
        )

    def put(self, lifted_rad: Joints, joints_rad: Joints) -> tuple[Leg, Leg, Leg]:
        """From the lifted object to where the arm has left, let go with these joints."""
        leaving = self._touching("release")
        with _named("lower"):
            rise = self._straight_up(joints_rad, leaving, self._driven("lower"))
        with _named("carry"):
            over_rad = rise.path.joints_rad[-1]
            carry = (self._carry_straight if self.straight else self._carry)(lifted_rad, over_rad)
        with _named("leave"):
            leave = self._leave(joints_rad, leaving)
        return (
            Leg(name="carry", movement=carry, g=1),
            Leg(name="lower", movement=_backwards(rise), g=1),
            Leg(name="leave", movement=leave, g=0),
        )

    @property
    def _held(self) -> Carried:
        return Carried(
            object_id=self.grasp.object_id, T_tcp_object=se3.invert(self.grasp.T_object_tcp)
        )

    @property
    def _grip(self) -> Allowed:
        return frozenset({frozenset((GRIPPER, self.grasp.object_id))})

    def _touching(self, verb: str) -> Allowed:
        return self.problem.contacts_of(verb, self.grasp.object_id) | self._grip

    def _straight_up(self, joints_rad: Joints, allowed: Allowed, config: PathConfig) -> Movement:
        """Lift as far as is free and within reach, at least two centimetres."""
        rise_m = self.lift_m
        while True:
            T = self.problem.robot.T_base_tcp(joints_rad)
            T[2, 3] += rise_m
            try:
                return plan_straight(
                    self.problem, joints_rad, T, config, width_m=self.grasp.width_m,
                    carried=self._held, allowed=allowed,
                )  # fmt: skip
            except NoPathError:
                if rise_m / 2 < _LEAST_LIFT_M:
                    raise
            rise_m /= 2

    def _carry(self, start_rad: Joints, goal_rad: Joints) -> Movement:
        """Carry around whatever stands in between."""
        return plan_move(
            self.problem, start_rad, goal_rad[None], self._driven("carry"),
            width_m=self.grasp.width_m, carried=self._held, allowed=self._grip,
        )  # fmt: skip

    def _carry_straight(self, start_rad: Joints, goal_rad: Joints) -> Movement:
        """Carry along a straight line that ends on the branch on which the object is let down."""
        goal = self.problem.robot.T_base_tcp(goal_rad)
        movement = plan_straight(
            self.problem, start_rad, goal, self._driven("carry"), width_m=self.grasp.width_m,
            carried=self._held, allowed=self._grip,
        )  # fmt: skip
        off_rad = float(np.abs(movement.path.joints_rad[-1] - goal_rad).max())
        if off_rad > _SAME_RAD:
            detail = f"the straight line ends {off_rad:.2f} rad from how the arm lets down"
            raise NoPathError(reason="branch", detail=detail)
        return movement

    def _leave(self, joints_rad: Joints, allowed: Allowed) -> Movement:
        """Straight back; the farther the better, for next to a rim nothing else may be planned."""
        scene, release = self.problem.scene, self.release
        poses = {**scene.Ts_base_object, self.grasp.object_id: release.T_base_object}
        placed = replace(self.problem, scene=replace(scene, Ts_base_object=poses))
        failure = NoPathError(reason="unreachable")
        for more_m in _LEAVE_MORE_M:
            away = release.T_base_tcp @ _along_z(-self.grasp.pregrasp_m - more_m)
            try:
                return plan_straight(
                    placed, joints_rad, away, self._driven("leave"), width_m=self.grasp.open_m,
                    allowed=allowed,
                )  # fmt: skip
            except NoPathError as error:
                failure = error
        raise failure


@contextmanager
def _named(leg: str) -> Iterator[None]:
    """Say which movement does not exist."""
    try:
        yield
    except NoPathError as error:
        error.leg = leg
        raise


def _along_z(way_m: float) -> Pose:
    T = np.eye(4)
    T[2, 3] = way_m
    return T


def _backwards(movement: Movement) -> Movement:
    return replace(movement, path=reversed_path(movement.path))
