"""Laws of the pinhole camera and its pixel convention."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.geometry.camera import Camera

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
