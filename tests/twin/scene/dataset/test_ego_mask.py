from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.dataset.masks import find_dark_rim, find_ego_mask, without_ego
from twin.scene.frames.rgbd import PointSet, Target, TrainingView

FULL = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
HALF = FULL.scaled(0.5)
FINGERS = (slice(0, 40), (slice(12, 42), slice(118, 148)))
NUM_VIEWS = 9


def target(camera: Camera, T: np.ndarray) -> Target:
    """The textured room with finer patterns, as one camera sees it."""
    depth_m, p = textured_room.depth_and_points(camera, T)
    pattern = textured_room.texture(6.0 * p) * 0.7 + textured_room.texture(2.0 * p) * 0.3
    return Target(
        camera=camera,
        planes_u8=np.ascontiguousarray(np.moveaxis(np.rint(pattern * 255), -1, 0), dtype=np.uint8),
        depth_m=np.where(np.isfinite(depth_m), depth_m, 0.0).astype(np.float32),
        static_mask=np.ones(depth_m.shape, dtype=bool),
    )


def room_views(count: int = NUM_VIEWS) -> list[TrainingView]:
    poses = [textured_room.camera_pose(index, count) for index in range(count)]
    return [
        TrainingView(
            camera_id="wrist",
            stamp_ns=index,
            T_base_color=T,
            half=target(HALF, T),
            full=target(FULL, T),
        )
        for index, T in enumerate(poses)
    ]


@pytest.fixture(scope="module")
def views() -> list[TrainingView]:
    return room_views()


def finger_mask() -> np.ndarray:
    mask = np.zeros((HALF.height, HALF.width), dtype=bool)
    for columns in FINGERS[1]:
        mask[FINGERS[0], columns] = True
    return mask


def with_gripper(
    views: list[TrainingView], *, depth_m: float, exposures: np.ndarray | None = None
) -> list[TrainingView]:
    """Two speckled dark fingers at the top of every half-size image; nothing of them is scene."""
    rng = np.random.default_rng(0)
    speckles = rng.integers(20, 90, size=(HALF.height // 3 + 1, HALF.width // 3 + 1))
    speckles = np.kron(speckles, np.ones((3, 3)))[: HALF.height, : HALF.width]
    mask = finger_mask()
    shown = []
    gains = np.ones(len(views)) if exposures is None else exposures
    for view, gain in zip(views, gains, strict=True):
        planes = np.where(mask, speckles, view.half.planes_u8)
        planes = np.clip(gain * planes, 0, 255).astype(np.uint8)
        depth = np.where(mask, np.float32(depth_m), view.half.depth_m)
        shown.append(replace(view, half=replace(view.half, planes_u8=planes, depth_m=depth)))
    return shown


@pytest.mark.parametrize("depth_m", [0.0, 0.25])
def test_a_gripper_before_a_moving_camera_is_found(
    views: list[TrainingView], depth_m: float
) -> None:
    exposures = np.random.default_rng(1).uniform(0.7, 1.3, len(views))
    found = find_ego_mask(with_gripper(views, depth_m=depth_m, exposures=exposures))
    assert found is not None
    fingers = finger_mask()
    assert found[fingers].mean() > 0.97
    assert found[~fingers].mean() < 0.08  # the border it grows by, and little else


def test_a_tip_that_wobbles_is_known_by_its_depth_and_a_patch_elsewhere_is_not(
    views: list[TrainingView],
) -> None:
    rng = np.random.default_rng(2)
    tip, patch = (slice(40, 60), slice(14, 40)), (slice(80, 100), slice(60, 90))
    shown = []
    for index, view in enumerate(with_gripper(views, depth_m=0.25)):
        planes, depth_m = view.half.planes_u8.copy(), view.half.depth_m.copy()
        for place in (tip, patch):
            planes[:, *place] = rng.integers(0, 255, planes[:, *place].shape)
            depth_m[place] = 0.24 + rng.normal(0, 0.002, depth_m[place].shape)
            if index % 2:  # often too near for the sensor
                depth_m[place] = 0.0
        shown.append(replace(view, half=replace(view.half, planes_u8=planes, depth_m=depth_m)))
    found = find_ego_mask(shown)
    assert found is not None
    assert found[tip].mean() > 0.97
    assert not found[patch].any()  # it hangs on nothing that is carried


def test_an_edge_along_the_path_is_scene_when_depth_says_so() -> None:
    """A camera slides along a striped wall: stripes stay where they are in the image."""
    views = []
    for index in range(NUM_VIEWS):
        T = se3.look_at(
            np.array([0.1 * index, -0.8, 0.4]),
            np.array([0.1 * index, 0.6, 0.4]),
            np.array([0.0, 0.0, 1.0]),
        )
        halves = []
        for camera in (HALF, FULL):
            item = target(camera, T)
            _, p = textured_room.depth_and_points(camera, T)
            stripes = np.rint(127 + 100 * np.sign(np.sin(40 * p[..., 2] + 40 * p[..., 1])))
            planes = np.repeat(stripes[None], 3, axis=0).astype(np.uint8)
            halves.append(replace(item, planes_u8=planes))
        views.append(
            TrainingView(
                camera_id="wrist", stamp_ns=index, T_base_color=T, half=halves[0], full=halves[1]
            )
        )
    assert find_ego_mask(views) is None


def test_a_camera_that_stands_still_says_nothing(views: list[TrainingView]) -> None:
    same = [replace(views[0], stamp_ns=index) for index in range(NUM_VIEWS)]
    assert find_ego_mask(with_gripper(same, depth_m=0.0)) is None
    assert find_ego_mask(with_gripper(views[:4], depth_m=0.0)) is None
    assert find_ego_mask([]) is None


def test_what_lies_beside_a_lens_circle_is_found_and_a_dark_thing_is_not(
    views: list[TrainingView],
) -> None:
    def dark(mask: np.ndarray) -> list[TrainingView]:
        return [
            replace(
                view,
                half=replace(
                    view.half,
                    planes_u8=np.where(mask, np.uint8(0), view.half.planes_u8),
                    depth_m=np.where(mask, np.float32(0), view.half.depth_m),
                ),
            )
            for view in views
        ]

    rows, columns = np.mgrid[0 : HALF.height, 0 : HALF.width] + 0.5
    rim = np.hypot(rows - HALF.height / 2, columns - HALF.width / 2) > 0.55 * HALF.width
    found = find_dark_rim(dark(rim))
    assert found is not None
    assert found[rim].all()
    assert found.sum() < 1.6 * rim.sum()
    assert find_dark_rim([*dark(rim), views[0]]) is None  # one view shows the scene there
    thing = (rows < 30) & (columns < 40)  # in one corner
    assert find_dark_rim(dark(thing)) is None
    assert find_dark_rim(views) is None


def test_points_and_pixels_of_the_gripper_are_left_out(views: list[TrainingView]) -> None:
    view, mask = views[0], finger_mask()
    known = view.half.depth_m > 0
    p = se3.apply(view.T_base_color, view.half.camera.unproject(view.half.depth_m)[known])
    count = len(p)
    points = PointSet(
        p_m=p.astype(np.float32),
        normals=np.zeros((count, 3), dtype=np.float32),
        colors=np.zeros((count, 3), dtype=np.float32),
        footprint_m=np.ones(count, dtype=np.float32),
    )
    left, masked = without_ego(points, view, mask)
    assert len(left.p_m) == (known & ~mask).sum()
    np.testing.assert_array_equal(masked.half.static_mask, ~mask)
    assert not masked.full.depth_m[~masked.full.static_mask].any()
    assert masked.full.static_mask.mean() == pytest.approx(1 - mask.mean())
