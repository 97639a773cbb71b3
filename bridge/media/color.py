"""JPEG and PNG colour images."""

import io
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from bridge.errors import BridgeError, MissingDependencyError

if TYPE_CHECKING:
    from PIL.Image import Image

JPEG_QUALITY = 90
JPEG_MAGIC = b"\xff\xd8"
MAX_PIXELS = 64_000_000
"""Refuse larger images: a few bytes of PNG can claim gigabytes."""


def linear_from_srgb(srgb: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Undo the sRGB curve (IEC 61966-2-1): linear light of 0 to 1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


class UnreadableImageError(BridgeError):
    """The bytes are not an image we can decode."""

    def __init__(self, *, found: str, expected: str = "JPEG or 8-bit PNG") -> None:
        """Remember what the decoder said."""
        self.found = found
        super().__init__(f"unreadable image: {found}. Expected {expected}.")


def _brought(module: str, package: str, purpose: str) -> Any:
    """Import what the extra [record] brings, and only some images need."""
    try:
        return import_module(module)
    except ImportError as error:
        raise MissingDependencyError(package=package, extra="record", purpose=purpose) from error


def encode_jpeg(
    image_u8: UInt8[np.ndarray, "height width channels"],
    quality: int = JPEG_QUALITY,
    *,
    layout: str = "RGB",
    subsampling: str = "444",
) -> bytes:
    """Compress an sRGB image as JPEG.

    Raises:
        ValueError: The image is larger than JPEG allows (65500), or empty.
    """
    return bytes(
        _brought("simplejpeg", "simplejpeg", "JPEG encoding").encode_jpeg(
            np.ascontiguousarray(image_u8),
            quality=quality,
            colorspace=layout,
            colorsubsampling="Gray" if layout == "GRAY" else subsampling,
        )
    )


def encode_png(image: np.ndarray, level: int = 3) -> bytes:
    """Compress an 8-bit sRGB or a 16-bit grey image without loss."""
    buffer, pillow = io.BytesIO(), _brought("PIL.Image", "pillow", "writing PNG")
    pillow.fromarray(image).save(buffer, format="png", compress_level=level)
    return buffer.getvalue()


def decode_color(data: bytes) -> UInt8[np.ndarray, "height width 3"]:
    """Decode JPEG or PNG bytes to an sRGB image."""
    if data[:2] == JPEG_MAGIC:
        return _decode_jpeg(data)
    with open_image(data) as image:
        if not image.mode.startswith("I"):
            return np.asarray(image.convert("RGB"))
        grey = np.rint(np.asarray(image).astype(np.float32) / 257).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=2)


@contextmanager
def open_image(data: bytes) -> Iterator["Image"]:
    """Open an image of limited size with Pillow; whatever it says of broken bytes is one error."""
    from PIL import Image as pillow  # noqa: PLC0415  # heavy, only for PNG

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", pillow.DecompressionBombWarning)
            image = pillow.open(io.BytesIO(data))
        with image:
            if image.width * image.height > MAX_PIXELS:
                raise UnreadableImageError(found=f"{image.width} x {image.height} pixels")
            yield image
    # Pillow's PNG reader also lets these out of truncated or forged chunks.
    except (OSError, ValueError, SyntaxError, EOFError, struct.error, zlib.error) as error:
        raise UnreadableImageError(found=str(error)[:120]) from error
    except pillow.DecompressionBombError as error:
        raise UnreadableImageError(found="more pixels than a camera has") from error


def _decode_jpeg(data: bytes) -> UInt8[np.ndarray, "height width 3"]:
    simplejpeg = _brought("simplejpeg", "simplejpeg", "JPEG decoding")
    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(data)
        if width * height > MAX_PIXELS:
            raise UnreadableImageError(found=f"{width} x {height} pixels")
        return np.asarray(simplejpeg.decode_jpeg(data, colorspace="RGB"))
    except ValueError as error:
        raise UnreadableImageError(found=str(error)[:120]) from error
