from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.geometry import se3
from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import ImageObservation, Scores, densify, score
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, training_view
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser

Room = tuple[GaussianCloud, list[ImageObservation]]
LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)


@pytest.fixture(scope="module")
def room() -> Room:
    surfaces = [FrameSurface(textured_room.frame(i, 3), LIMITS) for i in range(3)]
    cloud = fuse([surface.points() for surface in surfaces], 200)
    views = [training_view(surface) for surface in surfaces]
    return cloud, [
        ImageObservation(target=view.full, T_base_camera=view.T_base_color, gain=np.ones(3))
        for view in views
    ]


def even_scores(cloud: GaussianCloud) -> Scores:
    """Everything is seen well and wrong alike."""
    ones = np.ones(len(cloud), dtype=np.float32)
    return Scores(error=ones, pixels=10 * ones, size_px=3 * ones, size_fraction=0.01 * ones)


def test_the_error_of_a_pixel_goes_to_the_gaussians_that_made_it(room: Room) -> None:
    cloud, observations = room
    rasteriser = Rasteriser(RasterConfig(threads=1))
    before = score(cloud, observations, rasteriser)
    wrong = int(np.argmax(before.pixels))
    colors = cloud.colors.copy()
    colors[wrong] += 0.8
    after = score(replace(cloud, colors=colors), observations, rasteriser)
    assert np.argmax(after.error - before.error) == wrong
    np.testing.assert_array_equal(after.pixels, before.pixels)
    total = sum(float(item.target.static_mask.sum()) for item in observations)
    assert 0.5 * total < before.pixels.sum() <= total * 1.001


def test_the_worst_are_split_and_the_budget_holds(room: Room) -> None:
    cloud = room[0]
    scores = even_scores(cloud)
    scores.error[[3, 50, 91]] = 5.0
    grown, parents = densify(cloud, scores, max_splats=len(cloud) + 3, most=100)
    assert len(grown) == len(cloud) + 3
    parents, counts = np.unique(parents, return_counts=True)
    np.testing.assert_array_equal(parents, np.arange(len(cloud)))
    np.testing.assert_array_equal(parents[counts == 2], [3, 50, 91])
    assert len(densify(cloud, scores, max_splats=len(cloud) + 3, most=2)[0]) == len(cloud) + 2
    assert len(densify(cloud, scores, max_splats=10, most=100)[0]) == len(cloud)


def test_two_halves_have_the_mean_and_the_covariance_of_the_whole(room: Room) -> None:
    cloud = room[0].take(np.array([11]))
    cloud = replace(cloud, scales_log=as_float32(np.log([[0.02, 0.05, 0.004]])))
    halves = densify(cloud, even_scores(cloud), max_splats=2, most=1)[0]

    def covariances(of: GaussianCloud) -> np.ndarray:
        R = se3.rotation_from_quaternion(of.quats_wxyz.astype(np.float64))
        RS = R * np.exp(of.scales_log.astype(np.float64))[:, None, :]
        return RS @ np.swapaxes(RS, 1, 2)

    middle = halves.means_m.mean(axis=0)
    np.testing.assert_allclose(middle, cloud.means_m[0], atol=1e-6)
    apart = (halves.means_m - middle).astype(np.float64)
    mixed = covariances(halves).mean(axis=0) + apart.T @ apart / 2
    np.testing.assert_allclose(mixed, covariances(cloud)[0], rtol=0.02, atol=1e-7)
    np.testing.assert_array_equal(halves.colors, cloud.colors[[0, 0]])


def test_what_is_transparent_unseen_or_huge_goes(room: Room) -> None:
    cloud = room[0]
    opacities = cloud.opacities_logit.copy()
    opacities[5] = -6.0
    scores = even_scores(cloud)
    scores.pixels[6] = 0.0
    scores.size_fraction[7] = 0.5
    faded = replace(cloud, opacities_logit=opacities)
    left, parents = densify(faded, scores, max_splats=len(cloud) - 3, most=10)
    assert not set(parents.tolist()) & {5, 6, 7}
    assert len(left) == len(parents) == len(cloud) - 3


def test_nothing_is_lost_when_nothing_is_seen(room: Room) -> None:
    cloud = room[0]
    scores = replace(even_scores(cloud), pixels=np.zeros(len(cloud), dtype=np.float32))
    assert len(densify(cloud, scores, max_splats=len(cloud), most=0)[0]) == len(cloud)


def test_what_no_image_can_resolve_is_not_split(room: Room) -> None:
    cloud = room[0]
    scores = replace(even_scores(cloud), size_px=np.full(len(cloud), 0.2, dtype=np.float32))
    assert len(densify(cloud, scores, max_splats=10_000, most=100)[0]) == len(cloud)
