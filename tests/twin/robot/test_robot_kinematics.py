"""Laws of the robot model: two engines agree, and inverse undoes forward kinematics."""

from pathlib import Path

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS
from twin.robot.config import IkConfig
from twin.robot.inverse import solve_ik
from twin.robot.model import RobotDescriptionError, RobotModel

HOME = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.3])


@pytest.mark.parity
def test_pinocchio_and_pybullet_agree_on_forward_kinematics(
    robot: RobotModel, tmp_path: Path
) -> None:
    from twin.physics.arm import write_description
    from twin.physics.engine import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(
            str(write_description(robot.urdf, {}, tmp_path)), physicsClientId=client
        )
        infos = [
            pybullet.getJointInfo(body, index, physicsClientId=client)
            for index in range(pybullet.getNumJoints(body, physicsClientId=client))
        ]
        joints = {info[1].decode(): index for index, info in enumerate(infos)}
        links = {info[12].decode(): index for index, info in enumerate(infos)}
        rng = np.random.default_rng(0)
        for _ in range(50):
            q = rng.uniform(-np.pi, np.pi, 6)
            for name, value in zip(ARM_JOINTS, q, strict=True):
                pybullet.resetJointState(body, joints[name], value, physicsClientId=client)
            for link in ("tcp", "forearm_link", "wrist_3_link"):
                state = pybullet.getLinkState(
                    body, links[link], computeForwardKinematics=1, physicsClientId=client
                )
                T = robot.T_base_link(link, q)
                np.testing.assert_allclose(state[4], T[:3, 3], atol=1e-6)
                q_xyzw = np.array(state[5])
                R = se3.rotation_from_quaternion(q_xyzw[[3, 0, 1, 2]])
                np.testing.assert_allclose(R, T[:3, :3], atol=2e-6)
    finally:
        pybullet.disconnect(physicsClientId=client)


def test_inverse_kinematics_undoes_forward_kinematics(robot: RobotModel) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = rng.uniform(-2.5, 2.5, 6)
        T = robot.T_base_tcp(q)
        near = solve_ik(robot, T, IkConfig(), warm_start_rad=q + rng.normal(0, 0.02, 6))
        cold = solve_ik(robot, T, IkConfig())
        for solution in (near, cold):
            assert solution.reached
            np.testing.assert_allclose(robot.T_base_tcp(solution.joints_rad), T, atol=1e-6)
            assert np.all(solution.joints_rad >= robot.lower_rad)
            assert np.all(solution.joints_rad <= robot.upper_rad)
        assert np.abs(near.joints_rad - q).max() < 0.3


def test_a_pose_out_of_reach_is_not_reached_and_says_by_how_much(robot: RobotModel) -> None:
    T = robot.T_base_tcp(HOME)
    T[:3, 3] = (2.0, 0.0, 0.3)
    solution = solve_ik(robot, T, IkConfig(restarts=2))
    assert not solution.reached
    assert solution.position_error_m > 0.5


def test_an_unknown_frame_lists_the_frames_there_are(robot: RobotModel) -> None:
    with pytest.raises(RobotDescriptionError, match="tcp"):
        robot.T_base_link("thumb", HOME)
