import contextlib
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from written_messages import STAMP_NS
from written_messages import raw_image as image

from bridge.episode import schema
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.images import COLOR_LAYOUTS, depth_to_compact, image_header, image_to_jpeg
from bridge.episode.cdr.messages import CompressedColor, DepthImage, RawColor, color_from_message
from bridge.errors import BridgeError
from bridge.media.color import UnreadableImageError

ORDERS = {"RGB": [0, 1, 2], "BGR": [2, 1, 0], "RGBA": [0, 1, 2, 3], "BGRA": [2, 1, 0, 3]}


def padded(pixels: np.ndarray, encoding: str, padding: int, **fields: object) -> bytes:
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    wide = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAB)
    return image(pixels, encoding, step=wide.shape[1], data=wide.tobytes(), **fields)


def smooth_rgb(height: int = 32, width: int = 48) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([4 * x, 6 * y, 255 - 4 * x], axis=-1).astype(np.uint8)


def in_layout(rgb: np.ndarray, encoding: str) -> np.ndarray:
    layout, channels = COLOR_LAYOUTS[encoding]
    if channels == 1:
        return rgb[..., :1]
    alpha = np.full((*rgb.shape[:2], 1), 200, dtype=np.uint8)
    return np.concatenate([rgb, alpha], axis=-1)[..., ORDERS[layout]]


def test_a_header_says_where_the_pixels_are() -> None:
    depth = np.arange(12, dtype=np.uint16).reshape(3, 4)
    header = image_header(image(depth, "16UC1"))
    assert (header.stamp_ns, header.frame_id) == (STAMP_NS, "camera")
    assert (header.height, header.width, header.encoding, header.step) == (3, 4, "16UC1", 8)
    assert header.data == depth.tobytes()


def test_a_big_endian_message_is_read() -> None:
    front = b"\x00\x00\x00\x00" + struct.pack(">iI", 7, 8) + struct.pack(">I", 2) + b"c\0\0\0"
    front += struct.pack(">III", 1, 2, 6) + b"16UC1\0" + b"\1\0" + struct.pack(">II", 4, 4)
    data = front + np.array([[3, 700]], dtype=">u2").tobytes()
    assert image_header(data).stamp_ns == 7_000_000_008
    np.testing.assert_array_equal(DepthImage.from_cdr(data).depth_mm, [[3, 700]])
    compact = depth_to_compact(image_header(data))
    assert compact is not None
    again = DepthImage.from_message(schema.COMPRESSED_IMAGE, compact)
    assert (again.stamp_ns, again.frame_id) == (7_000_000_008, "c")
    np.testing.assert_array_equal(again.depth_mm, [[3, 700]])


@pytest.mark.parametrize("encoding", sorted(COLOR_LAYOUTS))
@pytest.mark.parametrize("padding", [0, 1, 64])
def test_every_colour_encoding_becomes_the_same_jpeg_colours(encoding: str, padding: int) -> None:
    rgb = smooth_rgb()
    jpeg = image_to_jpeg(image_header(padded(in_layout(rgb, encoding), encoding, padding)), 95)
    assert jpeg is not None
    color = CompressedColor.from_cdr(jpeg)
    assert (color.stamp_ns, color.frame_id, color.format) == (STAMP_NS, "camera", "jpeg")
    expected = np.repeat(rgb[..., :1], 3, axis=-1) if encoding == "mono8" else rgb
    # Chroma is halved; on ramps quality 95 stays within this.
    assert np.abs(color.image_u8().astype(int) - expected).max() < 12


@pytest.mark.parametrize("encoding", sorted(COLOR_LAYOUTS))
def test_raw_colour_is_read_exactly(encoding: str) -> None:
    rgb = smooth_rgb()
    found = color_from_message(schema.IMAGE, padded(in_layout(rgb, encoding), encoding, 5))
    assert isinstance(found, RawColor)
    expected = np.repeat(rgb[..., :1], 3, axis=-1) if encoding == "mono8" else rgb
    np.testing.assert_array_equal(found.image_u8(), expected)


@given(
    st.integers(1, 9), st.integers(1, 9), st.integers(0, 5), st.booleans(), st.integers(0, 2**32)
)
def test_depth_is_the_same_in_every_form(
    height: int, width: int, padding: int, is_big: bool, seed: int
) -> None:
    depth = np.random.default_rng(seed).integers(0, 65536, (height, width), dtype=np.uint16)
    stored = depth.astype(">u2" if is_big else "<u2")
    raw = padded(stored, "16UC1", padding, is_bigendian=int(is_big))
    compact = depth_to_compact(image_header(raw))
    assert compact is not None
    for form in (
        DepthImage.from_cdr(raw),
        DepthImage.from_message(schema.IMAGE, raw),
        DepthImage.from_message(schema.COMPRESSED_IMAGE, compact),
    ):
        np.testing.assert_array_equal(form.depth_mm, depth)
        assert form.depth_mm.dtype == np.uint16
        assert (form.stamp_ns, form.frame_id) == (STAMP_NS, "camera")


