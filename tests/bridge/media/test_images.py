"""Colour and depth decoding: round trips, rules of the folders, broken bytes, old formats."""

import io
import struct

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from bridge.media.color import MAX_PIXELS, UnreadableImageError, decode_color, encode_jpeg
from bridge.media.depth import ROTATED_ENCODING, RVL_FORMAT, pack_rvl, to_millimetres, unpack

PNG_FORMAT = "16UC1; compressedDepth png"

sides = hnp.array_shapes(min_dims=2, max_dims=2, max_side=12)
depths = hnp.arrays(np.uint16, sides, elements=st.sampled_from([0, 0, 1, 7, 800, 805, 65535]))


def png(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, format="png")
    return buffer.getvalue()


def test_a_smooth_image_survives_jpeg() -> None:
    ramp = np.linspace(0, 255, 64 * 48).reshape(48, 64).astype(np.uint8)
    image = np.stack([ramp] * 3, axis=-1)
    again = decode_color(encode_jpeg(image))
    assert again.shape == image.shape
    assert np.abs(again.astype(int) - image).max() < 12  # quality 90 keeps a ramp within this


def test_png_colour_is_lossless() -> None:
    image = np.random.default_rng(0).integers(0, 256, (6, 7, 3), dtype=np.uint8)
    np.testing.assert_array_equal(decode_color(png(image)), image)


@pytest.mark.parametrize("cut", [3, 40, 200])
def test_a_truncated_jpeg_is_refused(cut: int) -> None:
    data = encode_jpeg(np.zeros((16, 16, 3), dtype=np.uint8))[:cut]
    with pytest.raises(UnreadableImageError, match="unreadable image"):
        decode_color(data)


@given(st.binary(max_size=64))
def test_arbitrary_bytes_are_no_image(data: bytes) -> None:
    with pytest.raises(UnreadableImageError):
        decode_color(data)


def rows_of(depth: np.ndarray, order: str = "<u2") -> np.ndarray:
    return depth.astype(order).view(np.uint8).reshape(depth.shape[0], -1)


def packed(depth: np.ndarray) -> bytes:
    return b"".join(pack_rvl(rows_of(depth)))


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


VALUES = np.arange(65536, dtype=np.uint16).reshape(256, 256)


def test_millimetres_are_kept_up_to_the_largest_that_fits() -> None:
    np.testing.assert_array_equal(to_millimetres(VALUES, unit_m=1e-3), VALUES)


@given(st.floats(1e-4, 1e-2))
def test_what_does_not_fit_sixteen_bits_is_no_measurement(unit_m: float) -> None:
    exact = [round(int(value) * unit_m * 1e3) for value in (1, 6553, 40000, 65535)]
    stored = np.array([[1, 6553, 40000, 65535]], dtype=np.uint16)
    found = to_millimetres(stored, unit_m=unit_m)
    assert np.abs(found - np.where(np.array(exact) > 65535, 0, exact)).max() <= 1


def test_rotated_bits_are_turned_back_by_three() -> None:
    """Python's whole numbers say what a rotation of sixteen bits is."""
    rotated = [((value >> 13) | (value << 3)) & 0xFFFF for value in range(65536)]
    stored = np.array(rotated, dtype=np.uint16).reshape(256, 256)
    found = to_millimetres(stored, unit_m=1e-3, encoding=ROTATED_ENCODING)
    np.testing.assert_array_equal(found, VALUES)


@given(st.sets(st.integers(0, 65535), max_size=5))
def test_invalid_codes_become_nothing_and_nothing_else_does(codes: set[int]) -> None:
    found = to_millimetres(VALUES, unit_m=1e-3, invalid_values=sorted(codes))
    assert set(VALUES[found == 0].tolist()) == codes | {0}
