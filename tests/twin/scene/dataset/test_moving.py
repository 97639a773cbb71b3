import re
from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.episode.streams import RgbdFrame
from bridge.geometry.camera import Camera
from twin.scene.dataset.masks import MovingVoxels, choose_reference_views, find_moving
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, PointSet, TrainingView, training_view

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
    kept = points[3].take(~moving.contains(points[3].p_m))
    near = np.linalg.norm(points[3].p_m - views[3].T_base_color[:3, 3], axis=1) < 0.42
    assert near.sum() > 500
    dropped = moving.contains(points[3].p_m)
    assert dropped[near].mean() > 0.95
    assert dropped[~near].mean() < 0.02
    assert len(kept.p_m) == len(points[3].p_m) - dropped.sum()
    for other in (0, 1, 5, 7):
        assert moving.contains(points[other].p_m).mean() < 0.02


CAMERA = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
BOX_M = 0.12
HERE, THERE = np.array([-0.15, 0.1, 0.0]), np.array([0.2, 0.2, 0.0])
NUM_FRAMES = 16


def frame_with_box(index: int, foot_m: np.ndarray | None) -> RgbdFrame:
    """The room with 2 mm of noise and a box that stands there, if anywhere."""
    T = textured_room.camera_pose(index, NUM_FRAMES)
    depth_m, _ = textured_room.depth_and_points(CAMERA, T)
    rays, eye = CAMERA.rays() @ T[:3, :3].T, T[:3, 3]
    if foot_m is not None:
        half = BOX_M / 2
        low = foot_m - np.array([half, half, 0.0])
        high = foot_m + np.array([half, half, BOX_M])
        ways = np.sort(np.stack([(low - eye) / rays, (high - eye) / rays]), axis=0)
        near, far = ways[0].max(axis=-1), ways[1].min(axis=-1)
        depth_m = np.where(near <= far, np.minimum(near, depth_m), depth_m)
    noise = np.random.default_rng(index).normal(0.0, 0.002, depth_m.shape)
    p_m = eye + rays * depth_m[..., None]
    return replace(
        textured_room.frame(index, NUM_FRAMES),
        image_u8=np.rint(textured_room.texture(p_m) * 255).clip(0, 255).astype(np.uint8),
        depth_m=(depth_m + noise).astype(np.float32),
        color_camera=CAMERA,
        depth_camera=CAMERA,
        T_base_depth=T,
    )


def what_stays(feet: list[np.ndarray | None]) -> tuple[float, float, MovingVoxels]:
    """Of the box's points the share that stays, and of the room's that goes."""
    surfaces = [FrameSurface(frame_with_box(k, foot), LIMITS) for k, foot in enumerate(feet)]
    points = [surface.points() for surface in surfaces]
    moving = find_moving(points, choose_reference_views([training_view(s) for s in surfaces]))
    box, gone = [], []
    for item, foot in zip(points, feet, strict=True):
        where = item.p_m - (foot if foot is not None else np.full(3, np.inf))
        inside = (np.abs(where[:, :2]) < BOX_M / 2 + 0.01).all(axis=1)
        box.append(inside & (where[:, 2] > 0.01) & (where[:, 2] < BOX_M + 0.01))
        gone.append(moving.contains(item.p_m))
    of_box, out = np.concatenate(box), np.concatenate(gone)
    return 1 - out[of_box].mean(), out[~of_box].mean(), moving


@pytest.mark.parametrize(("moved_at", "to"), [(4, THERE), (12, THERE), (8, None)])
def test_a_box_that_is_put_elsewhere_or_taken_away_goes_however_long_it_stood(
    moved_at: int, to: np.ndarray | None
) -> None:
    stays, lost, moving = what_stays([HERE] * moved_at + [to] * (NUM_FRAMES - moved_at))
    assert stays < 0.3  # its foot: within the margin of the table behind it
    assert lost < 0.002
    numbers = [float(word) for word in re.findall(r"-?\d+\.?\d*", moving.largest_place())]
    assert numbers[:2] == pytest.approx((100 * BOX_M, 100 * BOX_M), abs=5)
    places = [HERE] if to is None else [HERE, to]
    assert min(np.linalg.norm(numbers[3:5] - at[:2]) for at in places) < 0.03


def test_a_box_that_slides_through_the_scan_goes_and_one_that_stands_stays() -> None:
    slid = [HERE + (THERE - HERE) * k / (NUM_FRAMES - 1) for k in range(NUM_FRAMES)]
    assert what_stays([*slid])[0] < 0.3
    stays, lost, moving = what_stays([HERE] * NUM_FRAMES)
    assert stays == 1
    assert lost == 0
    assert moving.largest_place() == ""


def test_what_was_elsewhere_in_another_scan_did_not_move() -> None:
    """Between scans things are put elsewhere on purpose; each scan's are kept."""
    feet = [HERE] * 8 + [THERE] * 8
    surfaces = [FrameSurface(frame_with_box(k, foot), LIMITS) for k, foot in enumerate(feet)]
    points = [surface.points() for surface in surfaces]
    views = [training_view(surface) for surface in surfaces]
    apart = find_moving(points, choose_reference_views(views, [0] * 8 + [1] * 8))
    at_once = find_moving(points, choose_reference_views(views))
    assert len(apart.keys) < 0.2 * len(at_once.keys)


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
