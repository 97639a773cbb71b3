from collections.abc import Sequence

import numpy as np
import textured_room
from jaxtyping import Float32

from twin.scene.fit.appearance import FeatureObservation, solve_features
from twin.scene.fit.initialise import fuse
from twin.scene.frames.rgbd import DepthLimits, FrameSurface
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.settings import InitialiseConfig

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)
NUM_FEATURES = 7


def feature_loss(
    cloud: GaussianCloud,
    features: Float32[np.ndarray, "num_splats num_features"],
    observations: Sequence[FeatureObservation],
    rasteriser: Rasteriser,
) -> float:
    """Mean squared difference of drawn and given features where they are valid (Eq. 3)."""
    total, count = 0.0, 0
    for item in observations:
        rasteriser.draw_planes(cloud, item.camera, item.T_base_camera)
        drawn = rasteriser.draw_features(np.ascontiguousarray(features))
        wrong = (drawn - item.values)[:, item.valid_mask]
        total += float(np.square(wrong, dtype=np.float64).sum())
        count += wrong.size
    return total / max(count, 1)


def room_with_features() -> tuple[GaussianCloud, np.ndarray, list[FeatureObservation]]:
    """Maps at a quarter of the size, drawn from features that are known, each with a hole."""
    surfaces = [FrameSurface(textured_room.frame(i, 4), LIMITS) for i in range(4)]
    cloud = fuse([surface.points() for surface in surfaces], InitialiseConfig(max_splats=120))
    true = np.sin(cloud.means_m @ np.random.default_rng(0).normal(size=(3, NUM_FEATURES)) * 4)
    true = true.astype(np.float32)
    rasteriser = Rasteriser(RasterConfig(threads=1))
    observations = []
    for surface in surfaces:
        camera = textured_room.COLOR.scaled(0.5)
        T = surface.frame.T_base_color
        rasteriser.draw_planes(cloud, camera, T)
        values = rasteriser.draw_features(true)
        valid = np.ones(values.shape[1:], dtype=bool)
        valid[3:6, 5:9] = False
        values[:, ~valid] = 99.0
        observations.append(
            FeatureObservation(camera=camera, T_base_camera=T, values=values, valid_mask=valid)
        )
    return cloud, true, observations


def test_features_explain_their_maps_and_come_back() -> None:
    cloud, true, observations = room_with_features()
    rasteriser = Rasteriser(RasterConfig(threads=1))
    one, many = (solve_features(cloud, observations, rasteriser, steps=steps) for steps in (1, 60))
    nothing = feature_loss(cloud, np.zeros_like(true), observations, rasteriser)
    assert feature_loss(cloud, one, observations, rasteriser) < 0.5 * nothing
    assert feature_loss(cloud, many, observations, rasteriser) < 0.01 * nothing
    assert feature_loss(cloud, true, observations, rasteriser) < 1e-9
    # Gaussians that cover several pixels are determined well; slivers at the border are not.
    assert np.median(np.abs(many - true)) < 0.05


def test_a_start_that_is_right_stays_and_one_that_is_near_comes_nearer() -> None:
    cloud, true, observations = room_with_features()
    rasteriser = Rasteriser(RasterConfig(threads=1))
    stayed = solve_features(cloud, observations, rasteriser, steps=2, start=true)
    np.testing.assert_allclose(stayed, true, atol=1e-4)
    near = true + np.random.default_rng(1).normal(scale=0.1, size=true.shape).astype(np.float32)
    solved = solve_features(cloud, observations, rasteriser, steps=2, start=near)
    before = feature_loss(cloud, near, observations, rasteriser)
    assert feature_loss(cloud, solved, observations, rasteriser) < 0.3 * before
