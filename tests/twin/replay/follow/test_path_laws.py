"""Laws of a joint path: which jump is named, what is too fast, which width holds when."""

import numpy as np
import pytest

from bridge.episode.streams import JointTrack
from bridge.robots.default import ARM_JOINTS, ROBOT
from twin.replay.execution import cut_track
from twin.replay.path import MAX_JOINT_STEP_RAD, JointPath, jumps
from twin.robot.model import RobotModel, load_robot

STEP_NS = 8_000_000


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot(ROBOT.urdf_text())


def path_with(steps_rad: dict[tuple[int, int], float], count: int = 20) -> np.ndarray:
    """Joints that stand still but for steps at (interval, joint)."""
    moves = np.zeros((count, len(ARM_JOINTS)))
    for (index, joint), size in steps_rad.items():
        moves[index, joint] = size
    return np.cumsum(moves, axis=0)


def test_of_several_jumps_the_first_is_named(robot: RobotModel) -> None:
    far = 2 * MAX_JOINT_STEP_RAD
    joints = path_with({(5, 4): far, (9, 1): -far, (14, 0): far})
    times = np.arange(len(joints), dtype=np.int64) * STEP_NS
    for failure in jumps(times, joints, robot):
        assert failure.t_ns == 4 * STEP_NS, "the instant before it jumps"
        assert failure.bodies == (ARM_JOINTS[4],)


def test_a_width_holds_from_its_own_instant_until_the_next_one() -> None:
    times = np.array([0, 100, 200], dtype=np.int64)
    path = JointPath(
        times_ns=times,
        joints_rad=np.zeros((3, 6)),
        width_times_ns=times,
        width_m=np.array([0.08, 0.02, 0.05]),
        first_close_ns=100,
    )
    asked = np.array([-1, 0, 99, 100, 199, 200, 300], dtype=np.int64)
    np.testing.assert_array_equal(path.width_at(asked), [0.08, 0.08, 0.08, 0.02, 0.02, 0.05, 0.05])


def test_a_cut_track_begins_and_ends_with_the_interval() -> None:
    """A sample at the very end belongs to it; one at the very start is there once."""
    stamps = np.arange(6, dtype=np.int64) * 10
    position = np.arange(6.0)[:, None] * np.ones((1, 6))
    track = JointTrack(names=ARM_JOINTS, stamps_ns=stamps, position=position)
    cut = cut_track(track, 10, 40)
    np.testing.assert_array_equal(cut.stamps_ns, [10, 20, 30, 40])
    np.testing.assert_array_equal(cut.position[:, 0], [1.0, 2.0, 3.0, 4.0])
    between = cut_track(track, 15, 39)
    np.testing.assert_array_equal(between.stamps_ns, [15, 20, 30])
    np.testing.assert_allclose(between.position[:, 0], [1.5, 2.0, 3.0])
