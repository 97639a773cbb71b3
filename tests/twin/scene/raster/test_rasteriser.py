from dataclasses import replace

import numpy as np
import pytest
from clouds import any_cloud, even_cloud
from splat_pull import pull_back

from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud, arrays, as_float32, concatenate
from twin.scene.raster import rasteriser as raster
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, SplatExtensionMissingError

CAMERA = Camera(width=40, height=33, fx=60.0, fy=60.0, cx=20.0, cy=16.5)
IDENTITY = np.eye(4)


def one_gaussian(
    *,
    x_px: float,
    y_px: float,
    depth_m: float = 1.0,
    sigma_m: float = 0.02,
    opacity_logit: float = 3.0,
) -> GaussianCloud:
    """A round Gaussian whose centre projects to one place of the image."""
    mean = [(x_px - CAMERA.cx) / CAMERA.fx * depth_m, (y_px - CAMERA.cy) / CAMERA.fy * depth_m]
    return even_cloud(np.array([[*mean, depth_m]]), [0.2, 0.5, 0.9], sigma_m, opacity_logit)


def many_gaussians(count: int = 3000, seed: int = 7) -> GaussianCloud:
    return any_cloud(seed, count, [[-0.5, -0.4, 0.5], [0.5, 0.4, 3.0]], (0.002, 0.05))


def draw(cloud: GaussianCloud, config: RasterConfig | None = None) -> np.ndarray:
    return Rasteriser(config or RasterConfig(threads=1)).draw_planes(cloud, CAMERA, IDENTITY)


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0, -65.0])
def test_depth_follows_the_plane_of_a_flat_gaussian(tilt_deg: float) -> None:
    """Not the depth of its centre: rays meet a tilted disc at other distances."""
    half = np.radians(tilt_deg) / 2
    disc = one_gaussian(x_px=20.0, y_px=16.5, depth_m=2.0, opacity_logit=8.0)
    disc.quats_wxyz[:] = [np.cos(half), 0.0, np.sin(half), 0.0]
    disc.scales_log[:] = np.log([0.2, 0.2, 1e-4])
    depth_m = Rasteriser(RasterConfig(threads=1)).view(disc, CAMERA, IDENTITY).depth_m
    normal = np.array([np.sin(2 * half), 0.0, np.cos(2 * half)])
    expected = normal[2] * 2.0 / (CAMERA.rays() @ normal)
    row = slice(15, 18)
    shown = depth_m[row] > 0
    assert shown.sum() >= 9
    # What is left is of second order in the distance from the centre.
    spread = np.ptp(expected[row][shown])
    assert np.abs(depth_m - expected)[row][shown].max() < 0.5 * spread**2 + 1e-3
    assert tilt_deg == 0.0 or spread > 0.05


def test_alpha_of_a_single_gaussian_is_the_closed_form() -> None:
    planes = draw(one_gaussian(x_px=12.5, y_px=7.5, sigma_m=0.05, opacity_logit=1.0))
    variance = (CAMERA.fx * 0.05) ** 2
    # Slightly off the axis the affine approximation stretches the ellipse by a few per cent.
    opacity = 1 / (1 + np.exp(-1.0)) * variance / (variance + 0.1)
    assert planes[4, 7, 12] == pytest.approx(opacity, rel=5e-3)
    assert planes[4, 7, 15] == pytest.approx(
        opacity * np.exp(-0.5 * 9 / (variance + 0.1)), rel=3e-2
    )


@pytest.mark.parametrize("broken", ["means_m", "scales_log", "opacities_logit", "colors"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_a_broken_gaussian_does_not_spoil_the_others(broken: str, value: float) -> None:
    cloud = many_gaussians(50)
    spoiled = {name: rows.copy() for name, rows in arrays(cloud)}
    spoiled[broken][10] = value
    rasteriser = Rasteriser(RasterConfig(threads=1))
    planes = rasteriser.draw_planes(GaussianCloud(**spoiled), CAMERA, IDENTITY)
    if not (broken == "colors" and np.isfinite(value)):
        assert np.isfinite(planes).all()
    gradient = pull_back(rasteriser, planes, np.ones_like(planes))
    others = np.arange(50) != 10
    if not (broken == "colors" and np.isfinite(value)):
        assert all(np.isfinite(getattr(gradient, n)[others]).all() for n, _ in arrays(cloud))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("num_over", [0, 40, 2000])
def test_drawing_over_has_the_bits_of_drawing_at_once(num_over: int, threads: int) -> None:
    under, over = many_gaussians(), many_gaussians(num_over, seed=8)
    over = replace(over, means_m=as_float32(over.means_m * 0.4 + [0.0, 0.0, 1.2]))
    over.means_m[:20] = under.means_m[: len(over.means_m[:20])]  # equal depths keep their order
    hidden = np.zeros(len(under), dtype=bool)
    hidden[100:160] = True
    pale = replace(under, opacities_logit=np.where(hidden, np.float32(-30), under.opacities_logit))
    rasteriser = Rasteriser(RasterConfig(threads=threads))
    planes = rasteriser.draw_planes(under, CAMERA, IDENTITY)
    drawn = rasteriser.draw_over(over, planes, hidden)
    np.testing.assert_array_equal(drawn, draw(concatenate([pale, over])))
    assert (drawn != planes).any()
    np.testing.assert_array_equal(
        rasteriser.draw_over(over, planes), draw(concatenate([under, over]))
    )


def test_drawing_over_needs_what_was_drawn() -> None:
    rasteriser, cloud = Rasteriser(), many_gaussians(10)
    planes = rasteriser.draw_planes(cloud, CAMERA, IDENTITY)
    with pytest.raises(ValueError, match="row per Gaussian of the last draw"):
        rasteriser.draw_over(cloud, planes, np.zeros(9, dtype=bool))
    with pytest.raises(ValueError, match="not those of the last draw"):
        rasteriser.draw_over(cloud, planes[:, 1:].copy())


def test_an_empty_cloud_draws_black() -> None:
    planes = draw(many_gaussians(1).take(np.zeros(0, dtype=int)))
    assert planes.shape == (5, 33, 40)
    assert planes.max() == 0.0


def test_a_missing_extension_says_how_to_build_it(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    import twin.scene

    monkeypatch.setitem(sys.modules, "twin.scene._splat", None)
    monkeypatch.delattr(twin.scene, "_splat", raising=False)
    with pytest.raises(SplatExtensionMissingError, match="pip install"):
        raster.load_native()
