"""Numbers as tables show them: millimetres, degrees and milliseconds with two decimals."""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

from evaluator.result import Interval

Item = TypeVar("Item")
DEGREES = math.degrees(1.0)


def millimetres(value_m: float | None) -> float | None:
    """Return a length [mm]; None stays None, and so does what is no number."""
    return _rounded(value_m, 1e3)


def degrees(value_rad: float | None) -> float | None:
    """Return an angle [deg]; None stays None, and so does what is no number."""
    return _rounded(value_rad, DEGREES)


def milliseconds(value_s: float | None) -> float | None:
    """Return a duration [ms]; None stays None, and so does what is no number."""
    return _rounded(value_s, 1e3)


def millimetre_ends(interval: Interval | None) -> str | None:
    """Return both ends of an interval of a length [mm]."""
    if interval is None:
        return None
    return f"[{1e3 * interval.low:.1f}, {1e3 * interval.high:.1f}]"


def average(items: Sequence[Item], read: Callable[[Item], float | None]) -> float | None:
    """Return the mean of what is known; None when nothing is."""
    values = [value for item in items if (value := read(item)) is not None]
    return sum(values) / len(values) if values else None


def _rounded(value: float | None, factor: float) -> float | None:
    return None if value is None or not math.isfinite(value) else round(factor * value, 2)
