from dataclasses import replace

import numpy as np
import pytest
import textured_room

from twin.scene import gaussians
from twin.scene.fit import optimise
from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import gain_between, solve_gains
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, training_view
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser

Room = tuple[gaussians.GaussianCloud, list[optimise.ImageObservation]]
LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)
GAINS = np.array([[1.1, 0.9, 1.0], [0.8, 1.2, 1.05], [1.1, 0.9, 0.95]])


@pytest.fixture(scope="module")
def room() -> Room:
    """Sixty Gaussians and three half-size images, each with a hole and a brightness of its own."""
    surfaces = [FrameSurface(textured_room.frame(i, 3), LIMITS) for i in range(3)]
    cloud = fuse([surface.points() for surface in surfaces], 60)
    observations = []
    for index, surface in enumerate(surfaces):
        view = training_view(surface)
        mask = view.half.static_mask.copy()
        mask[5:12, 6 + 4 * index : 14 + 4 * index] = False
        observations.append(
            optimise.ImageObservation(
                target=replace(view.half, static_mask=mask),
                T_base_camera=view.T_base_color,
                gain=GAINS[index],
            )
        )
    return cloud, observations


def rasteriser() -> Rasteriser:
    return Rasteriser(RasterConfig(threads=1))


def test_what_a_mask_hides_does_not_matter(room: Room) -> None:
    cloud, observations = room
    spoilt = []
    for item in observations:
        planes = item.target.planes_u8.copy()
        planes[:, ~item.target.static_mask] = 255
        spoilt.append(replace(item, target=replace(item.target, planes_u8=planes)))
    np.testing.assert_array_equal(
        solve_gains(cloud, observations, rasteriser()), solve_gains(cloud, spoilt, rasteriser())
    )


def test_gains_are_found_up_to_their_mean(room: Room) -> None:
    cloud, observations = room
    true = np.array([[0.8, 1.0, 0.9], [0.9, 0.7, 0.6], [0.7, 0.8, 0.9]])
    draw = rasteriser()
    exposed = []
    for item, gain in zip(observations, true, strict=True):
        planes = draw.draw_planes(cloud, item.target.camera, item.T_base_camera)[:3]
        recorded = np.rint(np.clip(planes * gain[:, None, None], 0, 1) * 255).astype(np.uint8)
        exposed.append(replace(item, target=replace(item.target, planes_u8=recorded)))
    found = solve_gains(cloud, exposed, draw)
    expected = true / true.mean(axis=0)
    np.testing.assert_allclose(found, expected, rtol=5e-3)
    np.testing.assert_allclose(found.mean(axis=0), 1.0, rtol=1e-12)


def test_a_saturated_pixel_says_nothing_about_the_gain(room: Room) -> None:
    cloud, observations = room
    item = observations[0]
    drawn = rasteriser().draw_planes(cloud, item.target.camera, item.T_base_camera)[:3]
    recorded = np.rint(np.clip(drawn, 0, 0.9) * 255).astype(np.uint8)
    recorded[:, :4] = 255
    target = replace(item.target, planes_u8=recorded)
    np.testing.assert_allclose(gain_between(gaussians.as_float32(drawn), target), 1.0, atol=0.03)
