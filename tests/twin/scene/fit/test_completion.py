"""Holes of missing depth are closed as smoothly as can be, and never before what was measured."""

from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.media.image_quality import psnr_db
from twin.scene.fit.completion import complete_holes
from twin.scene.fit.initialise import fuse
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, TrainingView, training_view
from twin.scene.gaussians import GaussianCloud, concatenate
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)
MOST = 10_000
RASTER = RasterConfig(threads=1)
HOLE_M, RADIUS_M = np.array([0.0, 0.1]), 0.12


def with_hole(frame: RgbdFrame) -> RgbdFrame:
    """No depth in a disc on the table, as on a black thing."""
    p = se3.apply(frame.T_base_depth, frame.depth_camera.unproject(frame.depth_m))
    dark = (np.abs(p[..., 2]) < 0.01) & (np.linalg.norm(p[..., :2] - HOLE_M, axis=-1) < RADIUS_M)
    return replace(frame, depth_m=np.where(dark, np.float32(0.0), frame.depth_m))


@pytest.fixture(scope="module")
def scanned() -> tuple[GaussianCloud, list[TrainingView], RgbdFrame]:
    frames = [textured_room.frame(index, 9) for index in range(9)]
    surfaces = [FrameSurface(with_hole(f), LIMITS) for k, f in enumerate(frames) if k != 4]
    cloud = fuse([surface.points() for surface in surfaces], MOST)
    return cloud, [training_view(surface) for surface in surfaces], frames[4]


def picture(cloud: GaussianCloud, frame: RgbdFrame) -> np.ndarray:
    view = Rasteriser(RASTER).view(cloud, frame.color_camera, frame.T_base_color)
    return view.image_u8() / 255.0


def test_a_hole_is_closed_at_its_true_distance_and_in_a_view_that_taught_nothing(
    scanned: tuple[GaussianCloud, list[TrainingView], RgbdFrame],
) -> None:
    cloud, views, held_out = scanned
    added = complete_holes(cloud, views, MOST, RASTER)
    inside = np.linalg.norm(added.means_m[:, :2] - HOLE_M, axis=1) < RADIUS_M
    on_table = inside & (np.abs(added.means_m[:, 2]) < 0.1)
    assert on_table.sum() > 10
    assert np.median(np.abs(added.means_m[on_table, 2])) < 0.005
    depth_m = FrameSurface(held_out, LIMITS).depth_in_color_camera()
    p = se3.apply(held_out.T_base_color, held_out.color_camera.unproject(depth_m))
    near = np.linalg.norm(p[..., :2] - HOLE_M, axis=-1) < 0.8 * RADIUS_M
    hole = near & (np.abs(p[..., 2]) < 0.05)
    recorded = held_out.image_u8 / 255.0
    before = psnr_db(recorded, picture(cloud, held_out), mask=hole)
    after = psnr_db(recorded, picture(concatenate([cloud, added]), held_out), mask=hole)
    assert after > before + 5.0
    assert after > 17.0


def test_what_was_measured_stays_visible(
    scanned: tuple[GaussianCloud, list[TrainingView], RgbdFrame],
) -> None:
    """Nothing new stands in the light of a measurement: each view still sees its depth."""
    cloud, views, _ = scanned
    both = concatenate([cloud, complete_holes(cloud, views, MOST, RASTER)])
    shares = []
    for view in views:
        full = view.full
        drawn = Rasteriser(RASTER).view(both, full.camera, view.T_base_color)
        known = (full.depth_m > 0) & (drawn.depth_m > 0)
        before = drawn.depth_m[known] < full.depth_m[known] - 0.06 - 0.03 * full.depth_m[known]
        shares.append(before.mean())
    # At the rim of the hole pixels show half of each; what is opaque is the nearer.
    assert np.mean(shares) < 0.01
    assert max(shares) < 0.025
