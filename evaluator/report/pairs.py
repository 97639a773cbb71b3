"""The worst views as pictures: recorded beside rendered, inside the page as PNG."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

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


def pairs_html(pairs: Sequence[ViewPair], number: int) -> str:
    """Write the worst views, worst first; nothing without pictures.

    Args:
        pairs: Views, worst first; as many as fit are shown.
        number: Number of the figure in the page.
    """
    shown, spent = [], 0
    for pair in pairs[:MAX_PAIRS]:
        pictures = (_png(pair.recorded_u8), _png(pair.rendered_u8))
        spent += sum(len(picture) for picture in pictures)
        if spent > MAX_BYTES:
            break
        shown.append((pair, pictures))
    if not shown:
        return ""
    rows = "".join(
        f'<div class="pair"><p>{escape(pair.name)} <span class="soft">{escape(pair.score)}</span>'
        f"</p><div>{_image(pair, 'recorded', recorded)}{_image(pair, 'rendered', rendered)}</div>"
        "</div>"
        for pair, (recorded, rendered) in shown
    )
    return (
        f'<figure id="figure-worst" class="whole"><div class="pairs">{rows}</div><figcaption>'
        f"<b>Figure {number}.</b> <strong>The worst views.</strong> Left as recorded, right as "
        "rendered from the same camera; worst first, scaled down where they were larger."
        "</figcaption></figure>"
    )


def _image(pair: ViewPair, side: str, png: bytes) -> str:
    height, width = (pair.recorded_u8 if side == "recorded" else pair.rendered_u8).shape[:2]
    data = base64.b64encode(png).decode()
    return (
        f'<img alt="{escape(pair.name)}, {side}" width="{width}" height="{height}" '
        f'src="data:image/png;base64,{data}">'
    )


def _png(image_u8: UInt8[np.ndarray, "height width 3"]) -> bytes:
    from PIL import Image  # noqa: PLC0415  # only a page with pictures needs it

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image_u8)).save(stream, format="png", compress_level=6)
    return stream.getvalue()
