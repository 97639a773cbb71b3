from dataclasses import replace

import numpy as np
import pytest
import textured_room

from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import SurfacePrior
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, TrainingView, training_view
from twin.scene.gaussians import GaussianCloud, as_float32

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)


@pytest.fixture(scope="module")
def room() -> tuple[GaussianCloud, list[TrainingView]]:
    surfaces = [FrameSurface(textured_room.frame(i, 4), LIMITS) for i in range(4)]
    start = fuse([surface.points() for surface in surfaces], 500)
    return start, [training_view(surface) for surface in surfaces]


def test_what_left_the_slab_comes_back_to_its_border_and_nothing_else_moves(
    room: tuple[GaussianCloud, list[TrainingView]],
) -> None:
    cloud = room[0]
    prior = SurfacePrior.of(cloud)
    rng = np.random.default_rng(0)
    off = rng.normal(scale=2.0, size=len(cloud)) * prior.sizes_m
    along = np.cross(prior.normals, rng.normal(size=prior.normals.shape)) * 0.01
    moved = replace(cloud, means_m=as_float32(cloud.means_m + off[:, None] * prior.normals + along))
    prior.hold(moved)
    left = np.einsum("ni,ni->n", moved.means_m - cloud.means_m, prior.normals)
    half = 0.5 * prior.sizes_m
    np.testing.assert_allclose(left, np.clip(off, -half, half), atol=1e-5)
    sideways = moved.means_m - cloud.means_m - left[:, None] * prior.normals
    np.testing.assert_allclose(sideways, along, atol=1e-5)


def test_halves_keep_the_plane_of_the_whole() -> None:
    prior = SurfacePrior(
        normals=as_float32(np.eye(3)),
        heights_m=as_float32(np.arange(3.0)),
        sizes_m=as_float32(np.ones(3)),
    )
    taken = prior.take(np.array([2, 2, 0]))
    np.testing.assert_array_equal(taken.heights_m, [2.0, 2.0, 0.0])
    np.testing.assert_array_equal(taken.normals[0], taken.normals[1])
