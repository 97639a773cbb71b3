"""Laws of pose trajectories."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bridge.geometry.trajectory import PoseTrajectory


def spiral(num_poses: int = 20) -> PoseTrajectory:
    t = np.linspace(0, 1, num_poses)
    p = np.stack([np.cos(6 * t), np.sin(6 * t), t], axis=1)
    q = Rotation.from_rotvec(np.outer(t, [0.2, 0.5, 1.5])).as_quat(scalar_first=True)
    return PoseTrajectory((t * 1e9).astype(np.int64), p, q)


def test_asking_at_the_stamps_returns_the_poses() -> None:
    track = spiral()
    again = track.at(track.stamps_ns)
    np.testing.assert_allclose(again.p_m, track.p_m, atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(again.q_wxyz * track.q_wxyz, axis=1)), 1, atol=1e-12)


def test_before_the_start_and_after_the_end_the_ends_are_held() -> None:
    track = spiral()
    held = track.at(np.array([-5_000, 9_000_000_000]))
    np.testing.assert_allclose(held.p_m, track.p_m[[0, -1]])


def test_halfway_between_two_poses_is_the_mean_position() -> None:
    track = spiral()
    middle = (track.stamps_ns[:1] + track.stamps_ns[1:2]) // 2
    np.testing.assert_allclose(track.at(middle).p_m[0], track.p_m[:2].mean(axis=0), atol=1e-6)


def test_one_pose_answers_every_stamp() -> None:
    track = spiral()
    single = PoseTrajectory(track.stamps_ns[:1], track.p_m[:1], track.q_wxyz[:1])
    np.testing.assert_allclose(single.at(np.array([0, 10])).p_m, track.p_m[[0, 0]])


@pytest.mark.parametrize("count", [1, 2, 40])
def test_positions_alone_are_those_with_rotations_to_the_bit(count: int) -> None:
    rng = np.random.default_rng(count)
    stamps_ns = np.cumsum(rng.integers(1, 9_000_000, count))
    poses = PoseTrajectory(
        stamps_ns, rng.normal(size=(count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    )
    asked = np.concatenate([stamps_ns, rng.integers(-9_000_000, 400_000_000, 100)])
    assert poses.positions_at(asked).tobytes() == poses.at(asked).p_m.tobytes()
