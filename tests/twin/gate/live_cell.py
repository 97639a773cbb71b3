"""A cell with one camera, shown to a live view message by message."""

import json

import numpy as np

from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from twin.gate.live import LiveFrames, LiveView

S = 1_000_000_000
CAMERA = Camera(width=8, height=6, fx=10.0, fy=10.0, cx=4.0, cy=3.0)
IMAGE = encode_jpeg(np.full((6, 8, 3), 128, dtype=np.uint8))


def look(view: LiveView, most: int = 3) -> LiveFrames:
    return view.frames(max_age_ns=5 * S, max_per_camera=most)


def calibrate(view: LiveView) -> None:
    for stream in ("color", "depth"):
        info = CameraInfo(stamp_ns=0, frame_id=f"side_{stream}_optical", camera=CAMERA)
        view.take(f"/standin/cam/side/{stream}/info", info.to_cdr(), 0)


def place(view: LiveView, stamp_ns: int = 0, x_m: float = 0.0, topic: str = "/tf_static") -> None:
    T = np.eye(4)
    T[0, 3] = x_m
    items = [
        FrameTransform(
            stamp_ns=stamp_ns, parent="base_link", child=f"side_{name}_optical", T_parent_child=T
        )
        for name in ("color", "depth")
    ]
    view.take(topic, transforms_to_cdr(items), 0)


def shoot(view: LiveView, stamp_ns: int, *, depth_lag_ns: int = 0) -> None:
    color = CompressedColor(stamp_ns=stamp_ns, frame_id="c", format="jpeg", data=IMAGE)
    depth = DepthImage(
        stamp_ns=stamp_ns + depth_lag_ns,
        frame_id="d",
        depth_mm=np.full((6, 8), 500, dtype=np.uint16),
    )
    view.take("/standin/cam/side/color/image", color.to_cdr(), 0)
    view.take("/standin/cam/side/depth/image", depth.to_cdr(), 0)


def event(view: LiveView, kind: str, stamp_ns: int) -> None:
    record = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, "plan_id": "plan_1"}
    view.take("/standin/event", json.dumps(record).encode(), 0)
