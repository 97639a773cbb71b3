"""A camera that was bumped since the scan is found by what stands still; truth by construction."""

from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.align.moved_camera import MOVED_M, MOVED_RAD, MovedCamera, moved_camera
from twin.scene.fit.initialise import fuse
from twin.scene.frames.rgbd import DepthLimits, FrameSurface
from twin.scene.gaussians import GaussianCloud

CAMERA = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)


def seen_from(T_base_camera: np.ndarray, index: int = 0) -> RgbdFrame:
    depth_m, p = textured_room.depth_and_points(CAMERA, T_base_camera)
    return RgbdFrame(
        camera_id="side",
        stamp_ns=index,
        image_u8=np.rint(textured_room.texture(p) * 255).astype(np.uint8),
        depth_m=depth_m.astype(np.float32),
        color_camera=CAMERA,
        depth_camera=CAMERA,
        T_base_color=T_base_camera,
        T_base_depth=T_base_camera,
    )


def bumped_by(shift_m: tuple[float, ...], turn_deg: tuple[float, ...]) -> np.ndarray:
    return se3.small_motion(np.array([*np.radians(turn_deg), *shift_m]))


@pytest.fixture(scope="module")
def background() -> GaussianCloud:
    frames = [seen_from(textured_room.camera_pose(index, 7), index) for index in range(7)]
    points = [FrameSurface(frame, LIMITS).points() for frame in frames]
    return fuse(points, 40_000)


def compared(background: GaussianCloud, bump: np.ndarray) -> MovedCamera | None:
    """What is said of a camera that was bumped, and whose poses are as before."""
    said = textured_room.camera_pose(2, 5)
    frame = replace(seen_from(said @ bump), T_base_color=said, T_base_depth=said)
    return moved_camera([frame], background)


def test_a_camera_that_stands_where_it_stood_is_left_alone(background: GaussianCloud) -> None:
    assert compared(background, np.eye(4)) is None
    assert compared(background, bumped_by((0.002, 0.0, 0.0), (0.0, 0.1, 0.0))) is None


@pytest.mark.parametrize(
    ("shift_m", "turn_deg"),
    [((0.008, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.0, 0.8, 0.0)),
     ((0.02, -0.015, 0.01), (1.5, -1.0, 2.0))],
)  # fmt: skip
def test_a_bumped_camera_is_registered_again(
    background: GaussianCloud, shift_m: tuple[float, ...], turn_deg: tuple[float, ...]
) -> None:
    bump = bumped_by(shift_m, turn_deg)
    moved = compared(background, bump)
    assert moved is not None
    again = MovedCamera.from_record(moved.to_record())
    assert again.T_posed_true is not None
    left = se3.invert(bump) @ again.T_posed_true
    assert np.linalg.norm(left[:3, 3]) < MOVED_M
    assert se3.rotation_angle_rad(left[:3, :3]) < MOVED_RAD
    assert "was moved by" in moved.describe("side")


def test_a_camera_before_another_room_is_lost_and_said_to_be(background: GaussianCloud) -> None:
    other = replace(
        seen_from(textured_room.camera_pose(2, 5)),
        depth_m=np.full((240, 320), 0.45, dtype=np.float32),
        image_u8=np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8),
    )
    moved = moved_camera([other], background)
    assert moved is not None
    assert moved.T_posed_true is None
    assert "scan again" in moved.describe("side")
