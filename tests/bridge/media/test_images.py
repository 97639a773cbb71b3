"""Colour and depth decoding: round trips, rules of the folders, broken bytes."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from bridge.media.color import UnreadableImageError, decode_color, encode_jpeg


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
