"""Runs of a flag, lags between signals, points over triangles, poses in records, sRGB."""

import numpy as np
import pytest

from bridge.errors import InvalidRecordError
from bridge.geometry import se3
from bridge.geometry.mesh import sample_triangles
from bridge.geometry.signals import LAGS_S, lag_of_least_cost, runs_of_true
from bridge.media.color import linear_from_srgb


def test_runs_of_true_touch_both_ends() -> None:
    assert runs_of_true(np.array([1, 1, 0, 1, 0, 0, 1], dtype=bool)) == [(0, 2), (3, 4), (6, 7)]
    assert runs_of_true(np.zeros(4, dtype=bool)) == []


def test_of_lags_that_fit_equally_well_the_smallest_is_taken() -> None:
    assert lag_of_least_cost(np.zeros(len(LAGS_S))) == 0.0
    costs = np.abs(LAGS_S - 0.3)
    assert lag_of_least_cost(costs) == pytest.approx(0.3)


@pytest.mark.parametrize("in_order", [False, True])
def test_points_are_spread_by_area(in_order: bool) -> None:
    areas = np.array([1.0, 0.0, 3.0])
    chosen, u, v = sample_triangles(areas, 4000, np.random.default_rng(0), in_order=in_order)
    counts = np.bincount(chosen, minlength=3) / 4000
    np.testing.assert_allclose(counts, [0.25, 0.0, 0.75], atol=0.03)
    assert (u >= 0).all()
    assert (v >= 0).all()
    assert (u + v <= 1).all()
    np.testing.assert_allclose([u.mean(), v.mean()], 1 / 3, atol=0.02)


@pytest.mark.parametrize("weights", [None, np.arange(1.0, 11.0)])
def test_an_exact_rigid_motion_is_recovered(weights: np.ndarray | None) -> None:
    rng = np.random.default_rng(1)
    R = se3.rotation_from_vector(np.array([0.3, -1.2, 0.8]))
    points = rng.normal(size=(10, 3))
    T = se3.align_rigid(points, points @ R.T + [1.0, 2.0, 3.0], weights)
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], [1.0, 2.0, 3.0], atol=1e-12)


def test_the_nearest_rotation_of_a_mirror_is_no_mirror() -> None:
    M = np.random.default_rng(2).normal(size=(20, 3, 3))
    np.testing.assert_allclose(np.linalg.det(se3.nearest_rotation(M)), 1.0, atol=1e-12)


def test_a_pose_record_is_read_back() -> None:
    T = se3.transform_from(np.array([0.5, -0.5, 0.5, 0.5]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(se3.pose_from_record(se3.pose_record(T)), T, atol=1e-15)


@pytest.mark.parametrize(
    "record",
    [
        {},
        {"p_m": [0, 0, 0], "q_wxyz": [0, 0, 0, 0]},
        {"p_m": [0, 0], "q_wxyz": [1, 0, 0, 0]},
        {"p_m": [0, 0, float("nan")], "q_wxyz": [1, 0, 0, 0]},
        {"p_m": "here", "q_wxyz": [1, 0, 0, 0]},
    ],
)
def test_a_record_that_is_not_a_pose_is_refused(record: dict[str, object]) -> None:
    with pytest.raises(InvalidRecordError, match="pose is invalid"):
        se3.pose_from_record(record)


def test_srgb_ends_and_middle() -> None:
    np.testing.assert_allclose(
        linear_from_srgb(np.array([0.0, 0.5, 1.0])), [0.0, 0.2140411, 1.0], atol=1e-7
    )
