"""The swept hand contains what the hand passes, and nothing else."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from bridge.robots.robot import read_robot
from twin.plan.grasp.open_hand import has_fingers, open_hand
from twin.robot.model import RobotModel, load_robot

APPROACH_M = 0.08


def robot_of_name(name: str) -> RobotModel:
    return load_robot(read_robot(name).description())


@pytest.mark.parametrize("name", ["ur5_parallel_gripper", "panda", "xarm7_parallel_gripper"])
def test_a_point_is_hit_when_a_piece_passes_it_on_the_way(name: str) -> None:
    robot = robot_of_name(name)
    hand = open_hand(robot, 0.06, APPROACH_M)
    rng = np.random.default_rng(5)
    points = rng.uniform([-0.05, -0.12, -0.25], [0.05, 0.12, 0.03], (4000, 3))
    hits = hand.hits(points.T[:, :, None], 0.0)
    back = np.linspace(0.0, APPROACH_M, 161)
    for group, is_finger in (("fingers", True), ("palm", False)):
        passed = np.zeros(len(points), dtype=bool)
        for piece in hand.pieces:
            if piece.finger == is_finger:
                inside = Delaunay(piece.corners_m).find_simplex
                for shift in back:
                    passed |= inside(points + np.array([0.0, 0.0, shift])) >= 0
        missed = passed & ~hits[group]
        assert not missed.any()
        # between two steps of the sweep a point may be passed unseen
        assert (hits[group] & ~passed).mean() < 0.005


def test_the_open_fingers_leave_the_opening_free() -> None:
    for width in (0.02, 0.05, 0.085):
        hand = open_hand(robot_of_name("ur5_parallel_gripper"), width, APPROACH_M)
        points = np.zeros((3, 2, 1))
        points[1, :, 0] = width / 2 - 1e-4, width / 2 + 1e-4
        assert hand.hits(points, 0.0)["fingers"].tolist() == [False, True]


def test_the_ur5s_hand_has_its_own_measures() -> None:
    hand = open_hand(robot_of_name("ur5_parallel_gripper"), 0.085, APPROACH_M)
    measured = (hand.tip_m, hand.depth_m, hand.pad_half_m)
    np.testing.assert_allclose(measured, (0.01, 0.06, 0.01), atol=1e-9)
    assert hand.symmetric


def test_a_hand_whose_sides_differ_is_not_the_same_turned_half() -> None:
    assert not open_hand(robot_of_name("z1"), 0.07, APPROACH_M).symmetric


def test_an_arm_without_fingers_has_none() -> None:
    assert not has_fingers(robot_of_name("kinova_j2s6s200"))
    assert has_fingers(robot_of_name("panda"))


def test_the_lowest_point_is_the_tip_when_the_hand_points_down() -> None:
    hand = open_hand(robot_of_name("ur5_parallel_gripper"), 0.085, APPROACH_M)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.3
    np.testing.assert_allclose(hand.lowest_m(T[None]), [0.3 - hand.tip_m])
