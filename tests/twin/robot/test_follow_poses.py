"""Joints along a path: smooth, within limits, clear of things, and honest where there are none."""

import numpy as np
import pytest

from twin.robot.config import IkConfig
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
    followed = follow_poses(
        robot, robot.Ts_base_tcp(wanted), start_rad=wanted[0], config=IkConfig()
    )
    assert followed.reached.all()
    np.testing.assert_allclose(followed.joints_rad, wanted, atol=1e-7)


@pytest.mark.parametrize("branch", range(8))
def test_whatever_the_start_nothing_jumps(robot: RobotModel, branch: int) -> None:
    Ts = robot.Ts_base_tcp(arc(HOME, HOME + np.array([0.8, 0.3, -0.3, 0.2, 0.3, -0.5])))
    inverse = UrInverse.for_robot(robot)
    assert inverse is not None
    start = inverse.solve(Ts[:1])[0][0, branch]
    followed = follow_poses(robot, Ts, start_rad=start, config=IkConfig())
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
    followed = follow_poses(robot, robot.Ts_base_tcp(wanted), start_rad=None, config=IkConfig())
    assert followed.reached.all()
    assert largest_step(followed.joints_rad) < 0.1
    assert np.all(followed.joints_rad <= robot.upper_rad + 1e-6)
    assert np.all(followed.joints_rad >= robot.lower_rad - 1e-6)


def test_a_branch_that_touches_is_left_for_one_that_does_not(robot: RobotModel) -> None:
    Ts = robot.Ts_base_tcp(arc(HOME, HOME + np.array([0.5, 0.1, -0.1, 0.1, 0.1, 0.1]), 20))
    free = follow_poses(robot, Ts, start_rad=None, config=IkConfig())
    up = np.sign(free.joints_rad[0, 2])
    asked = []

    def clearance(joints: np.ndarray) -> np.ndarray:
        asked.append(len(joints))
        return np.where(np.sign(joints[:, 2]) == up, -0.01, 0.01)

    other = follow_poses(robot, Ts, start_rad=None, config=IkConfig(), clearance=clearance)
    assert np.all(np.sign(other.joints_rad[:, 2]) == -up)
    assert sum(asked) < 8 * len(Ts), "only what was wanted is asked about"


def test_a_path_that_leaves_the_reach_is_followed_up_to_there(robot: RobotModel) -> None:
    T = robot.T_base_tcp(HOME)
    Ts = np.repeat(T[None], 30, axis=0)
    Ts[:, :3, 3] += np.linspace(0, 1.5, 30)[:, None] * np.array([1.0, 0.0, 0.0])
    followed = follow_poses(robot, Ts, start_rad=None, config=IkConfig(restarts=2))
    first = int(np.argmin(followed.reached))
    assert 0 < first < 30
    assert followed.reached[:first].all()
    assert not followed.reached[first:].any()
    assert np.isfinite(followed.joints_rad).all()
    assert pose_error(robot, followed.joints_rad[first], Ts[first])[0] > 1e-4
