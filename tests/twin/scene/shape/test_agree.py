"""What all views of a sensor get wrong is found as one thing."""

from dataclasses import replace

import cast_views
import numpy as np
import pytest

from bridge.geometry import se3
from twin.scene.shape.carve import MaskedView
from twin.scene.shape.registration import laid_together, slope_by_sensor

MOUNT = se3.transform_from(np.array([1.0, 0.002, -0.0015, 0.0025]), np.array([2e-3, -1e-3, 1e-3]))
"""Some millimetres and 7 milliradians that a camera is off on what carries it."""
SCALE, OFFSET_M = 1.004, -0.0015


def wrong_views() -> list[MaskedView]:
    """An open box seen by a camera whose mount and depth are off, the same in every view."""
    poses = cast_views.around([0.0, 0.0, 0.02], 16)
    meshes = [cast_views.open_box_mesh(), cast_views.table()]
    wrong = []
    for view in cast_views.cast(meshes, poses, noise=0.002):
        depth = np.where(view.depth_m > 0, view.depth_m * SCALE + OFFSET_M, 0.0)
        T = view.T_base_camera @ MOUNT
        wrong.append(replace(view, T_base_camera=T, depth_m=depth, sensor="wrist"))
    return wrong


def wall_m(views: list[MaskedView]) -> float:
    """How far inner and outer face of the wall at +x are apart, by all points on them."""
    model = cast_views.TASK.objects["box"]
    inner, outer = model.inner_m[0] / 2, model.size_m[0] / 2
    p = np.concatenate([view.points_m() for view in views])
    p = p[(np.abs(p[:, 1]) < 0.06) & (p[:, 2] > 0.015) & (p[:, 2] < 0.045)]
    at_wall = p[np.abs(p[:, 0] - (inner + outer) / 2) < 0.008, 0]
    middle = (inner + outer) / 2
    return float(np.median(at_wall[at_wall > middle]) - np.median(at_wall[at_wall < middle]))


@pytest.mark.slow
def test_a_mount_and_a_depth_that_are_off_do_not_change_the_thickness_of_a_wall() -> None:
    wall = cast_views.TASK.objects["box"].wall_m
    views = wrong_views()
    mended = laid_together(views, 0.0, 8)
    assert abs(wall_m(views) - wall) > 0.001
    assert wall_m(mended) == pytest.approx(wall, abs=0.0004)


def test_derivatives_by_a_sensors_errors_are_those_of_the_distance() -> None:
    rng = np.random.default_rng(0)
    p = rng.normal(size=(50, 3)) * 0.1 + [0, 0, 0.5]
    slope = rng.normal(size=(50, 3))
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)

    def distance(errors: np.ndarray) -> np.ndarray:
        deeper = p * (1 + errors[7] + errors[6] / p[:, 2:])
        turned = deeper @ se3.rotation_from_vector(errors[3:6]).T + errors[:3]
        return np.einsum("ni,ni->n", slope, turned)

    step = 1e-6
    numeric = np.stack(
        [(distance(e) - distance(-e)) / (2 * step) for e in step * np.eye(8)], axis=1
    )
    np.testing.assert_allclose(slope_by_sensor(slope, p), numeric, atol=1e-7)
