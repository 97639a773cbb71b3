"""Whether the arm brings its hand to a grasp, on which branch, and along a straight approach."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from twin.plan.arrays import Flags, Joints, Poses, Postures
from twin.plan.grasp.open_hand import OpenHand
from twin.plan.problem import Problem
from twin.replay.clearance.bodies import own_links
from twin.replay.clearance.surroundings import Surroundings
from twin.replay.config import ReplayConfig
from twin.robot.collision import hulls_of
from twin.robot.config import IkConfig
from twin.robot.inverse import UrInverse, solutions, solve_ik

MOST_TURN_RAD = 0.8
"""Of any joint on the straight approach; more is another branch, or a wrist that flips."""
_MOST_BRANCHES = 4
_TURN = 2 * np.pi


@dataclass(frozen=True, kw_only=True)
class Reached:
    """How the arm stands at a grasp."""

    joints_rad: Joints
    turned: bool
    """Whether with the hand turned half about its approach."""


class ArmReach:
    """An arm and what stands around it; made once per problem."""

    def __init__(self, problem: Problem) -> None:
        """Lay out what postures are checked against."""
        self.robot = problem.robot
        self.hulls = hulls_of(problem.robot)
        self._eps_m = ReplayConfig().eps_col_m
        self._around = Surroundings(problem.scene, self.hulls, self._eps_m)
        self._links = own_links(self.hulls)
        start = problem.scene.start_rad
        self.start_rad = self.robot.home_rad if start is None else start

    def is_clear(self, joints_rad: Joints, open_m: float) -> bool:
        """Whether arm and hand keep clear of the robot itself and of what stands still."""
        self.hulls.place(joints_rad, open_m)
        if self._links.touch():
            return False
        return self._around.least_m(frozenset(), self._eps_m) >= self._eps_m


class Reaches:
    """Solutions of many grasps, looked at one at a time."""

    def __init__(
        self, arm: ArmReach, Ts_base_tcp: Poses, hand: OpenHand, pregrasp_m: float
    ) -> None:
        """Solve many grasps at once, where the arm has a closed form."""
        self._arm, self._hand = arm, hand
        turns = (1.0, -1.0) if hand.symmetric else (1.0,)
        self._Ts = np.stack(
            [Ts_base_tcp * np.array([sign, sign, 1.0, 1.0]) for sign in turns], axis=1
        )
        self._before = self._Ts.copy()
        self._before[..., :3, 3] -= pregrasp_m * self._Ts[..., :3, 2]
        self._inverse = UrInverse.for_robot(arm.robot)
        if self._inverse is not None and len(Ts_base_tcp):
            self._grasps, self._valid, _ = self._inverse.solve(self._Ts.reshape(-1, 4, 4))
            self._starts, valid, _ = self._inverse.solve(self._before.reshape(-1, 4, 4))
            self._both = self._valid & valid

    def first(self, index: int) -> Reached | str:
        """The solution nearest to where the arm stands that keeps clear, or why there is none."""
        if self._inverse is not None:
            return self._of_branches(index)
        return self._of_descents(index)

    def _of_branches(self, index: int) -> Reached | str:
        num = self._Ts.shape[1]
        rows = slice(index * num, (index + 1) * num)
        if not self._valid[rows].any():
            return "reach"
        turned, branch = np.nonzero(self._both[rows])
        if not len(turned):
            return "approach"
        at, before = (
            self._nearest(table[rows][turned, branch], self._arm.start_rad)
            for table in (self._grasps, self._starts)
        )
        before = self._nearest(before, at)
        smooth: Flags = np.abs(at - before).max(axis=1) <= MOST_TURN_RAD
        if not smooth.any():
            return "approach"
        cost = np.abs(before - self._arm.start_rad).max(axis=1)
        order = [i for i in np.argsort(cost, kind="stable").tolist() if smooth[i]]
        for i in order[:_MOST_BRANCHES]:
            if self._is_clear(at[i], before[i]):
                return Reached(joints_rad=at[i], turned=bool(turned[i]))
        return "arm"

    def _nearest(
        self, joints_rad: Postures, wanted_rad: Float[np.ndarray, "*batch num_joints"]
    ) -> Postures:
        """The same postures by whole turns nearer to a wanted one, within the limits."""
        robot = self._arm.robot
        moved = joints_rad + _TURN * np.rint((wanted_rad - joints_rad) / _TURN)
        inside = (moved >= robot.lower_rad) & (moved <= robot.upper_rad)
        return np.where(inside, moved, joints_rad)

    def _of_descents(self, index: int) -> Reached | str:
        robot, config, why = self._arm.robot, IkConfig(), "reach"
        for turned, T in enumerate(self._Ts[index]):
            for found in solutions(robot, T, config):
                if not found.reached:
                    break
                why = max(why, "approach", key=_PROGRESS.index)
                before = solve_ik(
                    robot, self._before[index, turned], config, warm_start_rad=found.joints_rad
                )
                far = np.abs(before.joints_rad - found.joints_rad).max() > MOST_TURN_RAD
                if not before.reached or far:
                    continue
                if self._is_clear(found.joints_rad, before.joints_rad):
                    return Reached(joints_rad=found.joints_rad, turned=bool(turned))
                why = "arm"
        return why

    def _is_clear(self, at_rad: Joints, before_rad: Joints) -> bool:
        """At the grasp and where its approach begins; the hand was looked at all the way."""
        return all(self._arm.is_clear(row, self._hand.open_m) for row in (at_rad, before_rad))


_PROGRESS = ("reach", "approach", "arm")
