"""H.264 for previews: small, quick to make, and of no use for measuring."""

from fractions import Fraction
from typing import Any

import numpy as np
from jaxtyping import UInt8

from bridge.errors import BridgeError, MissingDependencyError

VIDEO_FORMAT = "h264"
KEYFRAME_INTERVAL_NS = 1_000_000_000
"""A viewer that joins, or jumps, waits at most this long for a whole picture."""
_MIN_PIXELS, _MAX_PIXELS = 16, 8192
_US = 1_000_000


class VideoEncodingError(BridgeError):
    """An image cannot become a frame of the video."""

    def __init__(self, *, found: str) -> None:
        """Remember what was found."""
        super().__init__(f"no video frame: {found}. The preview needs images of one size.")


class H264Encoder:
    """Turns images of one camera into frames that each decode as soon as they arrive.

    Annex B, no frame that needs a later one, and a whole picture with its parameter sets (SPS and
    PPS) at least every second of source time, whatever the true rate.
    """

    def __init__(self, width: int, height: int, rate_hz: float) -> None:
        """Open the encoder; an odd last row or column is left out.

        Args:
            width: Of every image [pixels].
            height: Of every image [pixels].
            rate_hz: About how many images come each second.

        Raises:
            MissingDependencyError: PyAV is not installed.
            VideoEncodingError: The size is none that H.264 can code, or x264 is missing.
        """
        try:
            import av  # noqa: PLC0415  # only the extra [video] brings it
        except ImportError as error:
            raise MissingDependencyError(
                package="av", extra="video", purpose="a preview video"
            ) from error
        if not all(_MIN_PIXELS <= size <= _MAX_PIXELS for size in (width, height)):
            raise VideoEncodingError(found=f"{width} x {height} pixels")
        self._av = av
        self._shape = (height, width, 3)
        self._half_frame_ns = round(0.5e9 / max(rate_hz, 1.0))
        self._last_us: int | None = None
        self._keyframe_ns: int | None = None
        try:
            self._context = self._open(rate_hz)
        except (av.FFmpegError, ValueError) as error:
            raise VideoEncodingError(found=str(error)) from error

    def _open(self, rate_hz: float) -> Any:
        height, width, _ = self._shape
        context: Any = self._av.CodecContext.create("libx264", "w")
        context.width, context.height = width // 2 * 2, height // 2 * 2
        context.pix_fmt = "yuv420p"
        context.framerate = max(1, round(rate_hz))
        context.time_base = Fraction(1, _US)
        context.thread_count = 1  # a second thread would hold a frame back
        context.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "crf": "26",
            "bf": "0",
            "forced-idr": "1",
            # Key frames come when `encode` asks for them, by time.
            "x264-params": "keyint=infinite:scenecut=0:repeat-headers=1:annexb=1:log=-1",
        }
        context.open()
        return context

    def encode(self, image_u8: UInt8[np.ndarray, "height width 3"], stamp_ns: int) -> bytes:
        """Encode one sRGB image.

        Args:
            image_u8: The image, of the size stated at the start.
            stamp_ns: When it was taken.

        Returns:
            All NAL units of the frame, each after a start code.

        Raises:
            VideoEncodingError: The image has another size, or the encoder refuses it.
        """
        if image_u8.shape != self._shape:
            height, width = image_u8.shape[:2]
            raise VideoEncodingError(found=f"{width} x {height} pixels")
        height, width = self._context.height, self._context.width
        image_u8 = np.ascontiguousarray(image_u8[:height, :width])
        frame = self._av.VideoFrame.from_ndarray(image_u8, format="rgb24")
        # The encoder wants times that grow; two images of one instant, or a clock set back, are
        # put one microsecond apart.
        frame.pts = max(
            stamp_ns // 1000, -(1 << 62) if self._last_us is None else self._last_us + 1
        )
        frame.time_base = self._context.time_base
        if self._keyframe_is_due(stamp_ns):
            frame.pict_type = self._av.video.frame.PictureType.I
            self._keyframe_ns = stamp_ns
        self._last_us = frame.pts
        try:
            packets = self._context.encode(frame)
        except self._av.FFmpegError as error:
            raise VideoEncodingError(found=str(error)) from error
        return b"".join(bytes(packet) for packet in packets)

    def _keyframe_is_due(self, stamp_ns: int) -> bool:
        if self._keyframe_ns is None:
            return True
        nearly_ns = KEYFRAME_INTERVAL_NS - self._half_frame_ns
        return not 0 <= stamp_ns - self._keyframe_ns < nearly_ns
