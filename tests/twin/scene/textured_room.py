"""A table top and a wall with a smooth pattern, seen exactly: the truth for rebuilding tests."""

from pathlib import Path

import numpy as np
from written_messages import depth_image, put

from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.streams import RgbdFrame
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png

COLOR = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=31.0, cy=24.5)
DEPTH = Camera(width=72, height=54, fx=75.0, fy=75.0, cx=36.0, cy=27.0)
T_COLOR_DEPTH = np.eye(4)
T_COLOR_DEPTH[0, 3] = -0.03
"""The depth camera stands 3 cm beside the colour camera."""


def texture(p_m: np.ndarray) -> np.ndarray:
    """Colour of a surface point, 0..1."""
    x, y, z = np.moveaxis(p_m, -1, 0)
    red = 0.5 + 0.4 * np.sin(9 * x + 2 * z)
    green = 0.5 + 0.4 * np.sin(8 * y + 6 * z + 1)
    blue = 0.5 + 0.4 * np.cos(7 * x - 7 * y)
    return np.stack([red, green, blue], axis=-1)


def depth_and_points(camera: Camera, T_base_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cast a ray through every pixel centre onto z = 0 or the wall y = 0.6."""
    rays = camera.rays() @ T_base_camera[:3, :3].T
    origin = T_base_camera[:3, 3]
    with np.errstate(divide="ignore"):
        table = -origin[2] / rays[..., 2]
        wall = (0.6 - origin[1]) / rays[..., 1]
    table[table <= 0] = np.inf
    wall[wall <= 0] = np.inf
    depth = np.minimum(table, wall)
    return depth, origin + rays * depth[..., None]


def camera_pose(index: int, count: int) -> np.ndarray:
    """Pose ``T_base_color`` on an arc in front of the table."""
    angle = -0.5 + 1.0 * index / max(count - 1, 1)
    eye = np.array([0.9 * np.sin(angle), -0.9 * np.cos(angle), 0.55])
    return se3.look_at(eye, np.array([0.0, 0.1, 0.1]), np.array([0.0, 0.0, 1.0]))


def frame(index: int, count: int) -> RgbdFrame:
    """One exact frame, colour and depth from two cameras."""
    T_base_color = camera_pose(index, count)
    T_base_depth = T_base_color @ T_COLOR_DEPTH
    _, p_color = depth_and_points(COLOR, T_base_color)
    depth_m, _ = depth_and_points(DEPTH, T_base_depth)
    return RgbdFrame(
        camera_id="wrist",
        stamp_ns=1_000_000_000 + index * 100_000_000,
        image_u8=np.rint(texture(p_color) * 255).astype(np.uint8),
        depth_m=(np.rint(depth_m * 1e3) * 1e-3).astype(np.float32),
        color_camera=COLOR,
        depth_camera=DEPTH,
        T_base_color=T_base_color,
        T_base_depth=T_base_depth,
    )


def write_episode(
    path: Path, *, num_frames: int, kind: str = "scan", still: bool = False, sent_late_ns: int = 0
) -> None:
    """Write an episode as a recorder would; one that knows only when images were sent is late."""
    names = ("wrist_color_optical", "wrist_depth_optical")
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind=kind, cell="room", stand_in=True))
        for index in range(num_frames):
            item = frame(0 if still else index, num_frames)
            stamp = 1_000_000_000 + index * 100_000_000
            transforms = [
                FrameTransform(stamp_ns=stamp, parent="base_link", child=child, T_parent_child=T)
                for child, T in zip(names, (item.T_base_color, item.T_base_depth), strict=True)
            ]
            sent = stamp + sent_late_ns
            data = transforms_to_cdr(transforms)
            writer.write("/tf", data, type_name=schema.TF_MESSAGE, log_time_ns=sent)
            png = encode_png(item.image_u8)
            color = CompressedColor(stamp_ns=stamp, frame_id=names[0], format="png", data=png)
            put(writer, "/room/cam/wrist/color/image", color, sent)
            depth = depth_image(stamp, names[1], item.depth_m)
            put(writer, "/room/cam/wrist/depth/image", depth, sent)
            if index == 0:
                for stream, name, camera in zip(
                    ("color", "depth"), names, (COLOR, DEPTH), strict=True
                ):
                    info = CameraInfo(stamp_ns=stamp, frame_id=name, camera=camera)
                    put(writer, f"/room/cam/wrist/{stream}/info", info, sent)
