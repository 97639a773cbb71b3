from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.episode.streams import RgbdFrame
from twin.scene.dataset.masks import MovingVoxels, choose_reference_views, find_moving
from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import fit
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, PointSet, TrainingView, training_view
from twin.scene.settings import FitConfig, InitialiseConfig

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)
VISITOR_COLOR = np.array([255, 0, 255], dtype=np.uint8)


def with_visitor(item: RgbdFrame) -> RgbdFrame:
    """Something magenta, 0.3 m wide, hangs in front of the middle of both cameras."""
    depth_m, image_u8 = item.depth_m.copy(), item.image_u8.copy()
    depth_m[12:42, 16:56] = 0.35
    image_u8[10:39, 12:48] = VISITOR_COLOR
    return replace(item, depth_m=depth_m, image_u8=image_u8)


@pytest.fixture(scope="module")
def training() -> tuple[list[PointSet], list[TrainingView]]:
    frames = [textured_room.frame(index, 8) for index in range(8)]
    frames[3] = with_visitor(frames[3])
    surfaces = [FrameSurface(item, LIMITS) for item in frames]
    return [s.points() for s in surfaces], [training_view(s) for s in surfaces]


def test_a_visitor_is_found_and_the_room_is_left_alone(
    training: tuple[list[PointSet], list[TrainingView]],
) -> None:
    points, views = training
    moving = find_moving(points, choose_reference_views(views))
    kept = moving.drop_from(points[3])
    near = np.linalg.norm(points[3].p_m - views[3].T_base_color[:3, 3], axis=1) < 0.42
    assert near.sum() > 500
    dropped = moving.contains(points[3].p_m)
    assert dropped[near].mean() > 0.95
    assert dropped[~near].mean() < 0.02
    assert len(kept.p_m) == len(points[3].p_m) - dropped.sum()
    for other in (0, 1, 5, 7):
        assert moving.contains(points[other].p_m).mean() < 0.02


def test_the_pixels_of_a_visitor_are_masked(
    training: tuple[list[PointSet], list[TrainingView]],
) -> None:
    points, views = training
    moving = find_moving(points, choose_reference_views(views))
    masked = moving.mask_in(views[3])
    magenta = (views[3].full.planes_u8 == VISITOR_COLOR[:, None, None]).all(axis=0)
    assert (~masked.full.static_mask)[magenta].mean() > 0.9
    assert masked.full.static_mask[~magenta].mean() > 0.8
    assert masked.full.static_mask.shape == views[3].full.static_mask.shape
    assert not masked.full.depth_m[~masked.full.static_mask].any()
    assert moving.mask_in(views[0]).half.static_mask.mean() > 0.97


def test_what_was_masked_before_stays_masked(
    training: tuple[list[PointSet], list[TrainingView]],
) -> None:
    points, views = training
    moving = find_moving(points, choose_reference_views(views))
    robot = np.zeros(views[3].half.static_mask.shape, dtype=bool)
    robot[:5, 20:] = True
    masked = moving.mask_in(views[3].without(robot))
    assert not masked.half.static_mask[robot].any()
    assert not masked.full.static_mask[:10, 40:].any()
    assert (~moving.mask_in(views[3]).half.static_mask & masked.half.static_mask).sum() == 0


def test_a_visitor_leaves_no_trace_in_the_fitted_scene(
    training: tuple[list[PointSet], list[TrainingView]],
) -> None:
    points, views = training
    moving = find_moving(points, choose_reference_views(views))
    start = fuse([moving.drop_from(p) for p in points], InitialiseConfig(max_splats=1000))
    fitted = fit(
        start,
        [moving.mask_in(view) for view in views],
        FitConfig(iterations=24, threads=1),
        lambda *_: None,
    ).cloud
    distance = np.linalg.norm(fitted.means_m - views[3].T_base_color[:3, 3], axis=1)
    assert (distance < 0.42).mean() < 0.01


def test_a_still_room_has_nothing_moving() -> None:
    surfaces = [FrameSurface(textured_room.frame(index, 8), LIMITS) for index in range(8)]
    points = [surface.points() for surface in surfaces]
    views = [training_view(surface) for surface in surfaces]
    moving = find_moving(points, choose_reference_views(views))
    assert sum(moving.contains(item.p_m).sum() for item in points) < 0.005 * sum(
        len(item.p_m) for item in points
    )


def test_without_moving_voxels_a_view_passes_unchanged(
    training: tuple[list[PointSet], list[TrainingView]],
) -> None:
    nothing = MovingVoxels(keys=np.zeros(0, dtype=np.int64))
    assert nothing.mask_in(training[1][0]) is training[1][0]


def test_a_visitor_in_a_held_out_frame_is_found_by_the_training_frames(
    training: tuple[list[PointSet], list[TrainingView]],
) -> None:
    reference_views = choose_reference_views([view for i, view in enumerate(training[1]) if i != 3])
    moving = find_moving([training[0][3]], reference_views)
    masked = moving.mask_in(training[1][3])
    assert 0.3 < (~masked.full.static_mask).mean() < 0.6
