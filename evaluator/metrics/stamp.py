"""The stamp on every image number: all that must be equal before two of them may be compared."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

MaskMode = Literal["full", "mask-pixels", "black-background"]
"""Which pixels a number is about."""
MASK_MODES: dict[MaskMode, str] = {
    "full": "full frame, no mask",
    "mask-pixels": "only the pixels of the mask",
    "black-background": "full frame, both images black outside the mask",
}
UNSTATED = "not stated"
"""What a stamp says where its source does not: a published table seldom states all of it."""


@dataclass(frozen=True, kw_only=True)
class Stamp:
    """How one image number was made; a value without one cannot be put into a table."""

    metric: str
    """As it is called in a column."""
    implementation: str
    """Where the definition stands, with its version."""
    values: str = "sRGB, data range 0..1"
    window: str = "none"
    padding: str = "none"
    weights: str = "none"
    """Content hash of what was learned, where the metric has learned weights."""
    mask: str = MASK_MODES["full"]
    resolution: str
    crop: str = "no crop"
    alignment: str
    clamp: str = "no clamp"
    split: str
    """Which images were held out, as far as anyone said."""
    stored: str
    """How the rendered image was stored: PNG, JPEG or arrays."""
    mean: str = "mean of per-image values"
    n: int
    """Images in the mean."""

    def __post_init__(self) -> None:
        """Refuse a stamp with a blank on it."""
        for name, value in self._items():
            if not value.strip():
                message = f"an image number needs a protocol stamp with its {name}"
                raise ValueError(message)
        if self.n < 0:
            message = f"{self.n} images cannot be stamped"
            raise ValueError(message)

    def text(self) -> str:
        """Write everything in one line."""
        return "; ".join(_said(name, value) for name, value in self._items())

    @property
    def key(self) -> str:
        """Eight hexadecimal digits that change when anything but the number of images does."""
        return hashlib.sha256(replace(self, n=0).text().encode()).hexdigest()[:8]

    def _items(self) -> list[tuple[str, str]]:
        return [(f.name, str(getattr(self, f.name))) for f in fields(self)]


_PLAIN = ("metric", "values", "mask", "resolution", "crop", "alignment", "clamp", "mean", "stored")
"""Parts that explain themselves; the others are written behind their name."""


def common_text(stamps: Sequence[Stamp]) -> str:
    """Write what several stamps share once, and behind it what is each metric's own.

    Which code computed a value is left to the table of full stamps.

    Raises:
        ValueError: Without a stamp.
    """
    if not stamps:
        message = "a row of image numbers needs at least one protocol stamp"
        raise ValueError(message)
    columns = [dict(stamp._items()) for stamp in dict.fromkeys(stamps)]
    shared: dict[str, str] = {}
    own = []
    for name in columns[0]:
        if name in ("metric", "implementation"):
            continue
        found = list(dict.fromkeys(column[name] for column in columns))
        if len(found) > 1:
            own.append(name)
        elif found[0] != "none":
            shared[name] = found[0]
    unstated = [name for name, value in shared.items() if value == UNSTATED]
    if "resolution" in unstated and shared.get("n") == "0":
        unstated.append("n")  # nobody counted
    said = [_said(name, value) for name, value in shared.items() if name not in unstated]
    if unstated:
        said.append(f"{UNSTATED}: {', '.join(unstated)}")
    parts = ["; ".join(said)]
    for column in columns:
        mine = [f"{name} {column[name]}" for name in own if column[name] != "none"]
        if mine:
            parts.append(f"{column['metric']}: {', '.join(mine)}")
    return ". ".join(part for part in parts if part)


def _said(name: str, value: str) -> str:
    return value if name in _PLAIN else f"{name} {value}"
