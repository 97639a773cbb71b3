"""Inverse kinematics, in closed form and without: all branches reach, what cannot is refused."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.robots.robot import read_robot
from twin.robot.follow import follow_poses
from twin.robot.inverse import (
    POSITION_TOLERANCE_M,
    ROTATION_TOLERANCE_RAD,
    UrInverse,
    pose_error,
    solutions,
    solve_ik,
)
from twin.robot.model import RobotModel, load_robot

HOME = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.3])


@pytest.fixture(scope="module")
def inverse(robot: RobotModel) -> UrInverse:
    found = UrInverse.for_robot(robot)
    assert found is not None
    return found


def test_every_reachable_pose_is_solved_and_every_answer_reaches_it(
    robot: RobotModel, inverse: UrInverse
) -> None:
    rng = np.random.default_rng(11)
    postures = rng.uniform(-np.pi, np.pi, (1000, 6))
    Ts = robot.Ts_base_tcp(postures)
    joints, valid, _ = inverse.solve(Ts)
    assert valid.any(axis=1).all()
    assert np.isfinite(joints).all()
    for index in range(0, 1000, 10):
        for branch in np.flatnonzero(valid[index]):
            offset, turned = pose_error(robot, joints[index, branch], Ts[index])
            assert offset < 1e-9
            assert turned < 1e-9


def test_the_posture_that_made_a_pose_is_among_its_answers(
    robot: RobotModel, inverse: UrInverse
) -> None:
    rng = np.random.default_rng(12)
    postures = rng.uniform(-3.1, 3.1, (300, 6))
    joints, valid, _ = inverse.solve(robot.Ts_base_tcp(postures))
    apart = joints - postures[:, None]
    apart = np.abs(apart - 2 * np.pi * np.rint(apart / (2 * np.pi))).max(axis=2)
    nearest = np.where(valid, apart, np.inf).min(axis=1)
    assert nearest.max() < 1e-6


def test_lengths_are_those_of_the_data_sheet(inverse: UrInverse) -> None:
    g = inverse.geometry
    assert (g.a2_m, g.a3_m) == pytest.approx((0.425, 0.39225))
    assert (g.d4_m, g.d5_m) == pytest.approx((0.10915, 0.09465))
    assert g.T_base_0[2, 3] == pytest.approx(0.089159)


@pytest.mark.parametrize(
    ("joint", "origin"),
    [("wrist_2_joint", "0.01 0.093 0.0"), ("elbow_joint", "0.05 -0.1197 0.425")],
)
def test_an_arm_whose_axes_do_not_meet_is_refused(joint: str, origin: str) -> None:
    urdf = ROBOT.urdf_text()
    bent = re.sub(
        rf'(<joint name="{joint}".*?xyz=")[^"]*(")', rf"\g<1>{origin}\g<2>", urdf, flags=re.DOTALL
    )
    found = UrInverse.for_robot(RobotModel(bent))
    if joint == "elbow_joint":  # the elbow may be anywhere: that is only another length
        assert found is not None
        assert found.geometry.a2_m == pytest.approx(np.hypot(0.05, 0.425))
    else:
        assert found is None


def test_a_straight_wrist_is_not_valid_and_nearly_straight_is(
    robot: RobotModel, inverse: UrInverse
) -> None:
    """The fifth joint decides whether the sixth is determined; the shoulders' other side is."""
    for bend, determined in ((0.0, False), (1e-5, True)):
        posture = HOME.copy()
        posture[4] = bend
        T = robot.T_base_tcp(posture)
        joints, valid, _ = inverse.solve(T[None])
        own_side = [b for b in range(8) if abs(np.sin(joints[0, b, 4])) < 1e-3 or not valid[0, b]]
        assert any(valid[0, b] for b in own_side) is determined
        for branch in np.flatnonzero(valid[0]):
            assert max(pose_error(robot, joints[0, branch], T)) < 1e-9


def test_a_wrist_inside_the_shoulder_cylinder_has_no_answer(
    robot: RobotModel, inverse: UrInverse
) -> None:
    g = inverse.geometry
    T_0_tcp = np.linalg.inv(g.T_base_0) @ robot.T_base_tcp(HOME)
    T_0_6 = T_0_tcp @ np.linalg.inv(g.T_6_tcp)
    for radius, reachable in ((0.9 * g.d4_m, False), (0.0, False), (1.1 * g.d4_m, True)):
        T_0_6[:3, 3] = (radius, 0.0, 0.5)
        _, valid, _ = inverse.solve((g.T_base_0 @ T_0_6 @ g.T_6_tcp)[None])
        assert valid.any() == reachable


FIVE = ("so100", "so101")
ITERATED = ("panda", "kinova_j2s6s200", "xarm7_parallel_gripper", "z1", *FIVE)


def model(name: str) -> RobotModel:
    return load_robot(read_robot(name).description())


