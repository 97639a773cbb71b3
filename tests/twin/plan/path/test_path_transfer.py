"""Straight lines near contact, and a whole pick and place in movements."""

from itertools import pairwise

import numpy as np
import pytest
from path_scene import Pairs, at, joints_at, tool_down

from bridge.geometry import se3
from twin.plan.grasp.reach import nearest_solutions
from twin.plan.path import planner
from twin.plan.path.transfer import Leg, PickAndPlace
from twin.plan.problem import Grasp, Problem, Release

CONFIG = planner.PathConfig()


def grasp_of(problem: Problem) -> Grasp:
    T = problem.scene.Ts_base_object["cube"]
    T_tool = tool_down(*T[:2, 3], 0.022, float(np.arctan2(T[1, 0], T[0, 0])))
    joints = joints_at(problem, T_tool, None)
    assert joints is not None
    return Grasp(
        object_id="cube", T_object_tcp=se3.invert(T) @ T_tool, width_m=0.04, open_m=0.085,
        margin=1.0, joints_rad=joints, pregrasp_m=0.08,
    )  # fmt: skip


def release_of(grasp: Grasp, T_base_object: np.ndarray) -> Release:
    return Release(
        object_id="cube", T_base_object=T_base_object, cost=0.0,
        T_base_tcp=T_base_object @ grasp.T_object_tcp,
    )  # fmt: skip


def planned(problem: Problem, grasp: Grasp, release: Release) -> tuple[Leg, ...]:
    move = PickAndPlace(problem=problem, grasp=grasp, release=release, config=CONFIG)
    return move.legs(problem.robot.home_rad)


def test_a_straight_line_is_straight_on_one_branch_and_slow(pairs: Pairs) -> None:
    problem, robot = pairs.problem, pairs.problem.robot
    grasp = grasp_of(problem)
    T = robot.T_base_tcp(grasp.joints_rad)
    goal = T.copy()
    goal[2, 3] += 0.1
    allowed = problem.contacts_of("grasp", "cube")
    mover = planner.Mover(problem=problem, config=CONFIG, width_m=0.085, allowed=allowed)
    path = mover.straight(grasp.joints_rad, goal)
    tips = robot.Ts_base_tcp(path.joints_rad)
    assert np.abs(tips[:, :2, 3] - T[:2, 3]).max() < 0.0005
    assert np.abs(tips[:, :3, :3] - T[:3, :3]).max() < 0.002
    assert tips[-1] == pytest.approx(goal, abs=1e-6)
    assert (np.diff(tips[:, 2, 3]) > 0).all()
    assert np.abs(np.diff(path.joints_rad, axis=0)).max() < 0.1
    speeds = np.linalg.norm(np.diff(tips[:, :3, 3], axis=0), axis=1) / np.diff(path.times_s)
    assert speeds.max() <= 1.01 * planner.CONTACT_M_S
    back = planner.reversed_path(path)
    assert np.array_equal(back.joints_rad[0], path.joints_rad[-1])
    assert back.times_s[0] == 0.0
    assert (np.diff(back.times_s) > 0).all()


def test_a_straight_line_into_something_or_out_of_reach_is_refused(pairs: Pairs) -> None:
    problem = pairs.problem
    start = joints_at(problem, tool_down(0.42, -0.1, 0.1, 0.0), None)
    assert start is not None
    mover = planner.Mover(problem=problem, config=CONFIG, width_m=0.085)
    with pytest.raises(planner.NoPathError, match=r"refused: gripper_.* and wall"):
        mover.straight(start, tool_down(0.42, 0.1, 0.1, 0.0))
    with pytest.raises(planner.NoPathError, match=r"unreachable .* of 1\d{3} mm"):
        mover.straight(start, tool_down(0.42, -1.5, 0.1, 0.0))


def test_a_cube_is_taken_into_the_box_around_what_stands_between(pairs: Pairs) -> None:
    problem, robot = pairs.problem, pairs.problem.robot
    grasp = grasp_of(problem)
    release = release_of(grasp, at(0.5, 0.25, 0.027, 0.1))
    legs = planned(problem, grasp, release)
    assert [leg.name for leg in legs] == ["around", "approach", "lift", "carry", "lower", "leave"]
    assert [leg.g for leg in legs] == [0, 0, 1, 1, 1, 0]
    assert np.array_equal(legs[0].path.joints_rad[0], robot.home_rad)
    for before, after in pairwise(legs):
        ends = before.path.joints_rad[-1], after.path.joints_rad[0]
        assert np.array_equal(*ends)
    assert np.array_equal(legs[1].path.joints_rad[-1], grasp.joints_rad)
    tool = robot.T_base_tcp(legs[4].path.joints_rad[-1])
    assert tool == pytest.approx(release.T_base_tcp, abs=1e-6)


def test_the_movement_that_does_not_exist_is_named(pairs: Pairs) -> None:
    problem = pairs.problem
    grasp = grasp_of(problem)
    beyond = release_of(grasp, at(1.6, 0.2, 0.03))
    with pytest.raises(planner.NoPathError, match="unreachable"):
        planned(problem, grasp, beyond)
    in_wall = release_of(grasp, at(0.42, 0.05, 0.03))
    with pytest.raises(planner.NoPathError, match="for 'lower'") as caught:
        planned(problem, grasp, in_wall)
    assert caught.value.leg == "lower"


def test_all_branches_come_nearest_first(pairs: Pairs) -> None:
    robot = pairs.problem.robot
    near = pairs.starts[0]
    found = nearest_solutions(robot, robot.T_base_tcp(near), near)
    assert len(found) > 2
    assert found[0] == pytest.approx(near, abs=1e-6)
    away = [np.abs(joints - near).sum() for joints in found]
    assert away == sorted(away)
    for joints in found:
        assert robot.T_base_tcp(joints) == pytest.approx(robot.T_base_tcp(near), abs=1e-6)
