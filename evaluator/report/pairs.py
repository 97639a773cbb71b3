"""The worst views as pictures: recorded beside rendered, inside the page as PNG."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

MAX_PAIRS = 6
MAX_BYTES = 1_500_000
"""Of all pictures together, before base64: the page must stay easy to send."""


@dataclass(frozen=True, kw_only=True)
class ViewPair:
    """One held-out image and what the twin rendered in its place."""

    name: str
    """View, camera or method, as the tables name it."""
    score: str
    """What makes it one of the worst."""
    recorded_u8: UInt8[np.ndarray, "height width 3"]
    rendered_u8: UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One side of a pair, as the page holds it."""

    side: str
    width: int
    height: int
    png: str
    """In base64."""


def pictures_of(pairs: Sequence[ViewPair]) -> list[tuple[ViewPair, tuple[Picture, Picture]]]:
    """Return the first views with their pictures, as many as the page may hold."""
    shown, spent = [], 0
    for pair in pairs[:MAX_PAIRS]:
        recorded, rendered = _png(pair.recorded_u8), _png(pair.rendered_u8)
        spent += len(recorded) + len(rendered)
        if spent > MAX_BYTES:
            break
        pictures = (
            _picture("recorded", pair.recorded_u8, recorded),
            _picture("rendered", pair.rendered_u8, rendered),
        )
        shown.append((pair, pictures))
    return shown


def _picture(side: str, image_u8: UInt8[np.ndarray, "height width 3"], png: bytes) -> Picture:
    height, width = image_u8.shape[:2]
    return Picture(side=side, width=width, height=height, png=base64.b64encode(png).decode())


def _png(image_u8: UInt8[np.ndarray, "height width 3"]) -> bytes:
    from PIL import Image  # noqa: PLC0415  # only a page with pictures needs it

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image_u8)).save(stream, format="png", compress_level=6)
    return stream.getvalue()
