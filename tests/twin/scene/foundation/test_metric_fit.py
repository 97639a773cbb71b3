"""A shape of wrong size in a wrong place is laid onto what a depth camera measured."""

import numpy as np
import pytest
from block_shape import CAMERA, block_depth, block_mesh, camera_pose, placed
from scipy.spatial.transform import Rotation

from bridge.geometry import se3
from twin.scene.foundation.metric_fit import (
    MetricFit,
    MetricFitConfig,
    MetricFitError,
    fit_metric,
    sample_surface,
    visible_mask,
)

SCALE = 0.1
"""Metres per unit: the thing is about 10 x 6 x 9 cm."""
QUICK = MetricFitConfig(num_samples=2000, max_points=450, yaw_starts_rad=(0.0,))


def measured(T_base_shape: np.ndarray, noise_m: float = 0.001, seed: int = 0) -> np.ndarray:
    """Points in the root frame, with noise along the ray's depth."""
    depth = block_depth(T_base_shape, SCALE, camera_pose()).astype(np.float64)
    rng = np.random.default_rng(seed)
    depth = np.where(depth > 0, depth + noise_m * rng.normal(size=depth.shape), np.nan)
    points = CAMERA.unproject(depth).reshape(-1, 3)
    return se3.apply(camera_pose(), points[np.isfinite(points).all(axis=1)])


def disturbed(T: np.ndarray, angle_rad: float, shift_m: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis, way = rng.normal(size=(2, 3))
    moved = T.copy()
    turn = Rotation.from_rotvec(angle_rad * axis / np.linalg.norm(axis)).as_matrix()
    moved[:3, :3] = turn @ T[:3, :3]
    moved[:3, 3] += shift_m * way / np.linalg.norm(way)
    return moved


def errors(found: MetricFit, T_true: np.ndarray) -> tuple[float, float, float]:
    """Relative error of the size, angle [rad], mean distance of corners [m]."""
    vertices, _ = block_mesh()
    truth = se3.apply(T_true, SCALE * vertices)
    angle = float(se3.rotation_angle_rad(found.T_base_shape[:3, :3] @ T_true[:3, :3].T))
    apart = float(np.linalg.norm(found.apply(vertices) - truth, axis=1).mean())
    return abs(found.scale / SCALE - 1.0), angle, apart


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "angle_rad", "shift_m"), [(1.5, 0.2, 0.03), (0.6, 0.25, 0.05)])
def test_size_and_place_are_found_again(factor: float, angle_rad: float, shift_m: float) -> None:
    T_true = placed()
    found = fit_metric(
        *block_mesh(),
        measured(T_true),
        [camera_pose()[:3, 3]],
        disturbed(T_true, angle_rad, shift_m, seed=4),
        SCALE * factor,
        support_z_m=T_true[2, 3],
    )
    size, angle, apart = errors(found, T_true)
    # 1 mm of noise on some 900 pixels, of which the planes take the mean.
    assert size < 0.005
    assert angle < 0.005
    assert apart < 0.0005
    assert found.inlier_fraction > 0.95
    assert found.residual_m < 0.002


def test_without_a_support_the_visible_side_alone_gives_the_size() -> None:
    T_true = placed()
    guess = disturbed(T_true, 0.15, 0.03, seed=5)
    found = fit_metric(
        *block_mesh(), measured(T_true), [camera_pose()[:3, 3]], guess, SCALE * 1.3, None, QUICK
    )
    size, angle, apart = errors(found, T_true)
    assert size < 0.03
    assert angle < 0.04
    assert apart < 0.003
    assert found.support_gap_m is None
    assert not found.is_snapped


