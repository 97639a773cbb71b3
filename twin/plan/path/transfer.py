"""Pick and place as movements: around, straight down, straight up, around, straight down, away."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from bridge.geometry import se3
from twin.plan.grasp.reach import nearest_solutions
from twin.plan.path.planner import Mover, NoPathError, PathConfig, reversed_path
from twin.plan.path.world import Carried
from twin.plan.problem import Grasp, Joints, Pose, Problem, Release, TimedPath
from twin.replay.clearance.bodies import GRIPPER
from twin.replay.clearance.monitor import Allowed

LEGS = ("around", "approach", "lift", "carry", "lower", "leave")
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
    path: TimedPath
    g: int
    """1 closed, 0 open."""
    width_m: float
    """Between the pads."""


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
    lifted_rad = taken[-1].path.joints_rad[-1]
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

    def _open(self, leg: str, verb: str = "") -> Mover:
        """What an open hand moves with on a leg; it may touch what a verb's stages let touch."""
        return self._mover(leg, self.grasp.open_m, self._touching(verb) if verb else frozenset())

    def _holding(self, leg: str, verb: str = "") -> Mover:
        """What the hand moves with that holds the object."""
        held = Carried(
            object_id=self.grasp.object_id, T_tcp_object=se3.invert(self.grasp.T_object_tcp)
        )
        allowed = self._touching(verb) if verb else self._grip
        return self._mover(leg, self.grasp.width_m, allowed, held)

    def _mover(
        self, leg: str, width_m: float, allowed: Allowed, held: Carried | None = None
    ) -> Mover:
        config = replace(self.config, tool_m_s=self.tool_m_s.get(leg, 0.0))
        return Mover(
            problem=self.problem, config=config, width_m=width_m, carried=held, allowed=allowed
        )

    def take(self, start_rad: Joints) -> tuple[Leg, Leg, Leg]:
        """From where the arm stands to the lifted object."""
        grasp = self.grasp
        with _named("approach"):
            T_base_tcp = self.problem.robot.T_base_tcp(grasp.joints_rad)
            back = T_base_tcp @ _along_z(-grasp.pregrasp_m)
            out = self._open("approach", "grasp").straight(grasp.joints_rad, back)
        with _named("around"):
            around = self._open("around").around(start_rad, out.joints_rad[-1:])
        with _named("lift"):
            lift = self._straight_up(grasp.joints_rad, self._holding("lift", "grasp"))
        return (
            Leg(name="around", path=around, g=0, width_m=grasp.open_m),
            Leg(name="approach", path=reversed_path(out), g=0, width_m=grasp.open_m),
            Leg(name="lift", path=lift, g=1, width_m=grasp.width_m),
        )

    def put(self, lifted_rad: Joints, joints_rad: Joints) -> tuple[Leg, Leg, Leg]:
        """From the lifted object to where the arm has left, let go with these joints."""
        grasp = self.grasp
        with _named("lower"):
            rise = self._straight_up(joints_rad, self._holding("lower", "release"))
        with _named("carry"):
            over_rad = rise.joints_rad[-1]
            mover = self._holding("carry")
            if self.straight:
                carry = self._carry_straight(mover, lifted_rad, over_rad)
            else:
                carry = mover.around(lifted_rad, over_rad[None])
        with _named("leave"):
            leave = self._leave(joints_rad)
        return (
            Leg(name="carry", path=carry, g=1, width_m=grasp.width_m),
            Leg(name="lower", path=reversed_path(rise), g=1, width_m=grasp.width_m),
            Leg(name="leave", path=leave, g=0, width_m=grasp.open_m),
        )

    @property
    def _grip(self) -> Allowed:
        return frozenset({frozenset((GRIPPER, self.grasp.object_id))})

    def _touching(self, verb: str) -> Allowed:
        return self.problem.contacts_of(verb, self.grasp.object_id) | self._grip

    def _straight_up(self, joints_rad: Joints, mover: Mover) -> TimedPath:
        """Lift as far as is free and within reach, at least two centimetres."""
        rise_m = self.lift_m
        while True:
            T = self.problem.robot.T_base_tcp(joints_rad)
            T[2, 3] += rise_m
            try:
                return mover.straight(joints_rad, T)
            except NoPathError:
                if rise_m / 2 < _LEAST_LIFT_M:
                    raise
            rise_m /= 2

    def _carry_straight(self, mover: Mover, start_rad: Joints, goal_rad: Joints) -> TimedPath:
        """Carry along a straight line that ends on the branch on which the object is let down."""
        path = mover.straight(start_rad, self.problem.robot.T_base_tcp(goal_rad))
        off_rad = float(np.abs(path.joints_rad[-1] - goal_rad).max())
        if off_rad > _SAME_RAD:
            detail = f"the straight line ends {off_rad:.2f} rad from how the arm lets down"
            raise NoPathError(reason="branch", detail=detail)
        return path

    def _leave(self, joints_rad: Joints) -> TimedPath:
        """Straight back; the farther the better, for next to a rim nothing else may be planned."""
        scene, release = self.problem.scene, self.release
        poses = {**scene.Ts_base_object, self.grasp.object_id: release.T_base_object}
        placed = replace(self.problem, scene=replace(scene, Ts_base_object=poses))
        mover = replace(self._open("leave", "release"), problem=placed)
        failure = NoPathError(reason="unreachable")
        for more_m in _LEAVE_MORE_M:
            away = release.T_base_tcp @ _along_z(-self.grasp.pregrasp_m - more_m)
            try:
                return mover.straight(joints_rad, away)
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
