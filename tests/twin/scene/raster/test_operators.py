"""Laws of the rasteriser's linear maps, and what strange Gaussians do to it."""

import numpy as np
import pytest
from clouds import any_cloud, even_cloud
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_pull import pull_back

from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud, arrays, as_float32
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, load_native

CAMERA = Camera(width=50, height=35, fx=60.0, fy=60.0, cx=25.0, cy=17.5)
"""Neither edge is a whole number of tiles."""


def shiny_cloud(count: int, seed: int = 0) -> GaussianCloud:
    box, shine = [[-0.6, -0.5, 0.4], [0.6, 0.5, 3.0]], {"harmonics": 3, "shine": 0.2}
    return any_cloud(seed, count, box, (0.002, 0.08), mean=1.0, spread=2.0, **shine)


def drawn(cloud: GaussianCloud, config: RasterConfig) -> Rasteriser:
    rasteriser = Rasteriser(config)
    rasteriser.draw_planes(cloud, CAMERA, np.eye(4))
    return rasteriser


@pytest.mark.parametrize("isa", load_native().available_isas())
@pytest.mark.parametrize("channels", [1, 5, 16, 33])
def test_lifting_is_the_adjoint_of_drawing(isa: str, channels: int) -> None:
    cloud = shiny_cloud(800)
    rasteriser = drawn(cloud, RasterConfig(threads=1, isa=isa))
    rng = np.random.default_rng(1)
    features = as_float32(rng.normal(size=(800, channels)))
    maps = as_float32(rng.normal(size=(channels, CAMERA.height, CAMERA.width)))
    left = (rasteriser.draw_features(features).astype(np.float64) * maps).sum()
    right = (rasteriser.lift(maps).astype(np.float64) * features).sum()
    size = np.linalg.norm(features) * np.linalg.norm(maps)
    assert abs(left - right) < 1e-6 * size


def test_any_number_of_threads_gives_the_same_bits() -> None:
    cloud = shiny_cloud(9000, seed=4)  # enough for several stretches of the depth order
    rng = np.random.default_rng(5)
    features = as_float32(rng.normal(size=(9000, 7)))
    maps = as_float32(rng.normal(size=(7, CAMERA.height, CAMERA.width)))
    upstream = rng.normal(size=(5, CAMERA.height, CAMERA.width)).astype(np.float32)
    labels = rng.integers(0, 9, size=9000).astype(np.uint16)
    results = []
    for threads in (1, 2, 3, 4):
        rasteriser = Rasteriser(RasterConfig(threads=threads))
        planes = rasteriser.draw_planes(cloud, CAMERA, np.eye(4))
        gradient = pull_back(rasteriser, planes, upstream)
        results.append(
            [
                planes,
                *(getattr(gradient, name) for name, _ in arrays(cloud)),
                gradient.T_camera_base,
                rasteriser.draw_features(features),
                rasteriser.lift(maps),
                *rasteriser.label_map(labels),
            ]
        )
    for other in results[1:]:
        for first, second in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(first, second)


STRANGE = st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1e30, -1e30, 1e-30, -50.0, 80.0])


@settings(max_examples=60)
@given(
    spoiled=st.lists(
        st.tuples(
            st.sampled_from(["means_m", "quats_wxyz", "scales_log", "opacities_logit"]),
            st.integers(0, 29),
            STRANGE,
        ),
        max_size=12,
    ),
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    isa=st.sampled_from(load_native().available_isas()),
)
def test_strange_gaussians_and_sizes_never_spoil_the_image(
    spoiled: list[tuple[str, int, float]], size: tuple[int, int], isa: str
) -> None:
    cloud = shiny_cloud(30)
    for name, row, value in spoiled:
        getattr(cloud, name)[row] = value
    camera = Camera(width=size[0], height=size[1], fx=40.0, fy=40.0, cx=size[0] / 2, cy=size[1] / 2)
    rasteriser = Rasteriser(RasterConfig(threads=1, isa=isa))
    planes = rasteriser.draw_planes(cloud, camera, np.eye(4))
    assert planes.shape == (5, size[1], size[0])
    assert np.isfinite(planes).all()
    assert planes[4].min() >= 0.0
    assert planes[4].max() <= 1.0 + 1e-5
    gradient = pull_back(rasteriser, planes, np.ones_like(planes))
    sound = [row for row in range(30) if row not in {entry[1] for entry in spoiled}]
    for name, _ in arrays(cloud):
        assert np.isfinite(getattr(gradient, name)[sound]).all(), name
    total = rasteriser.lift(np.ones((1, size[1], size[0]), np.float32)).sum()
    assert total == pytest.approx(planes[4].sum(), rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("offset", [-0.5, 0.0, 0.25, 0.5])
@pytest.mark.parametrize("edge", [0, 16, 32, 48])
def test_a_gaussian_on_a_tile_edge_is_whole(edge: int, offset: float) -> None:
    """The same ellipse inside a tile and across an edge has the same sum."""

    def alpha_sum(x_px: float) -> float:
        x = (x_px - CAMERA.cx) / CAMERA.fx
        cloud = even_cloud(np.array([[x, 0.0, 1.0]]), 1.0, 0.02, logit=0.0)
        wide = Camera(width=120, height=35, fx=60.0, fy=60.0, cx=25.0 + 40, cy=17.5)
        rasteriser = Rasteriser(RasterConfig(threads=1, alpha_cut=1e-4))
        return float(rasteriser.draw_planes(cloud, wide, np.eye(4))[4].sum())

    # Off the axis the affine approximation stretches the ellipse a little.
    inside = alpha_sum(edge + offset + 8.0)
    assert alpha_sum(edge + offset) == pytest.approx(inside, rel=0.12)
    neighbours = [alpha_sum(edge + offset + shift) for shift in (-0.01, 0.0, 0.01)]
    assert max(neighbours) - min(neighbours) < 2e-3 * inside
