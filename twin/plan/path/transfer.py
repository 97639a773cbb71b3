"""Pick and place as movements: around, straight down, straight up, around, straight down, away."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from bridge.geometry import se3
from twin.plan.grasp.reach import nearest_solutions
from twin.plan.path.planner import Mover, NoPathError, PathConfig, first_free, reversed_path
from twin.plan.path.world import Carried
from twin.plan.problem import Grasp, Joints, Pose, Problem, Release, TimedPath
from twin.replay.clearance.bodies import GRIPPER

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


@dataclass(frozen=True, kw_only=True)
class PickAndPlace:
    """One object from where it is to where it is let go."""

    problem: Problem
    grasp: Grasp
    release: Release
    config: PathConfig
    lift_m: float = LIFT_M
    """How far the object is lifted, and let down, straight; less where that is not free."""
    straight: bool = False
    """Carry it along a straight line of the tool, turned evenly; else around."""
    tool_m_s: Mapping[str, float] = field(default_factory=dict)
    """How fast the tool may be on some legs."""

    def legs(self, start_rad: Joints) -> tuple[Leg, ...]:
        """Plan all movements from where the arm stands to where it has let go and left."""
        taken = self._take(start_rad)
        lifted_rad = taken[-1].path.joints_rad[-1]
        ends = nearest_solutions(self.problem.robot, self.release.T_base_tcp, lifted_rad)
        nothing = "no joints reach the release pose"
        return first_free(ends, lambda rad: (*taken, *self._put(lifted_rad, rad)), nothing)

    def _mover(self, leg: str, verb: str = "", *, holding: bool = False) -> Mover:
        """What moves on a leg, the hand open or holding; it may touch what a verb's stages let."""
        grasp = self.grasp
        grip = {frozenset((GRIPPER, grasp.object_id))} if verb or holding else set()
        held = Carried(object_id=grasp.object_id, T_tcp_object=se3.invert(grasp.T_object_tcp))
        return Mover(
            problem=self.problem,
            config=replace(self.config, tool_m_s=self.tool_m_s.get(leg, 0.0)),
            width_m=grasp.width_m if holding else grasp.open_m,
            carried=held if holding else None,
            allowed=self.problem.contacts_of(verb, grasp.object_id) | grip,
        )

    def _take(self, start_rad: Joints) -> tuple[Leg, Leg, Leg]:
        """From where the arm stands to the lifted object."""
        grasp = self.grasp
        with _named("approach"):
            T_base_tcp = self.problem.robot.T_base_tcp(grasp.joints_rad)
            back = T_base_tcp @ _along_z(-grasp.pregrasp_m)
            out = self._mover("approach", "grasp").straight(grasp.joints_rad, back)
        with _named("around"):
            around = self._mover("around").around(start_rad, out.joints_rad[-1:])
        with _named("lift"):
            mover = self._mover("lift", "grasp", holding=True)
            lift = self._straight_up(grasp.joints_rad, mover)
        return (
            Leg(name="around", path=around, g=0, width_m=grasp.open_m),
            Leg(name="approach", path=reversed_path(out), g=0, width_m=grasp.open_m),
            Leg(name="lift", path=lift, g=1, width_m=grasp.width_m),
        )

    def _put(self, lifted_rad: Joints, joints_rad: Joints) -> tuple[Leg, Leg, Leg]:
        """From the lifted object to where the arm has left, let go with these joints."""
        grasp = self.grasp
        with _named("lower"):
            rise = self._straight_up(joints_rad, self._mover("lower", "release", holding=True))
        with _named("carry"):
            over_rad = rise.joints_rad[-1]
            mover = self._mover("carry", holding=True)
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

    def _straight_up(self, joints_rad: Joints, mover: Mover) -> TimedPath:
        """Lift as far as is free and within reach, at least two centimetres."""
        T = self.problem.robot.T_base_tcp(joints_rad)
        rises = [rise_m for k in range(3) if (rise_m := self.lift_m / 2**k) >= _LEAST_LIFT_M]
        return first_free(rises, lambda rise_m: mover.straight(joints_rad, _along_z(rise_m) @ T))

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
        release = self.release
        placed = left_with(self.problem, release.object_id, release.T_base_object)
        mover = replace(self._mover("leave", "release"), problem=placed)
        ways = [release.T_base_tcp @ _along_z(-self.grasp.pregrasp_m - m) for m in _LEAVE_MORE_M]
        return first_free(ways, lambda T: mover.straight(joints_rad, T))


def left_with(
    problem: Problem, key: str, T_base_object: Pose, start_rad: Joints | None = None
) -> Problem:
    """The problem after an object was moved; with where the arm then stands."""
    scene = problem.scene
    start = scene.start_rad if start_rad is None else start_rad
    Ts = {**scene.Ts_base_object, key: T_base_object}
    return replace(problem, scene=replace(scene, Ts_base_object=Ts, start_rad=start))


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
