"""One rendered view with all its scores, as figures and dashboards take it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

NUM_WORST = 4
"""Views of a method whose pictures are kept: those with the lowest raw PSNR."""
PICTURE_WIDTH_PX = 320


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewQuality:
    """Every number about one rendered view; pictures only of the worst few of its method."""

    episode: str
    """The recorded episode, or the name of the reference folder."""
    view_id: str
    """``camera/stamp_ns``, or the file name without its ending."""
    method: str
    """``twin``, or as the user named a folder of renders."""
    values: Mapping[str, float]
    """By the last part of the id in ``results.json``: ``psnr_db``, ``psnr_gain_db``, ``ssim``."""
    recorded_u8: UInt8[np.ndarray, "height width 3"] | None = None
    rendered_u8: UInt8[np.ndarray, "height width 3"] | None = None


def shrunk_u8(
    image: UInt8[np.ndarray, "height width 3"] | Float[np.ndarray, "height width 3"],
) -> UInt8[np.ndarray, "small_height small_width 3"]:
    """Average whole squares of pixels until the picture is at most ``PICTURE_WIDTH_PX`` wide.

    Args:
        image: 8 bits, or float in 0..1.
    """
    values = image * 255.0 if np.issubdtype(image.dtype, np.floating) else image
    side = max(1, -(-image.shape[1] // PICTURE_WIDTH_PX))
    side = min(side, image.shape[0])
    rows, columns = image.shape[0] // side, image.shape[1] // side
    squares = values[: rows * side, : columns * side].reshape(rows, side, columns, side, 3)
    return np.asarray(np.rint(squares.mean(axis=(1, 3))), dtype=np.uint8)
