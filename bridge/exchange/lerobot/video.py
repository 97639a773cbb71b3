"""Frames of a video file at given times."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bridge.exchange.lerobot.layout import LeRobotFormatError
from bridge.media.video_writer import RGB, pyav


def read_frames(path: Path, times_s: Sequence[float], tolerance_s: float) -> Iterator[np.ndarray]:
    """Yield the frame nearest to each time; times ascend [s]."""
    if not len(times_s):
        return
    av = pyav()
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise LeRobotFormatError(path=path, found="no video in it")
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
                yield frame.to_ndarray(format=RGB)
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
