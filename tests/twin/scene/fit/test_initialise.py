from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from twin.scene.fit.initialise import NoSurfaceError, fuse
from twin.scene.frames import rgbd
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser

LIMITS = rgbd.DepthLimits(max_depth_m=5.0, flying_fraction=0.1)


def room_cloud(most: int) -> GaussianCloud:
    surfaces = [rgbd.FrameSurface(textured_room.frame(i, 6), LIMITS) for i in range(6)]
    return fuse([surface.points() for surface in surfaces], most)


def test_points_lie_on_the_surfaces_and_carry_their_colour() -> None:
    points = rgbd.FrameSurface(textured_room.frame(2, 6), LIMITS).points()
    assert len(points.p_m) > 1000
    on_table = np.abs(points.p_m[:, 2]) < 0.003
    on_wall = np.abs(points.p_m[:, 1] - 0.6) < 0.003
    assert (on_table | on_wall).mean() > 0.999
    # The colour image was looked up through its own camera, 3 cm beside the depth camera.
    error = np.abs(points.colors - textured_room.texture(points.p_m))
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.99) < 0.05


def test_pixels_without_a_measurement_never_enter() -> None:
    item = textured_room.frame(2, 6)
    depth = item.depth_m.copy()
    depth[:, ::2] = 0.0
    depth[::5] = np.float32(65.535)
    surface = rgbd.FrameSurface(replace(item, depth_m=depth), LIMITS)
    assert not surface.trusted[:, ::2].any()
    assert not surface.trusted[::5].any()
    assert surface.depth_in_color_camera().max() < 5.0


def test_a_flying_pixel_is_not_trusted() -> None:
    depth = np.full((9, 9), 1.0, dtype=np.float32)
    depth[:, 5:] = 2.0
    depth[4, 4] = 1.5
    trusted = rgbd.trusted_depth_mask(depth, LIMITS)
    assert not trusted[4, 4]
    assert trusted[1, 1]
    assert trusted[1, 8]


def test_depth_moves_to_the_colour_camera() -> None:
    item = textured_room.frame(3, 6)
    expected, _ = textured_room.depth_and_points(textured_room.COLOR, item.T_base_color)
    found = rgbd.FrameSurface(item, LIMITS).depth_in_color_camera()
    known = found > 0
    assert known.mean() > 0.6
    assert np.median(np.abs(found - expected)[known]) < 0.01


@pytest.mark.parametrize("budget", [200, 1000])
def test_the_budget_of_gaussians_is_kept(budget: int) -> None:
    assert budget / 2 < len(room_cloud(budget)) <= budget


def test_gaussians_lie_flat_on_their_surface() -> None:
    cloud = room_cloud(400)
    thin_axis = se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))[..., 2]
    table = (np.abs(cloud.means_m[:, 2]) < 0.005) & (cloud.means_m[:, 1] < 0.4)
    assert np.median(np.abs(thin_axis[table, 2])) > 0.99
    np.testing.assert_allclose(
        cloud.scales_log[:, 2] - cloud.scales_log[:, 0], np.log(0.1), atol=1e-4
    )


def registered_frame(index: int, depth_factor: float) -> RgbdFrame:
    """A frame of one camera, whose depth reads too far by a factor."""
    item = textured_room.frame(index, 6)
    depth_m, _ = textured_room.depth_and_points(item.color_camera, item.T_base_color)
    return replace(
        item,
        depth_m=(depth_factor * depth_m).astype(np.float32),
        depth_camera=item.color_camera,
        T_base_depth=item.T_base_color,
    )


def test_views_that_disagree_make_one_surface_and_not_layers() -> None:
    """The nearest of several layers would hide the others, and depth come out too near."""
    factors = 1.0 + np.array([-0.012, 0.008, -0.004, 0.004, -0.008, 0.012])
    surfaces = [rgbd.FrameSurface(registered_frame(i, f), LIMITS) for i, f in enumerate(factors)]
    points = [surface.points() for surface in surfaces]
    views = [rgbd.training_view(surface) for surface in surfaces]
    layers, surface = fuse(points, 30_000), fuse(points, 30_000, views)
    height_m = {}
    for name, cloud in (("layers", layers), ("surface", surface)):
        z = cloud.means_m[cloud.means_m[:, 1] < 0.3, 2]
        height_m[name] = np.quantile(z, 0.9) - np.quantile(z, 0.1)
        view = Rasteriser(RasterConfig(threads=1)).view(
            cloud, textured_room.COLOR, textured_room.camera_pose(2, 6)
        )
        expected, _ = textured_room.depth_and_points(
            textured_room.COLOR, textured_room.camera_pose(2, 6)
        )
        middle = (slice(16, -8), slice(12, -12))
        height_m[f"{name}, off"] = np.median(np.abs(view.depth_m - expected)[middle])
    assert height_m["surface"] < 0.6 * height_m["layers"]
    assert height_m["surface, off"] < 0.75 * height_m["layers, off"]


def test_frames_without_depth_are_refused() -> None:
    item = textured_room.frame(0, 1)
    empty = replace(item, depth_m=np.zeros_like(item.depth_m))
    with pytest.raises(NoSurfaceError, match="0 usable points"):
        fuse([rgbd.FrameSurface(empty, LIMITS).points()], 30_000)


@pytest.mark.parametrize("nothing", [np.nan, np.inf])
def test_depth_that_is_no_number_is_no_measurement(nothing: float) -> None:
    """Neither it nor its neighbours are trusted, as with 0."""
    item = textured_room.frame(2, 6)
    depth = item.depth_m.copy()
    depth[10, 10] = nothing
    surface = rgbd.FrameSurface(replace(item, depth_m=depth), LIMITS)
    zero = depth.copy()
    zero[10, 10] = 0.0
    np.testing.assert_array_equal(
        surface.trusted, rgbd.FrameSurface(replace(item, depth_m=zero), LIMITS).trusted
    )
    assert np.isfinite(surface.depth_in_color_camera()).all()


def test_normals_face_the_camera() -> None:
    points = rgbd.FrameSurface(textured_room.frame(2, 6), LIMITS).points()
    table = (np.abs(points.p_m[:, 2]) < 0.003) & (points.p_m[:, 1] < 0.5)
    np.testing.assert_allclose(np.median(points.normals[table], axis=0), [0, 0, 1], atol=0.05)
