"""The closed form: all branches reach, singular poses have none, other arms are refused."""

import re

import numpy as np
import pytest

from bridge.robots.default import ROBOT
from twin.robot.inverse import UrInverse, pose_error
from twin.robot.model import RobotModel

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


def test_joints_are_within_limits_and_whole_turns_are_used_to_stay_there(robot: RobotModel) -> None:
    urdf = ROBOT.urdf_text()
    shifted = re.sub(
        r'(<joint name="shoulder_pan_joint".*?lower=")[^"]*(" upper=")[^"]*(")',
        r"\g<1>0.0\g<2>6.28318530718\g<3>",
        urdf,
        flags=re.DOTALL,
    )
    narrow = RobotModel(shifted)
    assert narrow.lower_rad[0] == 0.0
    inverse = UrInverse.for_robot(narrow)
    assert inverse is not None
    Ts = robot.Ts_base_tcp(np.random.default_rng(14).uniform(-3.0, 3.0, (100, 6)))
    joints, valid, _ = inverse.solve(Ts)
    assert valid.any(axis=1).all()
    assert np.all(joints[valid] >= narrow.lower_rad - 1e-6)
    assert np.all(joints[valid] <= narrow.upper_rad + 1e-6)
