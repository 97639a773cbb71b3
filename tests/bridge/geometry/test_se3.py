"""Laws of rigid transforms, their trajectories and the pinhole camera, against SciPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation, Slerp

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.geometry.trajectory import PoseTrajectory

finite = st.floats(-10, 10, allow_nan=False, width=64)
quaternions = hnp.arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(
    lambda q: np.linalg.norm(q) > 1e-3
)
points = hnp.arrays(np.float64, 3, elements=finite)


def transform(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    return se3.transform_from(q, p)


@given(quaternions, points)
def test_a_transform_times_its_inverse_is_identity(q: np.ndarray, p: np.ndarray) -> None:
    T = transform(q, p)
    np.testing.assert_allclose(T @ se3.invert(T), np.eye(4), atol=1e-9)


@given(quaternions, points)
def test_splitting_and_joining_gives_the_transform_back(q: np.ndarray, p: np.ndarray) -> None:
    T = transform(q, p)
    np.testing.assert_allclose(se3.transform_from(*se3.split(T)), T, atol=1e-9)


@given(quaternions)
def test_rotations_agree_with_scipy(q: np.ndarray) -> None:
    ours = se3.rotation_from_quaternion(q)
    scipys = Rotation.from_quat(q, scalar_first=True).as_matrix()
    np.testing.assert_allclose(ours, scipys, atol=1e-12)


@given(quaternions)
def test_the_rotation_angle_agrees_with_scipy(q: np.ndarray) -> None:
    R = se3.rotation_from_quaternion(q)
    expected = Rotation.from_quat(q, scalar_first=True).magnitude()
    # arctan2 of the trace loses half the digits next to pi
    assert se3.rotation_angle_rad(R) == pytest.approx(expected, abs=1e-6)


@given(quaternions, quaternions, st.floats(0, 1))
def test_interpolation_agrees_with_scipy_slerp(
    q_start: np.ndarray, q_end: np.ndarray, fraction: float
) -> None:
    q_start = q_start / np.linalg.norm(q_start)
    q_end = q_end / np.linalg.norm(q_end)
    if abs(q_start @ q_end) < 1e-3:
        return  # half a turn apart: the shorter arc is not unique
    ours = se3.interpolate_quaternion(q_start[None], q_end[None], np.array([fraction]))[0]
    keys = Rotation.from_quat(np.stack([q_start, q_end]), scalar_first=True)
    expected = Slerp([0, 1], keys)(fraction)
    error = (Rotation.from_quat(ours, scalar_first=True).inv() * expected).magnitude()
    assert error < 1e-6


@given(quaternions, points, points)
def test_applying_a_transform_keeps_distances(
    q: np.ndarray, p: np.ndarray, other: np.ndarray
) -> None:
    moved = se3.apply(transform(q, p), np.stack([p, other]))
    before = np.linalg.norm(p - other)
    assert np.linalg.norm(moved[0] - moved[1]) == pytest.approx(before, abs=1e-8)


def test_a_camera_that_looks_at_a_point_sees_it_straight_ahead() -> None:
    eye, target = np.array([0.5, -0.4, 0.8]), np.array([0.45, 0.1, 0.0])
    T_world_camera = se3.look_at(eye, target, np.array([0.0, 0.0, 1.0]))
    seen = se3.apply(se3.invert(T_world_camera), target)
    np.testing.assert_allclose(seen, [0, 0, np.linalg.norm(target - eye)], atol=1e-12)
    assert np.linalg.det(T_world_camera[:3, :3]) == pytest.approx(1.0)
    assert T_world_camera[2, 1] < 0  # image "down" points towards the floor


DIRECTIONS = st.integers(0, 10**6).map(lambda seed: np.random.default_rng(seed).normal(size=3))
ANGLES = st.one_of(st.floats(0.0, np.pi - 1e-6), st.floats(0.0, 1e-10))


@given(DIRECTIONS, ANGLES)
def test_vectors_and_matrices_are_those_of_scipy(direction: np.ndarray, angle: float) -> None:
    vector = angle * direction / np.linalg.norm(direction)
    R = se3.rotation_from_vector(vector)
    np.testing.assert_allclose(R, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(se3.vector_from_rotation(R), vector, atol=1e-8)


@given(DIRECTIONS, st.floats(0.0, 20.0))
def test_a_vector_is_never_longer_than_half_a_turn(direction: np.ndarray, angle: float) -> None:
    R = se3.rotation_from_vector(angle * direction / np.linalg.norm(direction))
    vector = se3.vector_from_rotation(R)
    assert np.linalg.norm(vector) <= np.pi + 1e-9
    np.testing.assert_allclose(Rotation.from_rotvec(vector).as_matrix(), R, atol=1e-7)


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


CAMERA = Camera(width=64, height=48, fx=60.0, fy=58.0, cx=31.0, cy=25.0)


def test_unprojecting_and_projecting_returns_the_pixel_centres() -> None:
    depth_m = np.linspace(0.3, 2.0, 64 * 48).reshape(48, 64)
    uv, z = CAMERA.project(CAMERA.unproject(depth_m))
    columns, rows = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    np.testing.assert_allclose(uv[..., 0], columns, atol=1e-9)
    np.testing.assert_allclose(uv[..., 1], rows, atol=1e-9)
    np.testing.assert_allclose(z, depth_m)


def test_ros_intrinsics_put_the_first_pixel_centre_at_zero() -> None:
    camera = Camera.from_ros(width=64, height=48, fx=60.0, fy=60.0, cx=0.0, cy=0.0)
    uv, _ = camera.project(np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(uv, [0.5, 0.5])
    assert camera.to_ros() == (60.0, 60.0, 0.0, 0.0)


@given(st.sampled_from([0.25, 0.5, 2.0]))
def test_a_scaled_camera_sees_the_same_directions(factor: float) -> None:
    scaled = CAMERA.scaled(factor)
    p = np.array([0.2, -0.1, 1.3])
    uv, _ = CAMERA.project(p)
    uv_scaled, _ = scaled.project(p)
    np.testing.assert_allclose(uv_scaled, uv * factor, atol=1e-9)


def test_missing_depth_stays_at_the_origin() -> None:
    points = CAMERA.unproject(np.zeros((48, 64)))
    assert not points.any()


def test_rays_have_unit_depth() -> None:
    rays = CAMERA.rays()
    assert rays.shape == (48, 64, 3)
    assert rays[..., 2] == pytest.approx(1.0)


@given(st.floats(0.2, 3.0))
def test_the_corners_of_a_scaled_image_are_its_corners_whatever_the_rounding(factor: float) -> None:
    """Width and height round differently, so the image is not scaled the same both ways."""
    scaled = CAMERA.scaled(factor)
    assert (scaled.width, scaled.height) == (round(64 * factor), round(48 * factor))
    corners = np.array([[0.0, 0.0], [64.0, 0.0], [0.0, 48.0], [64.0, 48.0]])
    rays = np.column_stack(
        [(corners[:, 0] - 31.0) / 60.0, (corners[:, 1] - 25.0) / 58.0, np.ones(4)]
    )
    uv, _ = scaled.project(rays)
    size = [scaled.width, scaled.height]
    np.testing.assert_allclose(uv, corners / [64.0, 48.0] * size, atol=1e-9)
