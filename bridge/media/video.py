"""Video: H.264 for previews, of no use for measuring; and what cameras send, frame by frame."""

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


DECODERS = {
    "h264": "h264",
    "h265": "hevc",
    "hevc": "hevc",
    "av1": "libdav1d",
    "vp9": "vp9",
}
"""FFmpeg's decoder of each format of foxglove.CompressedVideo, and of one common other name."""


class VideoDecodingError(BridgeError):
    """A frame of a video cannot be turned into an image."""

    def __init__(self, *, found: str) -> None:
        """Remember what was found."""
        super().__init__(f"video cannot be decoded: {found}.")


class VideoDecoder:
    """Turns the frames of one video into images; each may need those before it."""

    def __init__(self, video_format: str) -> None:
        """Open the decoder.

        Args:
            video_format: One of ``DECODERS``.

        Raises:
            MissingDependencyError: PyAV is not installed.
            VideoDecodingError: The format is not known, or FFmpeg was built without it.
        """
        try:
            import av  # noqa: PLC0415  # only the extra [video] brings it
        except ImportError as error:
            raise MissingDependencyError(
                package="av", extra="video", purpose="reading images of a video"
            ) from error
        name = DECODERS.get(video_format.lower())
        if name is None:
            known = ", ".join(DECODERS)
            raise VideoDecodingError(found=f"format {video_format!r}; known are {known}")
        self._av = av
        try:
            self._context: Any = av.CodecContext.create(name, "r")
        except (av.FFmpegError, ValueError) as error:
            found = f"FFmpeg was built without {name} ({error})"
            raise VideoDecodingError(found=found) from error
        self._context.thread_count = 1  # a second thread would hold frames back
        self._has_shown = False

    def decode(
        self, data: bytes, number: int
    ) -> list[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
        """Decode one frame; what comes before the first whole picture gives no image.

        Args:
            data: The frame as it was sent.
            number: Given back with its image; larger than the one before.

        Returns:
            Numbers and sRGB images of the frames that can be shown now.

        Raises:
            VideoDecodingError: The frame is damaged.
        """
        packet = self._av.Packet(data)
        packet.pts = number
        try:
            shown = [_shown(frame) for frame in self._context.decode(packet)]
        except self._av.error.InvalidDataError as error:
            if self._has_shown:
                raise VideoDecodingError(found=str(error)) from error
            return []  # joined in the middle: parameter sets come with the next whole picture
        except self._av.FFmpegError as error:
            raise VideoDecodingError(found=str(error)) from error
        self._has_shown = self._has_shown or bool(shown)
        return shown

    def flush(self) -> list[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
        """Return the images that waited for later ones; call once, at the end."""
        try:
            return [_shown(frame) for frame in self._context.decode(None)]
        except self._av.FFmpegError as error:
            raise VideoDecodingError(found=str(error)) from error


def _shown(frame: Any) -> tuple[int, UInt8[np.ndarray, "height width 3"]]:
    return int(frame.pts), frame.to_ndarray(format="rgb24")


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
