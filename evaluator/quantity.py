"""What a measurement is made of: its id, unit, definition, and the registry of all of them."""

import math
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

Better = Literal["higher", "lower", "none"]
"""Which way a value is better; ``none`` where it describes and does not judge."""


def slug(text: str) -> str:
    """Return text usable as one part of a measurement id.

    Letters beyond ASCII are written as their code points, so that names in any script stay apart.
    Blanks and signs become ``_``, so that names may still share one: ``refuse_alike``.
    """
    if not text.isascii():
        text = "".join(c if c.isascii() else f"+{ord(c):04x}" for c in text)
    return re.sub(r"[^A-Za-z0-9_+-]+", "_", text) or "-"


def unslug(part: str) -> str:
    """Words that a part of a measurement id stands for: ``slug`` backwards, signs as blanks."""
    return re.sub(r"\+([0-9a-f]{4})", lambda found: chr(int(found[1], 16)), part).replace("_", " ")


PLURALS = {"pair of runs": "pairs of runs", "policy": "policies"}


def noun(name: str, count: int) -> str:
    """Write what was counted, in the plural but for one."""
    return name if count == 1 else PLURALS.get(name, f"{name}s")


@dataclass(frozen=True, kw_only=True)
class Defined:
    """What one measurement is: the part of it that its quantity decides."""

    id: str
    unit: str
    definition: str


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """One kind of measurement."""

    id: str
    """With the names of its variable parts in braces."""
    unit: str
    definition: str
    """With words of the single measurement in braces."""
    better: Better
    low: float
    high: float
    """The least and the largest value that the definition allows, ends included."""

    def holds(self, value: float) -> bool:
        """Whether a value is possible; what floats round off is not held against it."""
        room = 1e-9 * max(1.0, abs(value))
        return self.low - room <= value <= self.high + room

    def of(self, **words: object) -> Defined:
        """Name one measurement."""
        parts = {name: slug(str(word)) for name, word in words.items() if f"{{{name}}}" in self.id}
        return Defined(
            id=self.id.format(**parts), unit=self.unit, definition=self.definition.format(**words)
        )

    @cached_property
    def pattern(self) -> re.Pattern[str]:
        """Matches the ids of this quantity, with their parts as groups."""
        parts = re.split(r"\{(\w+)\}", self.id)
        ends = [re.escape(text) for text in parts[::2]]
        names = [rf"(?P<{name}>[A-Za-z0-9_+-]+)" for name in parts[1::2]]
        return re.compile("".join(a + b for a, b in zip(ends, [*names, ""], strict=True)))


REGISTRY: list[Quantity] = []
"""All that were defined so far."""
_FAMILIES: dict[str, list[Quantity]] = {}
"""The same by the first word of their ids."""


def quantity_of(measurement_id: str) -> Quantity | None:
    """Return the quantity an id belongs to, the one with the fewest variable parts."""
    family = measurement_id.partition(".")[0]
    found = [q for q in _FAMILIES.get(family, ()) if q.pattern.fullmatch(measurement_id)]
    return min(found, key=lambda q: q.id.count("{"), default=None)


INFINITY = math.inf
RANGES: dict[str, tuple[float, float]] = {
    "1": (0.0, 1.0),
    "pp": (-100.0, 100.0),
    "m": (0.0, INFINITY),
    "rad": (0.0, math.pi),
    "s": (-INFINITY, INFINITY),
    "dB": (0.0, INFINITY),
    "count": (0.0, INFINITY),
}
"""By unit, where a quantity has no range of its own."""
SIGNED = (-1.0, 1.0)
"""Correlations and the like."""
UP = (0.0, INFINITY)


def new_quantity(
    unit: str,
    better: Better,
    id: str,  # the word everywhere
    definition: str,
    allowed: tuple[float, float] | None = None,
) -> Quantity:
    """Register a quantity; ids and definitions may hold names of parts in braces."""
    low, high = allowed or RANGES[unit]
    quantity = Quantity(id=id, unit=unit, definition=definition, better=better, low=low, high=high)
    REGISTRY.append(quantity)
    _FAMILIES.setdefault(id.partition(".")[0], []).append(quantity)
    return quantity
