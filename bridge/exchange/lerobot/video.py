"""Video files: frames in, and frames out at given times. PyAV (the extra [video]) does it.

Colour is H.264, depth HEVC of 12 bits without loss.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bridge.errors import MissingDependencyError
from bridge.exchange.lerobot.depth import PIX_FMT
from bridge.exchange.lerobot.layout import LeRobotFormatError

CODEC, DEPTH_CODEC = "libx264", "libx265"
RGB = "rgb24"
KEYFRAME_EVERY = 2
"""Training reads single frames at random, so every second one can be decoded alone."""


def _av() -> Any:
    try:
        import av  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(
            package="av", extra="video", purpose="video in LeRobot datasets"
        ) from error
    return av


class VideoWriter:
    """Append frames to one MP4 file at a constant rate."""

    def __init__(
        self,
        path: Path,
        *,
        fps: int,
        width: int,
        height: int,
        crf: int,
        is_depth: bool = False,
        keyframe_every: int = KEYFRAME_EVERY,
    ) -> None:
        """Create the file; sizes that are odd get full chroma, for the usual one needs even.

        Args:
            is_depth: Frames are 12-bit codes, kept without loss.
        """
        av = _av()
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.num_frames = 0
        self._frame_class = av.VideoFrame
        self._intra = av.video.frame.PictureType.I
        self._container = av.open(str(path), "w")
        options = {"g": str(keyframe_every), "bf": "0", "preset": "veryfast", "forced-idr": "1"}
        if is_depth:
            options["x265-params"] = "lossless=1:bframes=0:log-level=none"
        else:
            options["crf"] = str(crf)
        codec = DEPTH_CODEC if is_depth else CODEC
        if codec not in av.codecs_available:
            raise MissingDependencyError(
                package=f"av with {codec}", extra="video", purpose="video in LeRobot datasets"
            )
        self._stream = self._container.add_stream(codec, rate=fps, options=options)
        self._stream.width, self._stream.height = width, height
        is_even = width % 2 == 0 and height % 2 == 0
        self.pix_fmt = PIX_FMT if is_depth else "yuv420p" if is_even else "yuv444p"
        self._stream.pix_fmt = self.pix_fmt
        self._format = PIX_FMT if is_depth else RGB

    def write(self, pixels: np.ndarray, *, first: bool) -> None:
        """Append one frame; the first of an episode can be decoded without those before it.

        Args:
            pixels: RGB, height x width x 3 of uint8; of depth codes, height x width of uint16.
        """
        frame = self._frame_class.from_ndarray(pixels, format=self._format)
        if first:
            frame.pict_type = self._intra
        frame.pts = self.num_frames
        for packet in self._stream.encode(frame):
            self._container.mux(packet)
        self.num_frames += 1

    @property
    def size_bytes(self) -> int:
        """How large the file is; 0 while the encoder holds everything."""
        return self.path.stat().st_size if self.path.is_file() else 0

    def close(self) -> None:
        """Write what the encoder still holds, and the index."""
        for packet in self._stream.encode(None):
            self._container.mux(packet)
        self._container.close()


def read_frames(
    path: Path, times_s: Sequence[float], tolerance_s: float, pixels: str = RGB
) -> Iterator[np.ndarray]:
    """Yield the frame nearest to each time; times ascend [s]."""
    if not len(times_s):
        return
    av = _av()
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise LeRobotFormatError(
                    path=path, found="no video in it", hint="Restore it from the dataset."
                )
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            if times_s[0] > 0:
                container.seek(
                    int((times_s[0] - tolerance_s) / stream.time_base),
                    stream=stream,
                    backward=True,
                )
            decoded = container.decode(stream)
            for frame in _nearest(path, decoded, times_s, tolerance_s):
                yield frame.to_ndarray(format=pixels)
    except (av.FFmpegError, OSError) as error:
        raise LeRobotFormatError(
            path=path,
            found=f"cannot be decoded ({str(error)[:120]})",
            hint="Restore it from the original dataset; robot-gst decodes H.264, HEVC and AV1.",
        ) from error


def _nearest(
    path: Path, frames: Iterator[Any], times_s: Sequence[float], tolerance_s: float
) -> Iterator[Any]:
    before: Any = None
    after: Any = next(frames, None)
    for number, wanted_s in enumerate(times_s):
        while after is not None and after.time < wanted_s:
            before, after = after, next(frames, None)
        close = [frame for frame in (before, after) if frame is not None]
        best = min(close, key=lambda frame: abs(frame.time - wanted_s), default=None)
        if best is None or abs(best.time - wanted_s) > tolerance_s:
            there = "nothing is left" if best is None else f"the nearest is at {best.time:.4f} s"
            raise LeRobotFormatError(
                path=path,
                found=f"no frame {number} of the episode at {wanted_s:.4f} s, {there}",
                hint="The video does not fit meta/episodes; restore both from the dataset.",
            )
        yield best
