"""16-bit depth PNG files and the rules that turn stored numbers into millimetres."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt16

from bridge.media.color import UnreadableImageError, open_image

ROTATED_ENCODING = "rotated3"
"""The bits of each value are rotated right by three (APC 2016 files)."""


def decode_depth_png(data: bytes) -> UInt16[np.ndarray, "height width"]:
    """Decode a 16-bit greyscale PNG to its stored numbers."""
    with open_image(data) as image:
        if not image.mode.startswith("I"):
            raise UnreadableImageError(found=f"depth image has mode {image.mode}, need 16 bit")
        return np.asarray(image).astype(np.uint16)


def undo_rotation(stored: UInt16[np.ndarray, "height width"]) -> UInt16[np.ndarray, "height width"]:
    """Rotate the bits of each value left by 13, that is v = (d >> 3) | (d << 13)."""
    return (stored >> np.uint16(3)) | (stored << np.uint16(13))


def to_millimetres(
    stored: UInt16[np.ndarray, "height width"],
    *,
    unit_m: float,
    invalid_values: Iterable[int] = (0,),
    encoding: str = "",
) -> UInt16[np.ndarray, "height width"]:
    """Apply a folder's decode rules; every invalid code becomes 0."""
    values = undo_rotation(stored) if encoding == ROTATED_ENCODING else stored
    invalid = np.isin(stored, list(invalid_values)) | (values == 0)
    millimetres = np.rint(values * (unit_m * 1e3))
    return np.where(invalid | (millimetres > 65535), 0, millimetres).astype(np.uint16)