def test_encodings_of_others_are_left_to_others() -> None:
    depth = image_header(image(np.zeros((2, 2), dtype=np.uint16), "16UC1"))
    color = image_header(image(np.zeros((2, 2, 3), dtype=np.uint8), "rgb8"))
    metres = image_header(image(np.zeros((2, 2), dtype=np.float32), "32FC1"))
    assert [image_to_jpeg(depth), *map(depth_to_compact, (color, metres))] == [None] * 3
    with pytest.raises(
        MalformedMessageError, match=r"'32SC1' cannot be read.*16UC1, mono16, 32FC1"
    ):
        DepthImage.from_cdr(image(np.zeros((2, 2), dtype=np.int32), "32SC1"))
    with pytest.raises(MalformedMessageError, match=r"'nv24' cannot be read.*rgb8"):
        RawColor.from_cdr(image(np.zeros((2, 2, 2), dtype=np.uint8), "nv24"))


BROKEN = {
    "too few bytes": ({"data": bytes(7)}, "7 bytes for 2 rows of 4"),
    "too many bytes": ({"data": bytes(9)}, "9 bytes for 2 rows of 4"),
    "an odd step": ({"step": 3, "data": bytes(6)}, "a step of 3 bytes for rows of 2"),
    "no step": ({"step": 0}, "a step of 0 bytes"),
    "no rows": ({"height": 0, "data": b""}, "an image of 2 x 0 pixels"),
    "no columns": ({"width": 0, "step": 0, "data": b""}, "an image of 0 x 2 pixels"),
    "a claim": (
        {"width": 100_000, "height": 100_000, "step": 200_000},
        "an image of 100000 x 100000 pixels",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_message_that_contradicts_itself_is_one_error(name: str) -> None:
    fields, found = BROKEN[name]
    data = image(np.zeros((2, 2), dtype=np.uint16), "16UC1", **fields)
    for read in (lambda data: depth_to_compact(image_header(data)), DepthImage.from_cdr):
        with pytest.raises(MalformedMessageError, match=found):
            read(data)


@pytest.mark.parametrize("encoding", sorted(COLOR_LAYOUTS))
def test_colour_of_the_wrong_size_is_one_error(encoding: str) -> None:
    pixels = in_layout(smooth_rgb(4, 4), encoding)
    with pytest.raises(MalformedMessageError, match="bytes for 4 rows"):
        image_to_jpeg(image_header(image(pixels, encoding, data=pixels.tobytes()[:-1])))
    with pytest.raises(MalformedMessageError, match="an image of"):
        image_to_jpeg(image_header(image(pixels, encoding, height=0, data=b"")))


def test_an_image_too_wide_for_jpeg_is_one_error() -> None:
    with pytest.raises(MalformedMessageError, match="65500"):
        image_to_jpeg(image_header(image(np.zeros((1, 70_000, 1), dtype=np.uint8), "mono8")))


def test_compressed_colour_is_no_depth() -> None:
    color = CompressedColor(stamp_ns=0, frame_id="c", format="jpeg", data=b"\xff\xd8 and so on")
    with pytest.raises(UnreadableImageError, match="Expected 16-bit depth"):
        DepthImage.from_message(schema.COMPRESSED_IMAGE, color.to_cdr())


def test_a_truncated_jpeg_is_one_error() -> None:
    jpeg = image_to_jpeg(image_header(image(smooth_rgb(), "rgb8")))
    assert jpeg is not None
    color = CompressedColor.from_cdr(jpeg)
    cut = CompressedColor(stamp_ns=0, frame_id="c", format="jpeg", data=color.data[:300])
    with pytest.raises(UnreadableImageError, match="unreadable image"):
        cut.image_u8()


@settings(max_examples=300)
@given(st.data())
def test_damaged_images_give_a_message_or_one_error(data: st.DataObject) -> None:
    encoding = data.draw(st.sampled_from(["rgb8", "mono8", "bgra8", "16UC1"]))
    channels = COLOR_LAYOUTS.get(encoding, ("", 2))[1]
    whole = bytearray(image(np.ones((3, 4, channels), dtype=np.uint8), encoding))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, min(len(whole) - 1, 56)))
        whole[at] = data.draw(st.integers(0, 255))
    damaged = bytes(whole[: data.draw(st.integers(0, len(whole)))])
    for work in (image_to_jpeg, depth_to_compact):
        with contextlib.suppress(MalformedMessageError):
            work(image_header(damaged))
    for read in (DepthImage.from_message, color_from_message):
        for type_name in (schema.IMAGE, schema.COMPRESSED_IMAGE):
            with contextlib.suppress(BridgeError):
                read(type_name, damaged)
