"""A sweep against planes whose distance is known at every pixel, by rays cast onto them."""

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.sweep.planes import PosedImage, sweep

CAMERA = Camera(width=96, height=72, fx=90.0, fy=90.0, cx=48.0, cy=36.0)
WAVES = np.random.default_rng(0).normal(size=(60, 3)) * 60.0
MIDDLE = np.array([0.0, 0.0, 1.0])


def seen(T: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brightness and depth of the plane through (0, 0, 1) m with this normal."""
    rays = CAMERA.rays() @ T[:3, :3].T
    depth_m = ((MIDDLE - T[:3, 3]) @ normal) / (rays @ normal)
    p = T[:3, 3] + depth_m[..., None] * rays
    waves = np.sin(p @ WAVES.T + np.arange(len(WAVES))).sum(axis=-1)
    return 0.5 + waves / 20.0, depth_m


def capture(normal: tuple[float, float, float]) -> tuple[list[PosedImage], np.ndarray]:
    """Seven images from an arc around what is seen, with the noise of a camera; and depths."""
    images, depths = [], []
    noise = np.random.default_rng(1)
    for angle in np.linspace(0.0, 4.0, 7):
        eye = np.array([0.25 * np.cos(angle), 0.25 * np.sin(angle), 0.05 * angle])
        T = se3.look_at(eye, MIDDLE, np.array([0.0, -1.0, 0.0]))
        grey, depth_m = seen(T, np.array(normal))
        grey += noise.normal(scale=0.005, size=grey.shape)
        images.append(PosedImage(grey=grey.astype(np.float32), camera=CAMERA, T_base_camera=T))
        depths.append(depth_m)
    return images, np.stack(depths)


def swept(images: list[PosedImage]) -> tuple[np.ndarray, float]:
    depths, confirmed = sweep(images, 4.0, lambda *_: None)
    return np.stack(depths), confirmed


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, 0.0, 1.0), (0.2, -0.4, 1.0)])
def test_a_textured_plane_is_found_where_it_is(normal: tuple[float, float, float]) -> None:
    images, true_m = capture(normal)
    depth_m, confirmed = swept(images)
    off = np.abs(depth_m / true_m - 1.0)
    assert confirmed > 0.6
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.9) < 0.05


def test_an_image_without_neighbours_has_no_depth() -> None:
    images, _ = capture((0.0, 0.0, 1.0))
    depth_m, confirmed = swept([images[0], images[0]])
    assert not depth_m.any()
    assert confirmed == 0.0
