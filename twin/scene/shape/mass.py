"""How heavy a thing of a given name and volume probably is.

Volumes come from the outside: a hollow toy counts as if it were filled, so densities here are
"what it weighs over what it displaces". Calibration replaces the prior when the log allows.
"""

import re
from dataclasses import dataclass

from twin.scene.shape.masked_view import ShapeError


@dataclass(frozen=True, kw_only=True)
class MassPrior:
    """A guess with its range, and where it comes from."""

    mass_kg: float
    low_kg: float
    high_kg: float
    density_kg_m3: float
    material: str
    source: str


@dataclass(frozen=True, kw_only=True)
class _Material:
    name: str
    words: tuple[str, ...]
    density_kg_m3: tuple[float, float, float]
    """Low, likely, high."""
    source: str


_DESIGN = "design page on perception, section 3: foam 0.05, plush 0.15, plastic 0.5-1.0 g/cm3"
_MATERIALS = (
    _Material(
        name="foam",
        words=("foam", "sponge"),
        density_kg_m3=(20.0, 50.0, 100.0),
        source=_DESIGN,
    ),
    _Material(
        name="plush",
        words=("plush", "sloth", "teddy", "bear", "bunny", "doll", "stuffed", "cushion"),
        density_kg_m3=(80.0, 150.0, 250.0),
        source=_DESIGN,
    ),
    _Material(
        name="hollow soft plastic",
        words=("duck", "ball"),
        density_kg_m3=(80.0, 200.0, 450.0),
        source="assumed: a hollow bath toy, between plush and solid plastic; not measured",
    ),
    _Material(
        name="plastic",
        words=("plastic", "box", "bin", "tray", "basket", "container", "bowl", "cup", "cube"),
        density_kg_m3=(500.0, 750.0, 1000.0),
        source=_DESIGN,
    ),
)
_UNKNOWN = _Material(
    name="unknown",
    words=(),
    density_kg_m3=(50.0, 500.0, 2000.0),
    source="no word of the label names a material: anything from foam to stone",
)


def mass_prior(label: str, volume_m3: float) -> MassPrior:
    """Mass of a thing from the words of its label and its volume.

    Args:
        label: A name or a few words; ``duck_3`` and ``red cube`` are understood.
        volume_m3: Volume of its closed shape.

    Raises:
        ShapeError: When the volume is not a positive number.
    """
    if not 0 < volume_m3 < float("inf"):
        message = f"{label!r} has a volume of {volume_m3:g} m3, so nothing is known of its mass."
        raise ShapeError(message)
    words = {re.sub(r"s$", "", word) for word in re.split(r"[^a-z]+", label.lower())}
    material = next((m for m in _MATERIALS if words & set(m.words)), _UNKNOWN)
    low, likely, high = material.density_kg_m3
    return MassPrior(
        mass_kg=likely * volume_m3,
        low_kg=low * volume_m3,
        high_kg=high * volume_m3,
        density_kg_m3=likely,
        material=material.name,
        source=material.source,
    )
