"""One RealSense camera through its sensors: calibration once, then every frame in order.

No syncer stands between: it would pair frames and drop the odd ones.
Colour and depth of one camera can come from two sensors (D435) or from one (D405).
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pyrealsense2 as rs
from jaxtyping import Float, UInt16

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.depth import to_millimetres
from bridge.media.resample import Resampling
from bridge.sources.device_samples import HostClock
from bridge.sources.realsense.config import CameraStreamError, RealSenseConfig
from bridge.sources.realsense.messages import Calibration, ColorFrame, DepthFrame, Frame

# D415 and D435 send undistorted colour (all coefficients 0), D405 and D455 do not, and bend it by a
# model that CameraInfo has no name for.


def is_distorted(intrinsics: Any) -> bool:
    """Say whether images of a stream differ from those of an ideal pinhole camera."""
    return intrinsics.model != rs.distortion.none and any(intrinsics.coeffs)


def rectifier(intrinsics: Any) -> Resampling:
    """Ask the library once where each ideal pixel lies in the distorted image."""
    x = (np.arange(intrinsics.width) - intrinsics.ppx) / intrinsics.fx
    y = (np.arange(intrinsics.height) - intrinsics.ppy) / intrinsics.fy
    project = rs.rs2_project_point_to_pixel
    rows = [[project(intrinsics, [float(a), float(b), 1.0]) for a in x] for b in y]
    return Resampling(*np.moveaxis(np.asarray(rows, dtype=np.float64), -1, 0))


US_PER_MS, NS_PER_US = 1000, 1000
COUNTER_WRAPS_NS = 2**32 * 1_000
"""The camera counts microseconds in 32 bits: 71.6 minutes."""


class FrameStamps:
    """Stamps of one open camera.

    With global time (librealsense relates the camera's clock to the host's) and system time the
    library's stamp is the host's time already; otherwise the camera's own counter is mapped by
    the shortest way its frames took. Colour and depth share one offset, as they share the clock:
    what lies between them is the camera's to say, not the USB bus's.
    """

    def __init__(self) -> None:
        """Start without knowing the offset."""
        self._clock = HostClock(wraps_ns=COUNTER_WRAPS_NS)

    def stamp_ns(self, frame: Any, received_ns: int) -> int | None:
        """Return when a frame was taken [ns], or None while that cannot be said yet.

        Args:
            received_ns: When it arrived, by the host's clock.
        """
        # A double holds today's time in microseconds exactly, in nanoseconds not.
        device_ns: int = round(frame.get_timestamp() * US_PER_MS) * NS_PER_US
        if frame.get_frame_timestamp_domain() != rs.timestamp_domain.hardware_clock:
            return device_ns
        try:
            return self._clock.map(device_ns, received_ns)
        except ValueError:  # the camera was reset without our noticing: find the offset again
            self._clock = HostClock(wraps_ns=COUNTER_WRAPS_NS)
            return None


QUEUE_FRAMES = 30
"""Frames that wait for us inside the library; the driver owns about as many buffers."""
UNIT_M = 0.001
"""Episodes hold whole millimetres."""


class _Chosen(NamedTuple):
    sensor: Any
    profile: Any


def serial_of(device: Any) -> str:
    """Serial number of a device, as printed on it; one in recovery mode does not tell."""
    known = device.supports(rs.camera_info.serial_number)
    return str(device.get_info(rs.camera_info.serial_number)) if known else "(recovery mode)"


def describe_device(device: Any) -> str:
    """Model and serial number."""
    known = device.supports(rs.camera_info.name)
    name = device.get_info(rs.camera_info.name) if known else "RealSense"
    return f"{name.removeprefix('Intel RealSense ')} {serial_of(device)}"


class CameraDevice:
    """An open camera; close it, or the next one to open it finds it busy."""

    def __init__(
        self, device: Any, config: RealSenseConfig, *, camera: str, now_ns: Callable[[], int]
    ) -> None:
        """Open both sensors and start them."""
        self._camera = f"{camera} ({describe_device(device)})"
        self._now_ns = now_ns
        self._stamps = FrameStamps()
        sensors = list(device.query_sensors())
        color = self._choose(sensors, config, rs.stream.color, rs.format.rgb8)
        depth = self._choose(sensors, config, rs.stream.depth, rs.format.z16)
        intrinsics = color.profile.as_video_stream_profile().get_intrinsics()
        self._rectifier = rectifier(intrinsics) if is_distorted(intrinsics) else None
        self._set_unit(depth.sensor)
        self.calibration = self._calibration(color.profile, depth.profile)
        self._queue = rs.frame_queue(QUEUE_FRAMES, True)
        self._started: list[Any] = []
        self._start(color, depth)

    @property
    def rectified(self) -> bool:
        """Whether lens distortion is taken out of colour images here."""
        return self._rectifier is not None

    def _choose(
        self, sensors: list[Any], config: RealSenseConfig, stream: Any, pixels: Any
    ) -> _Chosen:
        offers = []
        for sensor in sensors:
            for profile in sensor.get_stream_profiles():
                if profile.stream_type() != stream or profile.format() != pixels:
                    continue
                video = profile.as_video_stream_profile()
                if (video.width(), video.height(), video.fps()) == (*config.pixels(), config.fps):
                    return _Chosen(sensor, profile)
                offers.append(f"{video.width()}x{video.height()} at {video.fps()} Hz")
        raise CameraStreamError(
            camera=self._camera,
            found=f"no {stream.name} images of {config.size} at {config.fps} Hz",
            hint=f"It offers {', '.join(sorted(set(offers))) or 'none'}; "
            "on USB 2 the list is shorter: use a USB 3 port and cable, or --size and --fps.",
        )

    def _set_unit(self, sensor: Any) -> None:
        """Let the camera itself send millimetres; where it refuses, frames are converted."""
        option = rs.option.depth_units
        if not sensor.supports(option) or sensor.is_option_read_only(option):
            return
        try:
            sensor.set_option(option, UNIT_M)
        except RuntimeError:  # outside what this model allows
            return

    def _calibration(self, color: Any, depth: Any) -> Calibration:
        intrinsics = depth.as_video_stream_profile().get_intrinsics()
        if is_distorted(intrinsics):
            raise CameraStreamError(
                camera=self._camera,
                found="its depth images have lens distortion, which episodes do not hold",
                hint="Reset the calibration with the vendor's viewer.",
            )
        return Calibration(
            color_camera=_camera_of(color),
            depth_camera=_camera_of(depth),
            T_color_depth=_transform_of(depth.get_extrinsics_to(color)),
        )

    def _start(self, color: _Chosen, depth: _Chosen) -> None:
        together = color.sensor is depth.sensor
        groups = (
            [(color.sensor, [color.profile, depth.profile])]
            if together
            else [(item.sensor, [item.profile]) for item in (depth, color)]
        )
        try:
            for sensor, profiles in groups:
                sensor.open(profiles)
                self._started.append(sensor)
                sensor.start(self._queue)
        except RuntimeError as error:
            self.close()
            raise CameraStreamError(
                camera=self._camera,
                found=f"it cannot be opened: {error}",
                hint="Close other programs that use it (realsense-viewer, a ROS node).",
            ) from error

    def read(self, timeout_s: float) -> list[Frame] | None:
        """Return the next frame, or None when nothing came in time.

        An empty list means that one came while the offset between the clocks is being found.
        """
        came, item = self._queue.try_wait_for_frame(round(timeout_s * 1e3))
        if not came:
            return None
        frame = self._frame_of(item, self._now_ns())
        return [] if frame is None else [frame]

    def _frame_of(self, frame: Any, received_ns: int) -> Frame | None:
        depth = frame.is_depth_frame()
        number = frame.get_frame_number()
        stamp_ns = self._stamps.stamp_ns(frame, received_ns)
        if stamp_ns is None:
            return None
        pixels = np.array(frame.get_data())  # a copy: the library gets its buffer back
        if not depth:
            image_u8 = pixels if self._rectifier is None else self._rectifier.apply(pixels)
            return ColorFrame(number=number, stamp_ns=stamp_ns, image_u8=image_u8)
        unit_m = round(frame.as_depth_frame().get_units(), 7)  # a float32, 1e-4 is 9.9999997e-5
        if unit_m != UNIT_M:
            pixels = np.take(_millimetres(unit_m), pixels)
        return DepthFrame(number=number, stamp_ns=stamp_ns, depth_mm=pixels)

    def close(self) -> None:
        """Stop the sensors; a camera that is gone cannot be stopped, which is as good."""
        for sensor in self._started:
            for end in (sensor.stop, sensor.close):
                try:
                    end()
                except RuntimeError:
                    continue
        self._started.clear()


@cache
def _millimetres(unit_m: float) -> UInt16[np.ndarray, "65536"]:
    """What each stored number is in whole millimetres; looking up is faster than computing."""
    every = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    return to_millimetres(every, unit_m=unit_m).reshape(-1)


def _camera_of(profile: Any) -> Camera:
    found = profile.as_video_stream_profile().get_intrinsics()
    return Camera.from_ros(
        width=found.width,
        height=found.height,
        fx=found.fx,
        fy=found.fy,
        cx=found.ppx,
        cy=found.ppy,
    )


def _transform_of(extrinsics: Any) -> Float[np.ndarray, "4 4"]:
    """The library keeps rotations column by column."""
    R = np.array(extrinsics.rotation).reshape(3, 3).T
    return se3.from_rotation(R, extrinsics.translation)