def postures(robot: RobotModel, count: int, seed: int) -> np.ndarray:
    """Anywhere within the limits, every fourth with a joint at one of its ends."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform(robot.lower_rad, robot.upper_rad, (count, len(robot.joints)))
    for row in rows[::4]:
        joint = rng.integers(len(row))
        row[joint] = rng.choice([robot.lower_rad[joint], robot.upper_rad[joint]])
    return rows


def check_reached(robot: RobotModel, rows: np.ndarray) -> None:
    for row in rows:
        T = robot.T_base_tcp(row)
        found = solve_ik(robot, T)
        assert found.reached, row.tolist()
        position_m, rotation_rad = pose_error(robot, found.joints_rad, T)
        assert position_m <= POSITION_TOLERANCE_M
        assert rotation_rad <= ROTATION_TOLERANCE_RAD
        assert np.all(found.joints_rad >= robot.lower_rad)
        assert np.all(found.joints_rad <= robot.upper_rad)


@pytest.mark.parametrize("name", ITERATED)
def test_every_pose_that_some_posture_reaches_is_reached(name: str) -> None:
    robot = model(name)
    assert UrInverse.for_robot(robot) is None
    check_reached(robot, postures(robot, 200, seed=2))


@pytest.mark.parametrize("name", FIVE)
def test_an_arm_of_five_joints_reaches_every_position_and_turns_as_far_as_it_can(name: str) -> None:
    """Law: exact in place, and what is left to turn is told and no more from there."""
    robot, rng = model(name), np.random.default_rng(4)
    for row in postures(robot, 60, seed=5):
        T = robot.T_base_tcp(row)
        T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        found = solve_ik(robot, T)
        assert found.reached
        position_m, left_rad = pose_error(robot, found.joints_rad, T)
        assert position_m <= POSITION_TOLERANCE_M
        assert left_rad == pytest.approx(found.rotation_error_rad, abs=1e-6)
        warm = solve_ik(robot, T, warm_start_rad=found.joints_rad)
        assert warm.reached
        assert warm.rotation_error_rad <= left_rad + 1e-3
        T[:3, 3] *= 10
        assert not solve_ik(robot, T, restarts=1).reached


def test_a_pose_out_of_reach_of_seven_joints_is_not_reached() -> None:
    robot = model("panda")
    T = robot.T_base_tcp(robot.home_rad)
    T[:3, 3] = (1.5, 0.0, 0.3)
    found = solve_ik(robot, T, restarts=2)
    assert not found.reached
    assert found.position_error_m > 0.4
    T[:3, :3] = np.nan
    assert not solve_ik(robot, T, restarts=2).reached


@pytest.mark.parametrize("name", ["panda", "xarm7_parallel_gripper"])
def test_the_seventh_joint_goes_towards_home_and_then_moves_least(name: str) -> None:
    robot = model(name)
    q, p = se3.split(robot.T_base_tcp(robot.home_rad))
    shares = np.linspace(0.0, 1.0, 60)[:, None]
    Ts = se3.transform_from(np.tile(q, (60, 1)), p + shares * np.array([0.05, 0.15, -0.1]))
    followed = follow_poses(robot, Ts, start_rad=None)
    assert followed.reached.all()
    np.testing.assert_allclose(followed.joints_rad[0], robot.home_rad, atol=1e-6)
    assert np.abs(np.diff(followed.joints_rad, axis=0)).max() < 0.02
    again = follow_poses(robot, Ts, start_rad=None)
    assert np.array_equal(again.joints_rad, followed.joints_rad)
    # What the pose leaves open: found from elsewhere, it comes to the same side of the arm.
    rng = np.random.default_rng(0)
    far = solve_ik(robot, Ts[0]).joints_rad
    assert np.abs(far - robot.home_rad).max() < 1e-6
    other = rng.uniform(robot.lower_rad, robot.upper_rad)
    free = solve_ik(robot, robot.T_base_tcp(other)).joints_rad
    assert np.linalg.norm(free - robot.home_rad) <= np.linalg.norm(other - robot.home_rad) + 1e-6


@pytest.mark.parametrize("name", ["panda", "kinova_j2s6s200"])
def test_a_path_is_followed_from_another_posture_where_the_first_one_ends_or_touches(
    name: str,
) -> None:
    """Somebody stands where the arm would be that begins nearest to home."""
    robot = model(name)
    q, p = se3.split(robot.T_base_tcp(robot.home_rad))
    shares = np.linspace(0.0, 1.0, 20)[:, None]
    Ts = se3.transform_from(np.tile(q, (20, 1)), p + shares * np.array([0.02, 0.05, -0.03]))
    found = [item.joints_rad for item in solutions(robot, Ts[0])]
    assert len(found) > 2
    for row in found:
        np.testing.assert_allclose(robot.T_base_tcp(row), Ts[0], atol=1e-6)
    plain = follow_poses(robot, Ts, start_rad=None)
    np.testing.assert_allclose(plain.joints_rad[0], found[0], atol=1e-6)
    asked = []

    def clearance(rows: np.ndarray) -> np.ndarray:
        asked.append(len(rows))
        return np.abs(rows - plain.joints_rad[0]).max(axis=1) - 0.4

    other = follow_poses(robot, Ts, start_rad=None, clearance=clearance)
    assert other.reached.all()
    assert len(asked) > 1
    assert np.abs(other.joints_rad - plain.joints_rad[0]).max(axis=1).min() > 0.4
    np.testing.assert_allclose(robot.Ts_base_tcp(other.joints_rad), Ts, atol=1e-6)
