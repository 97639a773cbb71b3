"""Whether the arm brings its hand to a grasp, on which branch, and along a straight approach."""

import numpy as np

from twin.plan.grasp.open_hand import OpenHand
from twin.plan.problem import Joints, Pose, Postures, Problem
from twin.replay.clearance.bodies import own_links_touch
from twin.replay.clearance.surroundings import Surroundings
from twin.replay.config import ReplayConfig
from twin.robot.collision import hulls_of
from twin.robot.inverse import UrInverse, solutions, solve_ik
from twin.robot.model import RobotModel

MOST_TURN_RAD = 0.8
"""Of any joint on the straight approach; more is another branch, or a wrist that flips."""
_MOST_BRANCHES = 4
_TURN = 2 * np.pi

Reached = tuple[Joints, bool]
"""How the arm stands at a grasp, and whether with the hand turned half about its approach."""


class ArmReach:
    """An arm and what stands around it; made once per problem."""

    def __init__(self, problem: Problem) -> None:
        """Lay out what postures are checked against."""
        self.robot = problem.robot
        self.hulls = hulls_of(problem.robot)
        self._eps_m = ReplayConfig().eps_col_m
        self._around = Surroundings(problem.scene, self.hulls, self._eps_m)
        self._links_touch = own_links_touch(self.hulls)
        start = problem.scene.start_rad
        self.start_rad = self.robot.home_rad if start is None else start

    def is_clear(self, joints_rad: Joints, open_m: float) -> bool:
        """Whether arm and hand keep clear of the robot itself and of what stands still."""
        self.hulls.place(joints_rad, open_m)
        if self._links_touch():
            return False
        return self._around.least_m(frozenset()) >= self._eps_m

    def first(self, T_base_tcp: Pose, hand: OpenHand, pregrasp_m: float) -> Reached | str:
        """How to reach a grasp, nearest to where the arm stands and clear, or why it cannot."""
        back = np.eye(4)
        back[2, 3] = -pregrasp_m
        robot, start_rad, why = self.robot, self.start_rad, "reach"
        found: list[tuple[float, Reached, Joints]] = []
        for sign in (1.0, -1.0) if hand.symmetric else (1.0,):
            T = T_base_tcp * np.array([sign, sign, 1.0, 1.0])
            reaching, before_T = _reaching(robot, T), T @ back
            is_closed = UrInverse.for_robot(robot) is not None
            known = _reaching(robot, before_T) if is_closed else None
            why = "approach" if len(reaching) else why
            for at in _turned(robot, reaching, start_rad):
                rows = _reaching(robot, before_T, at) if known is None else known
                befores = _turned(robot, rows, at)
                befores = befores[np.abs(befores - at).max(axis=1) <= MOST_TURN_RAD]
                for before in befores[:1]:
                    far_rad = float(np.abs(before - start_rad).max())
                    found.append((far_rad, (at, sign < 0), before))
        for _, way, before in sorted(found, key=lambda each: each[0])[:_MOST_BRANCHES]:
            why = "arm"
            # At the grasp and where its approach begins; the hand was looked at all the way.
            if all(self.is_clear(row, hand.open_m) for row in (way[0], before)):
                return way
        return why


def nearest_solutions(robot: RobotModel, T_base_tcp: Pose, near_rad: Joints) -> list[Joints]:
    """Joints that reach a pose, each turned as near as its limits let it, nearest first."""
    return list(_turned(robot, _reaching(robot, T_base_tcp), near_rad))


def _reaching(robot: RobotModel, T_base_tcp: Pose, near_rad: Joints | None = None) -> Postures:
    """Joints that reach a pose; without a closed form what is found, or what is near a posture."""
    inverse = UrInverse.for_robot(robot)
    if inverse is not None:
        raw, valid, _ = inverse.solve(T_base_tcp[None])
        return np.asarray(raw[0, valid[0]])
    if near_rad is None:
        found = list(solutions(robot, T_base_tcp))
    else:
        found = [solve_ik(robot, T_base_tcp, warm_start_rad=near_rad)]
    rows = [item.joints_rad for item in found if item.reached]
    return np.array(rows).reshape(-1, len(robot.joints))


def _turned(robot: RobotModel, rows_rad: Postures, near_rad: Joints) -> Postures:
    """The same postures by whole turns nearer to a wanted one, within the limits; nearest first."""
    wanted = rows_rad + _TURN * np.rint((near_rad - rows_rad) / _TURN)
    inside = (wanted >= robot.lower_rad) & (wanted <= robot.upper_rad)
    found = np.where(inside, wanted, rows_rad)
    return found[np.argsort(np.abs(found - near_rad).sum(axis=1), kind="stable")]