def test_a_tenth_of_foreign_points_changes_little() -> None:
    T_true = placed()
    points = measured(T_true)
    rng = np.random.default_rng(6)
    foreign = points.mean(axis=0) + rng.uniform(-0.12, 0.12, size=(len(points) // 10, 3))
    found = fit_metric(
        *block_mesh(),
        np.concatenate([points, foreign]),
        [camera_pose()[:3, 3]],
        disturbed(T_true, 0.15, 0.02, seed=7),
        SCALE * 1.2,
        T_true[2, 3],
        QUICK,
    )
    size, angle, apart = errors(found, T_true)
    assert size < 0.03
    assert angle < 0.04
    assert apart < 0.004


def test_the_shape_is_set_on_its_support_unless_it_is_far_above() -> None:
    T_true = placed(z_m=0.02)
    vertices, _ = block_mesh()
    arguments = (*block_mesh(), measured(T_true), [camera_pose()[:3, 3]], T_true, SCALE)
    near = fit_metric(*arguments, 0.016, QUICK)
    assert near.is_snapped
    assert near.apply(vertices)[:, 2].min() == pytest.approx(0.016, abs=1e-6)
    far = fit_metric(*arguments, -0.1, QUICK)
    assert not far.is_snapped
    assert far.support_gap_m == pytest.approx(0.12, abs=0.005)
    assert errors(far, T_true)[2] < 0.003


def test_moving_the_world_moves_the_answer_along() -> None:
    T_true, guess = placed(), disturbed(placed(), 0.1, 0.02, seed=8)
    T_new_old = placed(yaw_rad=1.1, x_m=-0.3, y_m=0.7, z_m=0.4)
    points, eye = measured(T_true), camera_pose()[:3, 3]
    here = fit_metric(*block_mesh(), points, [eye], guess, 0.12, T_true[2, 3], QUICK)
    there = fit_metric(
        *block_mesh(),
        se3.apply(T_new_old, points),
        [se3.apply(T_new_old, eye)],
        T_new_old @ guess,
        0.12,
        T_true[2, 3] + 0.4,
        QUICK,
    )
    assert there.scale == pytest.approx(here.scale, rel=0.005)
    # The extent that sets the cuts is that of a box along the axes, so not exactly the same.
    np.testing.assert_allclose(there.T_base_shape, T_new_old @ here.T_base_shape, atol=0.01)


def test_the_same_input_gives_the_same_bits() -> None:
    arguments = (
        *block_mesh(),
        measured(placed()),
        [camera_pose()[:3, 3]],
        placed(),
        0.13,
        0.02,
        QUICK,
    )
    one, other = fit_metric(*arguments), fit_metric(*arguments)
    np.testing.assert_array_equal(one.T_base_shape, other.T_base_shape)
    assert one.scale == other.scale


@pytest.mark.slow
def test_another_shape_is_refused() -> None:
    vertices, faces = block_mesh()
    needle = vertices * [0.05, 0.05, 3.0]
    with pytest.raises(MetricFitError, match=r"generate it again|times as large"):
        fit_metric(needle, faces, measured(placed()), [camera_pose()[:3, 3]], placed(), SCALE, 0.02)


def test_a_size_that_cannot_be_meant_is_refused() -> None:
    with pytest.raises(MetricFitError, match="times as large"):
        fit_metric(
            *block_mesh(),
            measured(placed()),
            [camera_pose()[:3, 3]],
            placed(),
            SCALE * 9,
            0.02,
            QUICK,
        )


def test_too_little_to_go_by_is_refused() -> None:
    vertices, faces = block_mesh()
    few = measured(placed())[:30]
    with pytest.raises(MetricFitError, match="30 measured points from 1 views"):
        fit_metric(vertices, faces, few, [np.zeros(3)], placed(), SCALE, 0.02)
    with pytest.raises(MetricFitError, match="from 0 views"):
        fit_metric(vertices, faces, measured(placed()), [], placed(), SCALE, 0.02)
    with pytest.raises(MetricFitError, match="no area"):
        fit_metric(0.0 * vertices, faces, measured(placed()), [np.zeros(3)], placed(), SCALE, 0.02)


def test_samples_lie_on_the_surface_and_cover_it_by_area() -> None:
    vertices, faces = block_mesh()
    points, normals = sample_surface(vertices, faces, 4000, 0)
    low, high = vertices[:8].min(axis=0), vertices[:8].max(axis=0)
    large = points[(points <= high + 1e-9).all(axis=1) & (points >= low - 1e-9).all(axis=1)]
    on_side = np.isclose(large, low) | np.isclose(large, high)
    assert on_side.any(axis=1).all()
    size = high - low
    side_areas = size.prod() / size  # one of each pair of opposite sides
    share = np.isclose(points[:, 2], 0.0).mean()
    total = sum(
        2 * (np.ptp(vertices[8 * i : 8 * i + 8], axis=0).prod() / s).sum()
        for i in range(3)
        for s in [np.ptp(vertices[8 * i : 8 * i + 8], axis=0)]
    )
    assert share == pytest.approx(side_areas[2] / total, abs=0.02)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)


def test_of_two_sheets_only_the_nearer_is_seen() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 30), np.linspace(-0.1, 0.1, 30)), -1)
    front = np.concatenate([grid.reshape(-1, 2), np.full((900, 1), 1.0)], axis=1)
    behind = front + np.array([0.0, 0.0, 0.2])
    normals = np.tile([0.0, 0.0, 1.0], (1800, 1))
    both = np.concatenate([front, behind * [1.2, 1.2, 1.0]])
    seen = visible_mask(both, normals, np.zeros((1, 3)), 0.02)
    assert seen[:900].all()
    assert not seen[900:].any()
    from_behind = visible_mask(both, normals, np.array([[0.0, 0.0, 3.0]]), 0.02)
    assert from_behind[900:].all()
