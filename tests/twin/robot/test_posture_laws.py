"""Laws of postures: when a pose is reached, which whole turns fit, when an arm stands still."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.robots.robot import Gripper, read_robot
from twin.robot.config import IkConfig
from twin.robot.inverse import UrInverse, solve_ik
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import PostureTrack, width_track

POSTURE = np.array([0.3, -1.3, 1.5, -1.6, -1.4, 0.4])


@pytest.mark.parametrize(
    ("tolerance_m", "tolerance_rad", "reached"),
    [(0.1, math.pi, True), (0.1, 1e-9, False), (1e-9, math.pi, False), (1e-9, 1e-9, False)],
)
def test_a_pose_is_reached_within_both_tolerances_only(
    robot: RobotModel, tolerance_m: float, tolerance_rad: float, reached: bool
) -> None:
    """Two iterations come near, and no nearer."""
    config = IkConfig(
        position_tolerance_m=tolerance_m,
        rotation_tolerance_rad=tolerance_rad,
        max_iterations=2,
        restarts=0,
    )
    found = solve_ik(robot, robot.T_base_tcp(POSTURE), config, warm_start_rad=POSTURE + 0.1)
    assert 1e-9 < found.position_error_m < 0.1
    assert 1e-9 < found.rotation_error_rad < math.pi
    assert found.reached is reached


@given(st.lists(st.floats(-2 * math.pi, 0.0), min_size=6, max_size=6))
def test_limits_a_whole_turn_apart_lose_no_answer_wherever_they_are(lower: list[float]) -> None:
    robot = load_robot(ROBOT.urdf_text())
    wide = UrInverse.for_robot(robot)
    assert wide is not None
    low = np.array(lower)
    turn = UrInverse(geometry=wide.geometry, lower_rad=low, upper_rad=low + 2 * math.pi)
    Ts = robot.Ts_base_tcp(np.array([POSTURE, -POSTURE + 0.3]))
    joints, valid, _ = turn.solve(Ts)
    assert np.array_equal(valid, wide.solve(Ts)[1])
    assert np.all(joints[valid] >= low - 1e-6)
    assert np.all(joints[valid] <= low + 2 * math.pi + 1e-6)


@pytest.mark.parametrize("joint", range(6))
def test_one_joint_that_moves_is_enough_to_be_moving(joint: int) -> None:
    stamps = np.arange(0, 2_000_000_000, 8_000_000, dtype=np.int64)
    position = np.tile(POSTURE, (len(stamps), 1))
    moving = stamps > 1_000_000_000
    position[moving, joint] += 0.2 * (stamps[moving] - 1_000_000_000) * 1e-9
    arm = JointTrack(names=ARM_JOINTS, stamps_ns=stamps, position=position)
    track = PostureTrack(urdf="", arm=arm, widths=None)
    assert track.is_stationary(500_000_000)
    assert not track.is_stationary(1_500_000_000)


def test_the_width_follows_from_a_finger_among_the_joint_states(tmp_path: Path) -> None:
    """A Panda's driver sends its fingers with the arm, and no gripper state."""
    robot = read_robot("panda")
    path = tmp_path / "trial_0001.mcap"
    names = (*robot.joints, "panda_finger_joint1")
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial"))
        for index, half_m in enumerate((0.04, 0.01)):
            sample = at_positions(index * 10**9, names, np.array([0.0] * 7 + [half_m]))
            writer.write(
                "/cell/joint_states",
                sample.to_cdr(),
                type_name=schema.JOINT_STATE,
                log_time_ns=sample.stamp_ns,
            )
    episode = Episode.open(path)
    widths = width_track(episode, robot)
    assert widths.names == ("gripper_width",)
    np.testing.assert_allclose(widths.position[:, 0], [0.08, 0.02])
    with pytest.raises(EpisodeError):
        width_track(episode, ROBOT)
    fixed = replace(robot, gripper=Gripper())
    assert width_track(episode, fixed).position.tolist() == [[0.0], [0.0]]
