"""Write an episode: a camera that moves around a table, with depth, poses and joints.

Run: python examples/write_episode.py runs/example/episodes/scan.mcap
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    JointSample,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png

CAMERA = Camera(width=80, height=60, fx=70.0, fy=70.0, cx=40.0, cy=30.0)
FRAME = "wrist_optical"
UP = np.array([0.0, 0.0, 1.0])
NUM_FRAMES, PERIOD_NS = 12, 100_000_000


def look(angle_rad: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pose ``T_base_camera``, image [0..255] and depth [mm] of a chequered table, z = 0."""
    eye = np.array([0.8 * np.sin(angle_rad), -0.8 * np.cos(angle_rad), 0.6])
    T_base_camera = se3.look_at(eye, np.zeros(3), UP)
    rays = CAMERA.rays() @ T_base_camera[:3, :3].T
    depth_m = -eye[2] / np.minimum(rays[..., 2], -1e-3)
    points = eye + rays * depth_m[..., None]
    shade = 0.5 + 0.2 * np.sin(12 * points[..., :1]) * np.cos(9 * points[..., 1:2])
    image_u8 = np.rint(255 * shade * np.array([1.0, 0.8, 0.6])).astype(np.uint8)
    return T_base_camera, image_u8, np.rint(1000 * np.clip(depth_m, 0, 5)).astype(np.uint16)


def messages(index: int, stamp_ns: int) -> Iterator[tuple[str, str, bytes]]:
    """Yield topic, type and payload of everything that happens at one instant."""
    angle_rad = 0.08 * (index - NUM_FRAMES / 2)
    T_base_camera, image_u8, depth_mm = look(angle_rad)
    pose = FrameTransform(
        stamp_ns=stamp_ns, parent="base_link", child=FRAME, T_parent_child=T_base_camera
    )
    color = CompressedColor(
        stamp_ns=stamp_ns, frame_id=FRAME, format="png", data=encode_png(image_u8)
    )
    depth = DepthImage(stamp_ns=stamp_ns, frame_id=FRAME, depth_mm=depth_mm)
    info = CameraInfo(stamp_ns=stamp_ns, frame_id=FRAME, camera=CAMERA)
    joints = JointSample(
        stamp_ns=stamp_ns,
        names=("shoulder", "elbow"),
        position=np.array([angle_rad, 0.5]),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )
    yield "/tf", schema.TF_MESSAGE, transforms_to_cdr([pose])
    yield "/lab/cam/wrist/color/info", schema.CAMERA_INFO, info.to_cdr()
    yield "/lab/cam/wrist/depth/info", schema.CAMERA_INFO, info.to_cdr()
    yield "/lab/cam/wrist/color/image", schema.COMPRESSED_IMAGE, color.to_cdr()
    yield "/lab/cam/wrist/depth/image", schema.IMAGE, depth.to_cdr()
    yield "/lab/joint_states", schema.JOINT_STATE, joints.to_cdr()


def main(path: Path) -> None:
    """Write the episode; the file has its final name only when it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="scan", cell="lab"))
        for index in range(NUM_FRAMES):
            stamp_ns = 1_000_000_000 + index * PERIOD_NS
            for topic, type_name, data in messages(index, stamp_ns):
                writer.write(
                    topic,
                    data,
                    type_name=type_name,
                    log_time_ns=stamp_ns + 2_000_000,  # received
                    publish_time_ns=stamp_ns,  # happened
                )
    print(f"{path}: {NUM_FRAMES} frames")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
