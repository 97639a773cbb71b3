"""Laws of rigid transforms, against SciPy where it has the same routine."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation, Slerp

from bridge.geometry import se3

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
