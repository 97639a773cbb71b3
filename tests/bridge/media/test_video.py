import re
import sys

import numpy as np
import pytest

from bridge.errors import MissingDependencyError
from bridge.media.video import H264Encoder, VideoEncodingError

av = pytest.importorskip("av")
SPS, PPS, WHOLE_PICTURE = 7, 8, 5
RATE_HZ = 30.0
STEP_NS = 33_333_333
START_NS = 1_800_000_000_000_000_000


def picture(index: int, height: int = 48, width: int = 64) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([3 * x + 2 * index, 4 * y + index, x + y], axis=-1).astype(np.uint8)


def nal_types(data: bytes) -> list[int]:
    return [data[match.end()] & 31 for match in re.finditer(b"\0\0\1", data)]


def frames(count: int, step_ns: int = STEP_NS) -> list[bytes]:
    encoder = H264Encoder(64, 48, RATE_HZ)
    return [encoder.encode(picture(i), START_NS + i * step_ns) for i in range(count)]


def test_every_image_comes_out_at_once_and_decodes_alone_in_order() -> None:
    decoder = av.CodecContext.create("h264", "r")
    for index, data in enumerate(frames(40)):
        assert data.startswith(b"\0\0\0\1")
        (shown,) = decoder.decode(av.Packet(data))  # exactly one, and no later one is needed
        assert shown.pict_type != av.video.frame.PictureType.B
        error = np.abs(shown.to_ndarray(format="rgb24").astype(int) - picture(index))
        assert error.mean() < 6  # a preview: one part in forty


@pytest.mark.parametrize("step_ns", [STEP_NS, 200_000_000, 1_500_000_000])
def test_a_viewer_waits_at_most_a_second_for_a_whole_picture(step_ns: int) -> None:
    last_whole = None
    for index, data in enumerate(frames(70 if step_ns == STEP_NS else 15, step_ns)):
        types = nal_types(data)
        if WHOLE_PICTURE in types:
            assert {SPS, PPS} <= set(types)
            last_whole = index
        assert last_whole is not None
        assert (index - last_whole) * step_ns < 1_000_000_000


def test_a_decoder_can_start_at_any_whole_picture() -> None:
    data = frames(40)
    start = next(i for i in range(1, 40) if WHOLE_PICTURE in nal_types(data[i]))
    decoder = av.CodecContext.create("h264", "r")
    (shown,) = decoder.decode(av.Packet(data[start]))
    assert np.abs(shown.to_ndarray(format="rgb24").astype(int) - picture(start)).mean() < 6


def test_times_that_stand_still_or_run_backwards_are_encoded() -> None:
    encoder = H264Encoder(64, 48, RATE_HZ)
    stamps = [START_NS, START_NS, START_NS - 5_000_000_000, -7, START_NS]
    assert all(encoder.encode(picture(i), stamp) for i, stamp in enumerate(stamps))


def test_an_odd_last_row_and_column_are_left_out() -> None:
    encoder = H264Encoder(65, 49, RATE_HZ)
    data = encoder.encode(picture(0, 49, 65), START_NS)
    (shown,) = av.CodecContext.create("h264", "r").decode(av.Packet(data))
    assert (shown.width, shown.height) == (64, 48)


def test_a_view_of_every_other_column_is_encoded() -> None:
    assert H264Encoder(64, 48, RATE_HZ).encode(picture(0, 48, 128)[:, ::2], START_NS)


def test_an_image_of_another_size_is_refused() -> None:
    encoder = H264Encoder(64, 48, RATE_HZ)
    with pytest.raises(VideoEncodingError, match="32 x 48 pixels"):
        encoder.encode(picture(0, 48, 32), START_NS)


@pytest.mark.parametrize(("width", "height"), [(0, 48), (64, 1), (100_000, 100_000), (-64, 48)])
def test_sizes_that_cannot_be_coded_are_refused(width: int, height: int) -> None:
    with pytest.raises(VideoEncodingError, match=f"{width} x {height} pixels"):
        H264Encoder(width, height, RATE_HZ)


def test_without_pyav_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependencyError, match=r"robot-gst\[video\]"):
        H264Encoder(64, 48, RATE_HZ)
