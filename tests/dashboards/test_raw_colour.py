from pathlib import Path

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.writer import EpisodeWriter
from bridge.media.color import decode_color
from dashboards.frames import read_frame

STAMP_NS = 100_000_000


def test_raw_colour_is_shown_as_jpeg(tmp_path: Path) -> None:
    pixels = np.full((24, 32, 3), [10, 100, 200], dtype=np.uint8)
    header = {"stamp": {"sec": 0, "nanosec": STAMP_NS}, "frame_id": "eye"}
    fields = {"height": 24, "width": 32, "encoding": "bgr8", "step": 96, "data": pixels.tobytes()}
    message = codec.encode(schema.IMAGE, {"header": header, **fields})
    path = tmp_path / "a.mcap"
    with EpisodeWriter(path) as writer:
        topic = "/cell/cam/eye/color/image"
        writer.write(topic, message, type_name=schema.IMAGE, log_time_ns=STAMP_NS)
    data, kind = read_frame(path, "eye", STAMP_NS)
    assert kind == "image/jpeg"
    # One colour all over: only the rounding of JPEG remains.
    assert np.abs(decode_color(data).astype(int) - [200, 100, 10]).max() <= 3
