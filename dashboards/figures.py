"""Numbers to pixel positions: ticks, lines and bars as SVG geometry for the templates.

Only the layout of a drawing is worked out here; every number that is shown comes from a file.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

MAX_POINTS = 400
"""A line wider than the plot has pixels is thinned to this many points, extremes kept."""


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One labelled place on an axis [px]."""

    px: float
    label: str


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A linear axis from data to pixels."""

    low: float
    high: float
    px_low: float
    px_high: float
    ticks: tuple[Tick, ...] = ()

    def px(self, value: float) -> float:
        """Return the pixel of a value."""
        share = (value - self.low) / (self.high - self.low)
        return round(self.px_low + share * (self.px_high - self.px_low), 2)


@dataclass(frozen=True, kw_only=True)
class Signal:
    """One line to draw: values over seconds; NaN where it is missing."""

    name: str
    style: str
    """CSS class that gives colour and dash."""
    t_s: Float[np.ndarray, " num_samples"]
    values: Float[np.ndarray, " num_samples"]


@dataclass(frozen=True, kw_only=True)
class Line:
    """A drawn line: SVG point lists, one per stretch without a gap."""

    name: str
    style: str
    pieces: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class TimePlot:
    """Everything a template needs to draw signals over time."""

    title: str
    unit: str
    width: int
    height: int
    x: Axis
    y: Axis
    lines: tuple[Line, ...]
    level_px: float | None = None
    level_label: str = ""
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Span:
    """A labelled stretch of time."""

    start_s: float
    end_s: float
    label: str
    style: str
    title: str = ""


@dataclass(frozen=True, kw_only=True)
class StageChart:
    """Stages in lanes over time, with instants worth a line across the lanes."""

    width: int
    x: Axis
    lanes: tuple[tuple[str, tuple[Span, ...]], ...]
    """Name and stages of each, from top to bottom."""
    marks: tuple[tuple[float, str, str], ...]
    """Page time [s], text and style."""

    def at(self, width: int) -> "StageChart":
        """The same at another width [px]."""
        x = axis(self.x.low, self.x.high, LANE_LABEL_WIDTH, width - 8, wanted=width // 110)
        return replace(self, width=width, x=x)

    def bar(self, span: Span) -> tuple[float, float, str]:
        """Where a stretch begins and how wide it is [px], and its label where that fits."""
        ends_s = (min(max(t_s, self.x.low), self.x.high) for t_s in (span.start_s, span.end_s))
        start, end = map(self.x.px, ends_s)
        width = max(round(end - start - 1.5, 2), 1.5)
        return start, width, span.label if width > 7.2 * len(span.label) + 8 else ""


def nice_ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Return round numbers (1, 2, 5 times a power of ten) in a range; none if it is not finite."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return []
    rough = (high - low) / max(wanted, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [index * step for index in range(first, last + 1)]


def _labels(values: Sequence[float]) -> list[str]:
    step = values[1] - values[0] if len(values) > 1 else 1.0
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    return [
        f"{abs(value) if value == 0 else value:.{digits}f}".replace("-", "−") for value in values
    ]


def axis(low: float, high: float, px_low: float, px_high: float, wanted: int = 5) -> Axis:
    """Build an axis with round ticks between two places [px]; a single value gets a margin."""
    if high - low < 1e-12:
        margin = max(abs(low) * 0.1, 1e-3)
        low, high = low - margin, high + margin
    bare = Axis(low=low, high=high, px_low=px_low, px_high=px_high)
    values = nice_ticks(low, high, wanted)
    ticks = tuple(
        Tick(px=bare.px(value), label=label)
        for value, label in zip(values, _labels(values), strict=True)
    )
    return Axis(low=low, high=high, px_low=px_low, px_high=px_high, ticks=ticks)


def _thin(signal: Signal) -> tuple[np.ndarray, np.ndarray]:
    """Keep each bucket's smallest and largest sample so that no spike disappears."""
    t_s, values = np.asarray(signal.t_s, float), np.asarray(signal.values, float)
    if len(t_s) <= MAX_POINTS:
        return t_s, values
    edges = np.linspace(0, len(t_s), MAX_POINTS // 2 + 1).astype(int)
    keep: list[int] = []
    for start, end in pairwise(edges.tolist()):
        piece = values[start:end]
        if np.isnan(piece).any():
            keep.extend(range(start, end))
        else:
            keep.extend(sorted({start + int(piece.argmin()), start + int(piece.argmax())}))
    return t_s[keep], values[keep]


def _pieces(t_s: np.ndarray, values: np.ndarray, x: Axis, y: Axis) -> tuple[str, ...]:
    pieces: list[str] = []
    points: list[str] = []
    for t, value in zip(t_s, values, strict=True):
        if math.isfinite(value):
            points.append(f"{x.px(t):g},{y.px(value):g}")
        elif points:
            pieces.append(" ".join(points))
            points = []
    if points:
        pieces.append(" ".join(points))
    return tuple(pieces)


def time_plot(
    title: str,
    unit: str,
    signals: Sequence[Signal],
    *,
    span_s: tuple[float, float],
    level: float | None = None,
    level_label: str = "",
    least_span: float = 0.0,
    note: str = "",
    width: int = 560,
    height: int = 190,
) -> TimePlot | None:
    """Lay out signals over a span of time; None when there is nothing to draw.

    The value axis covers ``least_span`` at least, so that noise is not blown up to a motion.

    Args:
        level: Value of a horizontal line, for example a safety distance; None draws none.
        width: Of the whole plot [px]; its height too.
    """
    finite = [signal.values[np.isfinite(signal.values)] for signal in signals]
    finite = [values for values in finite if len(values)]
    if not finite:
        return None
    low = min(float(values.min()) for values in finite)
    high = max(float(values.max()) for values in finite)
    if level is not None:
        low, high = min(low, level), max(high, level)
    margin = max((high - low) * 0.06, (least_span - (high - low)) / 2)
    x = axis(span_s[0], span_s[1], 46, width - 8, wanted=7)
    y = axis(low - margin, high + margin, height - 24, 10, wanted=4)
    lines = tuple(
        Line(name=signal.name, style=signal.style, pieces=_pieces(*_thin(signal), x, y))
        for signal in signals
    )
    return TimePlot(
        title=title,
        unit=unit,
        width=width,
        height=height,
        x=x,
        y=y,
        lines=lines,
        level_px=None if level is None else y.px(level),
        level_label=level_label,
        note=note,
    )


LANE_LABEL_WIDTH, WIDE = 92, 1130


def stage_chart(
    lanes: Sequence[tuple[str, Sequence[Span]]],
    marks: Sequence[tuple[float, str, str]],
    *,
    span_s: tuple[float, float],
) -> StageChart | None:
    """Lay out stages in named lanes; None when no lane holds any.

    Empty lanes, and marks outside of the span, are left out.
    """
    filled = tuple((name, tuple(spans)) for name, spans in lanes if spans)
    if not filled:
        return None
    bare = axis(*span_s, 0, 1)
    inside = tuple(mark for mark in marks if bare.low <= mark[0] <= bare.high)
    return StageChart(width=0, x=bare, lanes=filled, marks=inside).at(WIDE)
