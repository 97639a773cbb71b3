"""Video files of H.264: frames in. PyAV (the extra [video]) does it."""

from pathlib import Path
from typing import Any

import numpy as np

from bridge.errors import MissingDependencyError

CODEC = "libx264"
RGB = "rgb24"
KEYFRAME_EVERY = 2
"""Training reads single frames at random, so every second one can be decoded alone."""


def pyav() -> Any:
    """Return PyAV."""
    try:
        import av  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(package="av", extra="video", purpose="video") from error
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
        keyframe_every: int = KEYFRAME_EVERY,
    ) -> None:
        """Create the file; sizes that are odd get full chroma, for the usual one needs even.

        Raises:
            MissingDependencyError: Without PyAV, or with one that has no encoder for this.
        """
        av = pyav()
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.num_frames, self._is_refused = 0, False
        self._frame_class = av.VideoFrame
        self._intra = av.video.frame.PictureType.I
        self._container = av.open(str(path), "w")
        options = {"g": str(keyframe_every), "bf": "0", "preset": "veryfast", "forced-idr": "1"}
        options["crf"] = str(crf)
        if CODEC not in av.codecs_available:
            raise MissingDependencyError(package=f"av with {CODEC}", extra="video", purpose="video")
        self._stream = self._container.add_stream(CODEC, rate=fps, options=options)
        self._stream.width, self._stream.height = width, height
        is_even = width % 2 == 0 and height % 2 == 0
        self.pix_fmt = "yuv420p" if is_even else "yuv444p"
        self._stream.pix_fmt = self.pix_fmt

    def write(self, pixels: np.ndarray, *, first: bool) -> None:
        """Append one frame; the first of an episode can be decoded without those before it."""
        frame = self._frame_class.from_ndarray(pixels, format=RGB)
        if first:
            frame.pict_type = self._intra
        frame.pts = self.num_frames
        self._mux(frame)
        self.num_frames += 1

    @property
    def size_bytes(self) -> int:
        """How large the file is; 0 while the encoder holds everything."""
        return self.path.stat().st_size if self.path.is_file() else 0

    def close(self) -> None:
        """Write what the encoder still holds, and the index, unless the disk refused before."""
        if not self._is_refused:
            self._mux(None)

    def _mux(self, frame: Any) -> None:
        try:
            for packet in self._stream.encode(frame):
                self._container.mux(packet)
            if frame is None:
                self._container.close()
        except OSError:
            self._is_refused = True  # to write on, or to close it, may crash libav
            self.path.unlink(missing_ok=True)
            raise
