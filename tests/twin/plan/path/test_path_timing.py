"""Times of paths against what can be worked out by hand, and the robot's limits."""

from dataclasses import replace

import numpy as np
import pytest
from path_scene import WIDTH_M, Pairs

from twin.plan.path.planner import PathConfig, limits_of, timed_path
from twin.replay.motion import motion_failures
from twin.replay.path import JointPath

CONFIG = PathConfig()
FAST = replace(CONFIG, speed_share=1.0, acceleration_share=1.0)


def timed(pairs: Pairs, rows: np.ndarray, *, tool: float = 0.0, rounding: bool = True) -> tuple:
    speed, acceleration, _ = limits_of(pairs.problem.robot, FAST)
    times, joints, *_ = pairs.world.motion.time(rows, speed, acceleration, tool, 0.02, rounding)
    return times, joints


def knots_of(pairs: Pairs, index: int) -> np.ndarray:
    return pairs.world.motion.find(
        pairs.starts[index], pairs.goals[index][None], 3, 1.0, 5000, 150_000, 60
    )[2]


@pytest.mark.parametrize("length_rad", [0.05, 0.3, 1.4])
def test_one_joint_takes_the_time_of_a_trapezoid(pairs: Pairs, length_rad: float) -> None:
    speed, acceleration, _ = limits_of(pairs.problem.robot, FAST)
    home = pairs.problem.robot.home_rad
    goal = home + np.eye(6)[0] * length_rad
    times, joints = timed(pairs, np.stack([home, goal]))
    v, a = float(speed[0]), float(acceleration[0])
    triangle = 2 * np.sqrt(length_rad / a)
    expected = triangle if length_rad < v**2 / a else length_rad / v + v / a
    assert times[-1] == pytest.approx(expected, rel=0.01)
    assert np.array_equal(joints[-1], goal)
    assert (np.diff(joints[:, 0]) > 0).all()


def test_limits_of_speed_acceleration_and_tool_are_kept(pairs: Pairs) -> None:
    robot = pairs.problem.robot
    speed, acceleration, tool = limits_of(robot, CONFIG)
    for index in range(0, len(pairs.kinds), 3):
        path = timed_path(pairs.world, knots_of(pairs, index), CONFIG)
        step = np.diff(path.times_s)
        rates = np.diff(path.joints_rad, axis=0) / step[:, None]
        assert (np.abs(rates) <= 1.01 * speed).all()
        # At rest before and after.
        rates = np.vstack([np.zeros(6), rates, np.zeros(6)])
        middles = np.concatenate([[step[0]], (step[1:] + step[:-1]) / 2, [step[-1]]])
        assert (np.abs(np.diff(rates, axis=0)) / middles[:, None] <= 1.01 * acceleration).all()
        tips = robot.Ts_base_tcp(path.joints_rad)[:, :3, 3]
        assert (np.linalg.norm(np.diff(tips, axis=0), axis=1) / step).max() <= 1.01 * tool
        knots = JointPath(
            times_ns=np.round(path.times_s * 1e9).astype(np.int64),
            joints_rad=path.joints_rad,
            width_times_ns=np.array([0]),
            width_m=np.array([WIDTH_M]),
            first_close_ns=None,
        )
        assert motion_failures(knots, robot) == []


def test_rounded_corners_are_passed_without_a_stop_and_sharp_ones_with_one(pairs: Pairs) -> None:
    home = pairs.problem.robot.home_rad
    rows = home + np.array([[0, 0, 0, 0, 0, 0], [0.4, 0, 0, 0, 0, 0], [0.4, 0, 0, 0.4, 0, 0.0]])
    quick, quick_rows = timed(pairs, rows)
    slow, slow_rows = timed(pairs, rows, rounding=False)
    assert quick[-1] < 0.8 * slow[-1]
    speeds = np.linalg.norm(np.diff(quick_rows, axis=0), axis=1) / np.diff(quick)
    assert speeds[3:-3].min() > 0.3
    corner = np.abs(slow_rows - rows[1]).max(axis=1)
    assert corner.min() == pytest.approx(0.0, abs=1e-9)  # it is passed exactly
    assert np.abs(quick_rows - rows[1]).max(axis=1).min() > 0.01


def test_the_tool_is_no_faster_than_asked(pairs: Pairs) -> None:
    robot = pairs.problem.robot
    rows = np.stack([pairs.starts[0], pairs.starts[0] + 0.2])
    path = timed_path(pairs.world, rows, CONFIG, tool_m_s=0.05)
    tips = robot.Ts_base_tcp(path.joints_rad)[:, :3, 3]
    speeds = np.linalg.norm(np.diff(tips, axis=0), axis=1) / np.diff(path.times_s)
    assert 0.045 < speeds.max() <= 0.0505


def test_a_corner_beside_an_obstacle_is_rounded_less(pairs: Pairs) -> None:
    """Whatever was rounded, the way that is followed is free."""
    for index in range(len(pairs.kinds)):
        path = timed_path(pairs.world, knots_of(pairs, index), CONFIG)
        assert pairs.world.motion.blocked(path.joints_rad) < 0
