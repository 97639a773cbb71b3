"""A scene for other viewers, drawn by their formula in plain NumPy, Gaussian by Gaussian."""

from pathlib import Path

import numpy as np
import pytest
import small_scene

import robot_gst
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud, as_float32, read_ply
from twin.scene.other_viewers import for_other_viewers
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser

pytestmark = pytest.mark.usefixtures("few_voxels")


CAMERA = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)


def drawn_elsewhere(cloud: GaussianCloud, T: np.ndarray) -> np.ndarray:
    """Kerbl et al. 2023: EWA splatting, 0.3 px^2 on the diagonal, opacities as stored."""
    to_camera = se3.invert(T)
    p = se3.apply(to_camera, cloud.means_m.astype(float))
    q = cloud.quats_wxyz / np.linalg.norm(cloud.quats_wxyz, axis=1, keepdims=True)
    R = to_camera[:3, :3] @ se3.rotation_from_quaternion(q.astype(float))
    half = R * np.exp(cloud.scales_log.astype(float))[:, None, :]
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    image, left = np.zeros((3, *u.shape)), np.ones(u.shape)
    for k in np.argsort(p[:, 2]):
        x, y, z = p[k]
        if z < 0.05:
            continue
        J = CAMERA.fx / z * np.array([[1, 0, -x / z], [0, 1, -y / z]])
        inverse = np.linalg.inv(J @ half[k] @ half[k].T @ J.T + 0.3 * np.eye(2))
        du, dv = u - (CAMERA.fx * x / z + CAMERA.cx), v - (CAMERA.fy * y / z + CAMERA.cy)
        power = inverse[0, 0] * du * du + 2 * inverse[0, 1] * du * dv + inverse[1, 1] * dv * dv
        alpha = np.minimum(0.99, cloud.opacities()[k] * np.exp(-0.5 * power))
        alpha[alpha < 1 / 255] = 0.0
        image += cloud.colors[k][:, None, None] * alpha * left
        left *= 1 - alpha
    return np.clip(np.moveaxis(image, 0, -1), 0, 1)


def cloud_of(size_px: float, count: int = 400) -> GaussianCloud:
    """Flat Gaussians of about one size on a wavy surface a metre away."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(-0.45, 0.45, (count, 2))
    means = np.column_stack([xy, 1.0 + 0.1 * np.sin(6 * xy[:, 0])])
    sizes = size_px / CAMERA.fx * rng.uniform(0.6, 1.6, (count, 3))
    sizes[:, 2] *= 0.1
    turns = np.column_stack([np.ones(count), 0.3 * rng.normal(size=(count, 3))])
    return GaussianCloud(
        means_m=as_float32(means),
        quats_wxyz=as_float32(turns),
        scales_log=as_float32(np.log(sizes)),
        opacities_logit=as_float32(rng.normal(1.0, 1.0, count)),
        colors=as_float32(rng.uniform(0, 1, (count, 3))),
    )


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


@pytest.mark.parametrize("size_px", [0.3, 0.6, 1.2, 3.0])
def test_other_viewers_show_what_we_show(size_px: float) -> None:
    cloud, T = cloud_of(size_px), np.eye(4)
    ours = np.clip(Rasteriser(RasterConfig(threads=1)).view(cloud, CAMERA, T).image, 0, 1)
    as_stored = psnr_db(drawn_elsewhere(cloud, T), ours)
    baked = psnr_db(drawn_elsewhere(for_other_viewers(cloud, CAMERA, T), T), ours)
    assert baked > as_stored + 6.0, (as_stored, baked)
    assert baked > 30.0


def test_nothing_but_size_and_opacity_changes() -> None:
    cloud = cloud_of(1.0)
    T = se3.look_at(np.array([0.2, 0.1, -0.4]), np.array([0.0, 0, 1]), np.array([0.0, -1, 0]))
    baked = for_other_viewers(cloud, CAMERA, T)
    np.testing.assert_array_equal(baked.means_m, cloud.means_m)
    np.testing.assert_array_equal(baked.quats_wxyz, cloud.quats_wxyz)
    np.testing.assert_array_equal(baked.colors, cloud.colors)
    assert (baked.scales_log <= cloud.scales_log + 1e-6).all()
    assert (baked.opacities() <= np.maximum(cloud.opacities(), 1e-4) + 1e-6).all()


def test_render_writes_gaussians_where_a_ply_is_asked_for(tmp_path: Path) -> None:
    run = small_scene.rebuild_room(tmp_path)
    out = tmp_path / "scene.ply"
    assert robot_gst.run(["render", str(run.path), "--out", str(out), "--quiet"]) == 0
    stored = read_ply(run.scene_dir / "background.ply")
    found = read_ply(out)
    assert len(found) == len(stored)
    assert not np.allclose(found.scales_log, stored.scales_log)
