import io
import struct

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


@pytest.mark.parametrize("form", [PNG_FORMAT, "16UC1; compressedDepth", "16UC1", "mono16"])
def test_png_depth_of_every_age_is_read(form: str) -> None:
    depth = np.array([[0, 1], [800, 65535]], dtype=np.uint16)
    np.testing.assert_array_equal(unpack(form, bytes(12) + png(depth)), depth)


def test_a_bare_png_file_is_depth_too() -> None:
    depth = np.array([[0, 1], [800, 65535]], dtype=np.uint16)
    np.testing.assert_array_equal(unpack("16UC1; png compressed ", png(depth)), depth)


@pytest.mark.parametrize(
    "form", ["64FC1; compressedDepth rvl", "16UC1; compressedDepth zstd", "jpeg", ""]
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


@given(st.binary(max_size=400), st.integers(1, 40), st.integers(1, 40))
def test_arbitrary_rvl_streams_give_the_stated_size_or_one_error(
    stream: bytes, width: int, height: int
) -> None:
    try:
        found = unpack(RVL_FORMAT, bytes(12) + struct.pack("<ii", width, height) + stream)
        assert found.shape == (height, width)
    except UnreadableImageError:
        pass
