"""Joints along a path: least motion, within limits, clear of things, honest if there are none."""

import re

import numpy as np
import pytest

from bridge.robots.default import ROBOT
from twin.robot.follow import follow_poses
from twin.robot.inverse import UrInverse, pose_error
from twin.robot.model import RobotModel

HOME = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.3])


def arc(start: np.ndarray, end: np.ndarray, count: int = 60) -> np.ndarray:
    """Postures on a straight line in joints."""
    return start + np.linspace(0, 1, count)[:, None] * (end - start)


def largest_step(joints: np.ndarray) -> float:
    return float(np.abs(np.diff(joints, axis=0)).max())


def test_a_path_is_followed_on_the_branch_it_starts_on(robot: RobotModel) -> None:
    wanted = arc(HOME, HOME + np.array([1.2, 0.4, -0.5, 0.6, 0.7, -0.8]))
    followed = follow_poses(robot, robot.Ts_base_tcp(wanted), start_rad=wanted[0])
    assert followed.reached.all()
    np.testing.assert_allclose(followed.joints_rad, wanted, atol=1e-7)


@pytest.mark.parametrize("branch", range(8))
def test_whatever_the_start_nothing_jumps(robot: RobotModel, branch: int) -> None:
    Ts = robot.Ts_base_tcp(arc(HOME, HOME + np.array([0.8, 0.3, -0.3, 0.2, 0.3, -0.5])))
    inverse = UrInverse.for_robot(robot)
    assert inverse is not None
    start = inverse.solve(Ts[:1])[0][0, branch]
    followed = follow_poses(robot, Ts, start_rad=start)
    assert followed.reached.all()
    assert np.abs(followed.joints_rad[0] - start).max() < 1e-9
    assert largest_step(followed.joints_rad) < 0.2
    for T, joints in zip(Ts, followed.joints_rad, strict=True):
        assert max(pose_error(robot, joints, T)) < 1e-9


def test_a_turn_starts_a_whole_turn_lower_where_it_would_end_at_the_limit(
    robot: RobotModel,
) -> None:
    """Nobody says where to start; from +3 by 4.5 rad would pass the limit of 2 pi."""
    start = HOME.copy()
    start[5] = 3.0
    wanted = arc(start, start + np.array([0, 0, 0, 0, 0, 4.5]), 120)
    followed = follow_poses(robot, robot.Ts_base_tcp(wanted), start_rad=None)
    assert followed.reached.all()
    assert largest_step(followed.joints_rad) < 0.1
    assert np.all(followed.joints_rad <= robot.upper_rad + 1e-6)
    assert np.all(followed.joints_rad >= robot.lower_rad - 1e-6)


def test_a_branch_that_touches_is_left_for_one_that_does_not(robot: RobotModel) -> None:
    Ts = robot.Ts_base_tcp(arc(HOME, HOME + np.array([0.5, 0.1, -0.1, 0.1, 0.1, 0.1]), 20))
    free = follow_poses(robot, Ts, start_rad=None)
    up = np.sign(free.joints_rad[0, 2])
    asked = []

    def clearance(joints: np.ndarray) -> np.ndarray:
        asked.append(len(joints))
        return np.where(np.sign(joints[:, 2]) == up, -0.01, 0.01)

    other = follow_poses(robot, Ts, start_rad=None, clearance=clearance)
    assert np.all(np.sign(other.joints_rad[:, 2]) == -up)
    assert sum(asked) < 8 * len(Ts), "only what was wanted is asked about"


def test_a_path_that_leaves_the_reach_is_followed_up_to_there(robot: RobotModel) -> None:
    T = robot.T_base_tcp(HOME)
    Ts = np.repeat(T[None], 30, axis=0)
    Ts[:, :3, 3] += np.linspace(0, 1.5, 30)[:, None] * np.array([1.0, 0.0, 0.0])
    followed = follow_poses(robot, Ts, start_rad=None)
    first = int(np.argmin(followed.reached))
    assert 0 < first < 30
    assert followed.reached[:first].all()
    assert not followed.reached[first:].any()
    assert np.isfinite(followed.joints_rad).all()
    assert pose_error(robot, followed.joints_rad[first], Ts[first])[0] > 1e-4


