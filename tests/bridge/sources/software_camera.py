"""RealSense cameras made of librealsense's own software device: real sensors, queues, profiles."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyrealsense2 as rs

ROTATION_Z = (0.8, 0.6, 0.0, -0.6, 0.8, 0.0, 0.0, 0.0, 1.0)
"""Column by column, as librealsense has it: x turns towards y."""


def intrinsics(width: int, height: int, *, fx: float, coeffs: tuple[float, ...] = ()) -> Any:
    made = rs.intrinsics()
    made.width, made.height = width, height
    made.fx, made.fy = fx, fx + 1.5
    made.ppx, made.ppy = width / 2 - 3.25, height / 2 + 2.5
    made.model = rs.distortion.inverse_brown_conrady
    made.coeffs = [*coeffs, 0.0, 0.0, 0.0, 0.0, 0.0][:5]
    return made


def stream(kind: Any, pixels: Any, uid: int, found: Any, fps: int = 30) -> Any:
    made = rs.video_stream()
    made.type, made.fmt, made.uid, made.index, made.fps = kind, pixels, uid, 0, fps
    made.width, made.height = found.width, found.height
    made.bpp = 2 if pixels == rs.format.z16 else 3
    made.intrinsics = found
    return made


@dataclass
class SoftwareCamera:
    """A camera whose frames the test makes."""

    serial: str = "123622270224"
    model: str = "Intel RealSense D435"
    size: tuple[int, int] = (640, 480)
    one_sensor: bool = False
    coeffs: tuple[float, ...] = ()
    unit_m: float = 0.001
    unit_settable: bool = False
    domain: Any = rs.timestamp_domain.global_time
    lens: Any = None
    """``rs.intrinsics`` of both streams, seen from one place; None: as usual, two lenses."""
    device: Any = field(init=False)

    def __post_init__(self) -> None:
        """Build the device as librealsense shows the real one."""
        width, height = self.size
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, self.model)
        self.device.register_info(rs.camera_info.serial_number, self.serial)
        self.depth_sensor = self.device.add_sensor("Stereo Module")
        self.color_sensor = (
            self.depth_sensor if self.one_sensor else self.device.add_sensor("RGB Camera")
        )
        depth = self.lens or intrinsics(width, height, fx=385.0)
        color = self.lens or intrinsics(width, height, fx=610.0, coeffs=self.coeffs)
        self.depth = self.depth_sensor.add_video_stream(
            stream(rs.stream.depth, rs.format.z16, 1, depth)
        )
        self.color = self.color_sensor.add_video_stream(
            stream(rs.stream.color, rs.format.rgb8, 2, color)
        )
        if self.unit_settable:
            allowed = rs.option_range()
            allowed.min, allowed.max, allowed.step, allowed.default = 0.0, 1.0, 0.0, self.unit_m
            self.depth_sensor.add_option(rs.option.depth_units, allowed, True)
        else:
            self.depth_sensor.add_read_only_option(rs.option.depth_units, self.unit_m)
        between = rs.extrinsics()
        between.rotation, between.translation = list(ROTATION_Z), [0.0148, 0.0002, -0.0001]
        if self.lens is not None:
            between.rotation = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
            between.translation = [0.0] * 3
        self.depth.register_extrinsics_to(self.color, between)
        self.between = between
        self.kept: list[np.ndarray] = []

    def unit_now_m(self) -> float:
        return float(self.depth_sensor.get_option(rs.option.depth_units))

    def send(self, number: int, stamp_ms: float, *, color: Any = None, depth: Any = None) -> None:
        """Hand frames to the driver, depth first as real cameras do."""
        if depth is not None:
            self._send(self.depth_sensor, self.depth, depth.view(np.uint8), 2, number, stamp_ms)
        if color is not None:
            self._send(self.color_sensor, self.color, color, 3, number, stamp_ms)

    def _send(
        self, sensor: Any, profile: Any, pixels: Any, bpp: int, number: int, stamp_ms: float
    ) -> None:
        frame = rs.software_video_frame()
        frame.pixels = np.ascontiguousarray(pixels).reshape(-1)
        frame.bpp, frame.stride = bpp, bpp * self.size[0]
        frame.timestamp, frame.domain, frame.frame_number = stamp_ms, self.domain, number
        frame.profile = profile.as_video_stream_profile()
        if bpp == 2:
            frame.depth_units = self.unit_now_m()
        sensor.on_video_frame(frame)
