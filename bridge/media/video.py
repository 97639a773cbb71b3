"""Video that cameras send, frame by frame."""

from typing import Any

import numpy as np
from jaxtyping import UInt8

from bridge.errors import BridgeError, MissingDependencyError

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

        Returns:
            Numbers and sRGB images of the frames that can be shown now.
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
