"""Image codecs against OpenCV and our NumPy twin, on easy (Kinect) and noisy (D435-like) depth.

MEDIA_FRAMES and MEDIA_REPEATS make it smaller. Times are CPU time of one frame of 640 x 480,
Python's share included. The twin, being slow, works on one frame only.
"""

import os
import statistics
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from measure import Target, cpu_seconds, report_targets
from record.frames import add_noise, native_frames, source_name

NUM_FRAMES = int(os.environ.get("MEDIA_FRAMES", "30"))
REPEATS = int(os.environ.get("MEDIA_REPEATS", "9"))
ENCODE_MS, DECODE_MS = 1.4, 1.2
"""What RVL may cost a frame on one core."""
JPEG_RATIO = 1.2
"""What the whole message may cost in terms of OpenCV's JPEG of the bare pixels."""


def main() -> None:
    """Measure depth of both kinds, then colour."""
    colors, depths = native_frames(NUM_FRAMES)
    rng = np.random.default_rng(0)
    for kind, frames in (("easy", depths), ("noisy", [add_noise(d, rng) for d in depths])):
        targets, details = depth_row(kind, frames)
        note = f"{source_name()}, {kind}, {NUM_FRAMES} frames, median of {REPEATS}"
        report_targets(f"media_depth_{kind}", targets, note=note, **details)
        print(f"  {details}")
    targets, details = color_row(colors)
    report_targets("media_color", targets, note=f"{source_name()}, {NUM_FRAMES} frames", **details)
    print(f"  {details}")


def frame_ms(work: Callable[[Any], object], frames: Iterable[Any]) -> float:
    items = list(frames)
    times = cpu_seconds(lambda: [work(item) for item in items], repeats=REPEATS)
    return statistics.median(times) * 1e3 / len(items)


def depth_row(kind: str, depths: list[np.ndarray]) -> tuple[list[Target], dict[str, Any]]:
    import cv2
    import zstandard

    from bridge.episode import schema
    from bridge.episode.cdr.images import depth_to_compact
    from bridge.episode.cdr.messages import DepthImage
    from bridge.media import depth as depth_module
    from bridge.media import rvl

    raw = [DepthImage(stamp_ns=0, frame_id="c", depth_mm=d).to_cdr() for d in depths]
    compact = [depth_to_compact(message) for message in raw]
    streams = [depth_module.encode_rvl(depth) for depth in depths]
    pngs = [png_of(cv2, depth) for depth in depths]
    zstd = zstandard.ZstdCompressor(level=1)
    for depth, stream, png in zip(depths, streams, pngs, strict=True):
        np.testing.assert_array_equal(depth_module.decode_rvl(stream, depth.size), depth.ravel())
        np.testing.assert_array_equal(cv2.imdecode(png, cv2.IMREAD_UNCHANGED), depth)

    size = depths[0].size
    png_ms = frame_ms(lambda depth: png_of(cv2, depth), depths)
    png_back_ms = frame_ms(lambda png: cv2.imdecode(png, cv2.IMREAD_UNCHANGED), pngs)
    encode_ms = frame_ms(depth_module.encode_rvl, depths)
    decode_ms = frame_ms(lambda stream: depth_module.decode_rvl(stream, size), streams)
    bytes_raw = sum(depth.nbytes for depth in depths)
    details = {
        "native": depth_module.NATIVE,
        "ms": {
            "Image to CompressedImage, whole message": frame_ms(depth_to_compact, raw),
            "CompressedImage to depth, whole message": frame_ms(
                lambda data: DepthImage.from_message(schema.COMPRESSED_IMAGE, data), compact
            ),
            "RVL then zstd 1": frame_ms(
                lambda depth: zstd.compress(depth_module.encode_rvl(depth)), depths
            ),
            "raw, zstd 1": frame_ms(lambda depth: zstd.compress(depth.tobytes()), depths),
            "NumPy twin, encode": frame_ms(rvl.encode_rvl, depths[:1]),
            "NumPy twin, decode": frame_ms(lambda s: rvl.decode_rvl(s, size), streams[:1]),
        },
        "times smaller than raw": {
            "RVL": bytes_raw / sum(map(len, streams)),
            "RVL then zstd 1": bytes_raw / sum(len(zstd.compress(s)) for s in streams),
            "raw, zstd 1": bytes_raw / sum(len(zstd.compress(d.tobytes())) for d in depths),
            "PNG level 1": bytes_raw / sum(map(len, pngs)),
        },
    }
    targets = [
        Target(
            what=f"RVL encode, {kind}",
            measured=encode_ms,
            limit=ENCODE_MS,
            unit="ms",
            reference=f"cv2 PNG level 1: {png_ms:.1f} ms, {png_ms / encode_ms:.1f} x",
        ),
        Target(
            what=f"RVL decode, {kind}",
            measured=decode_ms,
            limit=DECODE_MS,
            unit="ms",
            reference=f"cv2 PNG: {png_back_ms:.1f} ms, {png_back_ms / decode_ms:.1f} x",
        ),
    ]
    return targets, details


def png_of(cv2: Any, depth: np.ndarray) -> np.ndarray:
    return cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]


def color_row(colors: list[np.ndarray]) -> tuple[list[Target], dict[str, Any]]:
    import cv2

    from bridge.episode import schema
    from bridge.episode.cdr import codec
    from bridge.episode.cdr.images import image_to_jpeg

    messages = [
        codec.encode(
            schema.IMAGE,
            {
                "height": color.shape[0],
                "width": color.shape[1],
                "encoding": "bgr8",
                "step": 3 * color.shape[1],
                "data": color[..., ::-1].tobytes(),
            },
        )
        for color in colors
    ]
    quality = [cv2.IMWRITE_JPEG_QUALITY, 90]
    flipped = [np.ascontiguousarray(color[..., ::-1]) for color in colors]
    theirs_ms = frame_ms(lambda color: cv2.imencode(".jpg", color, quality), flipped)
    ours_ms = frame_ms(image_to_jpeg, messages)
    target = Target(
        what="raw Image to JPEG 90, whole message",
        measured=ours_ms / theirs_ms,
        limit=JPEG_RATIO,
        unit="x",
        reference=f"{ours_ms:.2f} ms; cv2 JPEG 90 of the pixels: {theirs_ms:.2f} ms",
    )
    return [target], {"ms": {"ours": ours_ms, "cv2": theirs_ms}}


if __name__ == "__main__":
    main()