NEARLY_STRAIGHT = np.array([0.2, -1.4, 1.6, -0.9, 0.1, 0.3])
"""The fifth joint turns the wrist little: the fourth and the sixth nearly cancel each other."""


def spinning(turn_rad: float, count: int = 60) -> np.ndarray:
    """Postures that turn the fourth and sixth joint against each other; the tool hardly moves."""
    way = np.linspace(0.0, 1.0, count)[:, None]
    return NEARLY_STRAIGHT + way * np.array([0.0, 0.0, 0.0, turn_rad, 0.0, -turn_rad])


def motion(joints: np.ndarray) -> float:
    """Sum of squared steps, the shorter way round."""
    steps = np.diff(joints, axis=0)
    return float(np.square(steps - 2 * np.pi * np.rint(steps / (2 * np.pi))).sum())


def test_a_branch_that_moves_more_but_never_jumps_is_not_left(robot: RobotModel) -> None:
    wanted = spinning(2.0)
    assert np.abs(np.diff(wanted, axis=0)).max() < 0.1
    followed = follow_poses(robot, robot.Ts_base_tcp(wanted), start_rad=wanted[0])
    np.testing.assert_allclose(followed.joints_rad, wanted, atol=1e-6)


def test_without_a_start_no_branch_moves_less_than_the_chosen_one(robot: RobotModel) -> None:
    """Being near home decides only where they move alike."""
    wanted = spinning(5.0)
    Ts = robot.Ts_base_tcp(wanted)
    inverse = UrInverse.for_robot(robot)
    assert inverse is not None
    raw, valid, _ = inverse.solve(Ts)
    motions = [motion(raw[:, k]) for k in range(8) if valid[:, k].all()]
    assert min(motions) < 0.2 * motion(wanted), "otherwise there is nothing to choose"
    followed = follow_poses(robot, Ts, start_rad=None)
    assert motion(followed.joints_rad) < 2 * min(motions) + 0.05


def test_of_branches_that_move_alike_the_one_nearest_home_is_chosen(robot: RobotModel) -> None:
    T = robot.Ts_base_tcp(np.array([[0.4, -1.2, 1.4, -1.4, -1.3, 0.5]]))
    inverse = UrInverse.for_robot(robot)
    assert inverse is not None
    raw, valid, _ = inverse.solve(T)
    assert valid.all()
    away = raw[0] - robot.home_rad
    away -= 2 * np.pi * np.rint(away / (2 * np.pi))
    nearest = int(np.square(away).sum(axis=1).argmin())
    followed = follow_poses(robot, np.repeat(T, 3, axis=0), start_rad=None)
    turns = (followed.joints_rad - raw[0, nearest]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-6)


@pytest.mark.parametrize("turn_rad", [7.5, -7.5])
def test_more_than_a_turn_between_narrow_limits_winds_back_and_stays_inside(
    robot: RobotModel, turn_rad: float
) -> None:
    narrow = RobotModel(
        re.sub(
            r'(<joint name="wrist_3_joint".*?lower=")[^"]*(" upper=")[^"]*(")',
            r"\g<1>-3.14159265359\g<2>3.14159265359\g<3>",
            ROBOT.urdf_text(),
            flags=re.DOTALL,
        )
    )
    start = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.3])
    wanted = start + np.linspace(0, 1, 150)[:, None] * np.array([0, 0, 0, 0, 0, turn_rad])
    Ts = robot.Ts_base_tcp(wanted)
    followed = follow_poses(narrow, Ts, start_rad=start)
    assert followed.reached.all()
    assert np.all(np.abs(followed.joints_rad[:, 5]) <= np.pi + 1e-6)
    for T, joints in zip(Ts, followed.joints_rad, strict=True):
        assert max(pose_error(robot, joints, T)) < 1e-6
    winds = np.abs(np.diff(followed.joints_rad[:, 5])) > 3.0
    assert 1 <= winds.sum() <= 2, "a turn and a fifth passes a limit once or twice"
