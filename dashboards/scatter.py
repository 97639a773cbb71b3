"""Layout of the scatter of twin against recorded success rates."""

from collections.abc import Sequence
from dataclasses import dataclass

from dashboards.figures import Axis, axis
from evaluator.result import Measurement

SIZE = 360
MARKERS = ("circle", "square", "diamond", "triangle")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One cell (task, condition, policy) with both rates, as the evaluator measured them."""

    label: str
    group: str
    """Cells of one group are joined by a line: the same task and policy."""
    task: str
    condition: str
    policy: str
    filled: bool
    """Drawn solid: with replanning."""
    replayed: Measurement
    recorded: Measurement


@dataclass(frozen=True, kw_only=True)
class Point:
    """A drawn cell [px]; interval ends are None where there is none."""

    cell: Cell
    x: float
    y: float
    marker: str
    x_low: float | None
    x_high: float | None
    y_low: float | None
    y_high: float | None
    shift: float
    """Points that coincide are drawn side by side [px]."""


@dataclass(frozen=True, kw_only=True)
class Scatter:
    """Everything a template needs to draw the scatter."""

    size: int
    axis_x: Axis
    axis_y: Axis
    points: tuple[Point, ...]
    joins: tuple[str, ...]
    groups: tuple[tuple[str, str], ...]
    """Group name and its marker."""


def scatter(cells: Sequence[Cell]) -> Scatter | None:
    """Lay out the cells that have both rates; None when there is none."""
    drawable = [c for c in cells if c.replayed.value is not None and c.recorded.value is not None]
    if not drawable:
        return None
    axis_x = axis(0.0, 1.0, 44, SIZE - 12)
    axis_y = axis(0.0, 1.0, SIZE - 44, 12)
    groups = list(dict.fromkeys(cell.group for cell in drawable))
    markers = {group: MARKERS[index % len(MARKERS)] for index, group in enumerate(groups)}
    taken: dict[tuple[float, float], int] = {}
    points = []
    for cell in drawable:
        place = (axis_x.px(_value(cell.replayed)), axis_y.px(_value(cell.recorded)))
        count = taken.get(place, 0)
        taken[place] = count + 1
        points.append(_point(cell, axis_x, axis_y, markers[cell.group], shift=7.0 * count))
    return Scatter(
        size=SIZE,
        axis_x=axis_x,
        axis_y=axis_y,
        points=tuple(points),
        joins=tuple(_join(points, group) for group in groups),
        groups=tuple(markers.items()),
    )


def _value(measurement: Measurement) -> float:
    return 0.0 if measurement.value is None else measurement.value


def _point(cell: Cell, axis_x: Axis, axis_y: Axis, marker: str, *, shift: float) -> Point:
    across, upright = cell.replayed.interval, cell.recorded.interval
    return Point(
        cell=cell,
        x=axis_x.px(_value(cell.replayed)) + shift,
        y=axis_y.px(_value(cell.recorded)),
        marker=marker,
        x_low=None if across is None else axis_x.px(across.low),
        x_high=None if across is None else axis_x.px(across.high),
        y_low=None if upright is None else axis_y.px(upright.low),
        y_high=None if upright is None else axis_y.px(upright.high),
        shift=shift,
    )


def _join(points: Sequence[Point], group: str) -> str:
    of_group = sorted(
        (point for point in points if point.cell.group == group), key=lambda p: p.cell.filled
    )
    return " ".join(f"{point.x:g},{point.y:g}" for point in of_group)
