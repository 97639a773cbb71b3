"""Rotation vectors against SciPy, from nothing to half a turn."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bridge.geometry import se3

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
