"""What Rerun makes of our camera topics."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.images import depth_to_compact, image_header, image_to_jpeg
from bridge.episode.cdr.messages import CompressedColor, DepthImage
from bridge.episode.writer import EpisodeWriter
from bridge.media.depth import RVL_FORMAT, unpack

pytestmark = pytest.mark.parity
START_NS = 1_800_000_000_000_000_000
COUNT = 4


def depth(index: int) -> np.ndarray:
    frame = np.random.default_rng(index).integers(300, 3000, (24, 32), dtype=np.uint16)
    frame[:5, :7] = 0
    return frame


def color(index: int) -> bytes:
    pixels = np.random.default_rng(index).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    stamp = {"sec": START_NS // 10**9, "nanosec": index}
    fields = {"height": 24, "width": 32, "encoding": "bgr8", "step": 96}
    header = {"stamp": stamp, "frame_id": "camera"}
    return codec.encode(schema.IMAGE, {"header": header, **fields, "data": pixels.tobytes()})


def write(path: Path) -> None:
    with EpisodeWriter(path) as writer:
        for index in range(COUNT):
            stamp_ns = START_NS + index * 33_333_333
            raw = DepthImage(stamp_ns=stamp_ns, frame_id="camera", depth_mm=depth(index)).to_cdr()
            compact = depth_to_compact(image_header(raw))
            jpeg = image_to_jpeg(image_header(color(index)))
            for topic, data, name in (
                ("/c/cam/raw/depth/image", raw, schema.IMAGE),
                ("/c/cam/compact/depth/image", compact, schema.COMPRESSED_IMAGE),
                ("/c/cam/raw/color/image", jpeg, schema.COMPRESSED_IMAGE),
            ):
                assert data is not None
                writer.write(topic, data, type_name=name, log_time_ns=stamp_ns)


def converted(path: Path) -> dict[str, dict[str, list[object]]]:
    """Values of each component that Rerun finds in an episode, by entity."""
    import rerun.chunk as rc

    target = path.with_suffix(".rrd")
    command = [sys.executable, "-m", "rerun", "mcap", "convert", str(path), "-o", str(target)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    found: dict[str, dict[str, list[object]]] = {}
    for chunk in rc.RrdReader(target).store().stream().to_chunks():
        entity = found.setdefault(str(chunk.entity_path), {})
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if ":" in name and not name.startswith("Mcap"):
                entity.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


@pytest.mark.slow
def test_rerun_sees_depth_and_colour(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    path = tmp_path / "cameras.mcap"
    write(path)
    found = converted(path)

    for index, buffer in enumerate(found["/c/cam/raw/depth/image"]["DepthImage:buffer"]):
        np.testing.assert_array_equal(pixels_of(buffer).view("<u2").reshape(24, 32), depth(index))

    compact = found["/c/cam/compact/depth/image"]
    assert compact["EncodedDepthImage:media_type"] == [["application/rvl"]] * COUNT
    for index, blob in enumerate(compact["EncodedDepthImage:blob"]):
        again = unpack(RVL_FORMAT, pixels_of(blob).tobytes())
        np.testing.assert_array_equal(again, depth(index))

    jpeg = found["/c/cam/raw/color/image"]["EncodedImage:blob"]
    ours = image_to_jpeg(image_header(color(0)))
    assert ours is not None
    assert pixels_of(jpeg[0]).tobytes() == CompressedColor.from_cdr(ours).data


def pixels_of(value: object) -> np.ndarray:
    (content,) = value  # a list of one instance
    return (
        np.frombuffer(content, np.uint8)
        if isinstance(content, bytes)
        else np.array(content, dtype=np.uint8)
    )
