"""How images are compared: the metrics, the options, and the stamp on every image number.

All of a stamp must be equal before two numbers may be compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from bridge.errors import UsageError
from bridge.terminal import RARE


@dataclass(frozen=True, kw_only=True)
class ImageMetric:
    """One named number about a pair of images."""

    id: str
    """Part of the ids in ``results.json``."""
    column: str
    """Head of its column in a table."""
    unit: str = "1"
    definition: str
    """With its source."""
    implementation: str
    """Module and version; the version rises whenever a value may change."""
    values: str = "sRGB, data range 0..1"
    """What the metric is given, for a stamp."""
    window: str = "none"
    padding: str = "none"
    higher_is_better: bool = True
    by_pixel: bool = True
    """Whether it can be restricted to the pixels of a mask."""

    def named(self, variant: str) -> str:
        """Return the id of this metric for one variant: ``psnr_gain_db`` for psnr_db and gain."""
        if variant == "raw":
            return self.id
        if self.id.endswith("_db"):
            return f"{self.id.removesuffix('_db')}_{variant}_db"
        return f"{self.id}_{variant}"


MaskMode = Literal["full", "mask-pixels"]
"""Which pixels a number is about."""
MASK_MODES: dict[MaskMode, str] = {
    "full": "full frame, no mask",
    "mask-pixels": "only the pixels of the mask",
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
        return "; ".join(_written(name, value) for name, value in self._items())

    def _items(self) -> list[tuple[str, str]]:
        return [(f.name, str(getattr(self, f.name))) for f in fields(self)]


_PLAIN = ("metric", "values", "mask", "resolution", "crop", "alignment", "clamp", "mean", "stored")
"""Parts that explain themselves; the others are written behind their name."""


def common_text(stamps: Sequence[Stamp]) -> str:
    """Write what several stamps share once, and behind it what is each metric's own.

    Which code computed a value is left to the table of full stamps.
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
    written = [_written(name, value) for name, value in shared.items() if name not in unstated]
    if unstated:
        written.append(f"{UNSTATED}: {', '.join(unstated)}")
    parts = ["; ".join(written)]
    for column in columns:
        mine = [f"{name} {column[name]}" for name in own if column[name] != "none"]
        if mine:
            parts.append(f"{column['metric']}: {', '.join(mine)}")
    return ". ".join(part for part in parts if part)


def _written(name: str, value: str) -> str:
    return value if name in _PLAIN else f"{name} {value}"


NetName = Literal["vgg", "alex"]


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """Images to score, and what is needed for it."""

    renders: tuple[str, ...] = ()
    """METHOD=FOLDER of renders named as the reference; once for each method to compare."""
    reference: Path | None = None
    """Folder of recorded images; the recorded side of the run's held-out views without it."""
    split: Annotated[str, RARE] = UNSTATED
    """Which images were held out, for the stamp: "every 8th frame". A run says so itself."""
    lpips_vgg: Annotated[Path | None, RARE] = None
    """State dict of torchvision's VGG16 (safetensors or torch); makes LPIPS with VGG."""
    lpips_alex: Annotated[Path | None, RARE] = None
    """State dict of torchvision's AlexNet (safetensors or torch); makes LPIPS with AlexNet."""

    @property
    def backbones(self) -> dict[NetName, Path]:
        """The backbones that were given."""
        found: dict[NetName, Path | None] = {"vgg": self.lpips_vgg, "alex": self.lpips_alex}
        return {net: path for net, path in found.items() if path is not None}

    def origin(self) -> dict[str, Any]:
        """Say where the images are, for a page that shows them; nothing without renders."""
        if not self.renders:
            return {}
        reference = None if self.reference is None else str(self.reference.resolve())
        methods = {name: str(folder.resolve()) for name, folder in self.methods().items()}
        return {"reference": reference, "methods": methods}

    def refuse_unused(self) -> None:
        """Refuse settings that nothing would be compared with.

        Raises:
            UsageError: When there is a reference or a split without any renders.
        """
        if not self.renders and (self.reference or self.split != UNSTATED):
            message = "--reference and --split belong to --renders METHOD=FOLDER."
            raise UsageError(message)

    def methods(self) -> dict[str, Path]:
        """Return the folders of renders by method; a folder alone is named after itself."""
        found: dict[str, Path] = {}
        for text in self.renders:
            name, equals, folder = text.partition("=")
            name, folder = (name.strip(), folder) if equals else (Path(text).name, text)
            if not name or not folder.strip():
                message = f"--renders {text!r} names no method or no folder; write METHOD=FOLDER."
                raise UsageError(message)
            if name in found:
                message = f"--renders has two methods called {name}; give each its own name."
                raise UsageError(message)
            found[name] = Path(folder)
        return found
