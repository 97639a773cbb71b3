import contextlib
import io
import struct
import threading
from concurrent.futures import ThreadPoolExecutor

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from bridge.media.color import MAX_PIXELS, UnreadableImageError
from bridge.media.depth import RVL_FORMAT, pack_rvl, unpack

PNG_FORMAT = "16UC1; compressedDepth png"

sides = hnp.array_shapes(min_dims=2, max_dims=2, max_side=12)
depths = hnp.arrays(np.uint16, sides, elements=st.sampled_from([0, 0, 1, 7, 800, 805, 65535]))


def rows_of(depth: np.ndarray, order: str = "<u2") -> np.ndarray:
    return depth.astype(order).view(np.uint8).reshape(depth.shape[0], -1)


def packed(depth: np.ndarray) -> bytes:
    return b"".join(pack_rvl(rows_of(depth)))


def png(depth: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(depth).save(buffer, format="png")
    return buffer.getvalue()


@given(depths)
def test_depth_survives_rvl_exactly(depth: np.ndarray) -> None:
    np.testing.assert_array_equal(unpack(RVL_FORMAT, packed(depth)), depth)


@given(depths)
def test_byte_order_does_not_change_what_is_packed(depth: np.ndarray) -> None:
    swapped = pack_rvl(rows_of(depth, ">u2"), swap_bytes=True)
    assert b"".join(swapped) == packed(depth)


@given(depths, st.integers(1, 9))
def test_rows_may_lie_apart_in_memory(depth: np.ndarray, padding: int) -> None:
    wide = np.pad(rows_of(depth), ((0, 0), (0, padding)), constant_values=0xAB)
    view = wide[:, : 2 * depth.shape[1]]
    assert b"".join(pack_rvl(view)) == packed(depth)


def test_packing_leaves_its_input_alone() -> None:
    rows = rows_of(np.arange(12, dtype=np.uint16).reshape(3, 4)).copy()
    rows.flags.writeable = False
    pack_rvl(rows)
    pack_rvl(rows, swap_bytes=True)


@pytest.mark.parametrize("form", [PNG_FORMAT, "16UC1; compressedDepth", "16UC1", "mono16"])
def test_png_depth_of_every_age_is_read(form: str) -> None:
    depth = np.array([[0, 1], [800, 65535]], dtype=np.uint16)
    np.testing.assert_array_equal(unpack(form, bytes(12) + png(depth)), depth)


def test_a_bare_png_file_is_depth_too() -> None:
    depth = np.array([[0, 1], [800, 65535]], dtype=np.uint16)
    np.testing.assert_array_equal(unpack("16UC1; png compressed ", png(depth)), depth)


@pytest.mark.parametrize(
    "form", ["32FC1; compressedDepth rvl", "16UC1; compressedDepth zstd", "jpeg", ""]
)
def test_other_formats_are_refused_by_name(form: str) -> None:
    with pytest.raises(UnreadableImageError, match="Expected 16-bit depth as PNG or RVL"):
        unpack(form, packed(np.ones((2, 2), dtype=np.uint16)))


@pytest.mark.parametrize(
    ("width", "height"), [(0, 5), (5, 0), (-1, 5), (100_000, 100_000), (MAX_PIXELS, 2), (-8, -8)]
)
def test_sizes_no_camera_has_are_refused(width: int, height: int) -> None:
    data = bytes(12) + struct.pack("<ii", width, height) + bytes(400)
    with pytest.raises(UnreadableImageError, match=f"{width} x {height} pixels"):
        unpack(RVL_FORMAT, data)


@given(depths, st.data())
def test_a_cut_stream_is_refused_or_was_not_needed(depth: np.ndarray, data: st.DataObject) -> None:
    whole = packed(depth)
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(UnreadableImageError, match="unreadable image"):
        unpack(RVL_FORMAT, whole[:cut])


def test_a_value_beyond_16_bits_is_refused() -> None:
    nibbles = "0" + "1" + "8888" + "84"  # no zero, one measurement of zigzag 4 << 15
    stream = struct.pack("<I", int(nibbles.ljust(8, "0"), 16))
    with pytest.raises(UnreadableImageError, match="outside 16 bits"):
        unpack(RVL_FORMAT, bytes(12) + struct.pack("<ii", 1, 1) + stream)


@given(st.sampled_from([RVL_FORMAT, PNG_FORMAT]), st.binary(max_size=200))
def test_arbitrary_bytes_are_an_image_or_one_error(form: str, data: bytes) -> None:
    with contextlib.suppress(UnreadableImageError):
        assert unpack(form, data).dtype == np.uint16


@given(st.binary(max_size=400), st.integers(1, 40), st.integers(1, 40))
def test_arbitrary_rvl_streams_give_the_stated_size_or_one_error(
    stream: bytes, width: int, height: int
) -> None:
    try:
        found = unpack(RVL_FORMAT, bytes(12) + struct.pack("<ii", width, height) + stream)
        assert found.shape == (height, width)
    except UnreadableImageError:
        pass


def test_many_threads_pack_at_once() -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 3000, (60, 80), dtype=np.uint16) for _ in range(16)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda depth: unpack(RVL_FORMAT, packed(depth)), frames * 4))
    for depth, again in zip(frames * 4, found, strict=True):
        np.testing.assert_array_equal(again, depth)


def test_packing_lets_other_threads_run() -> None:
    """A long call must not hold Python's lock: the other thread counts on meanwhile."""
    rows = rows_of(np.random.default_rng(0).integers(0, 65536, (2000, 2000), dtype=np.uint16))
    counted, stop = [0], threading.Event()

    def count() -> None:
        while not stop.is_set():
            counted[0] += 1

    thread = threading.Thread(target=count)
    thread.start()
    try:
        for _ in range(20):  # a busy machine may not have started it yet
            before = counted[0]
            pack_rvl(rows)
            if counted[0] > before:
                break
        assert counted[0] > before
    finally:
        stop.set()
        thread.join()
