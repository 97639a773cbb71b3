"""Imported motions as drawings: recorded band against simulators, over time and in space."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from dashboards.figures import Axis, axis

RECORDED = "recorded"
STYLES = 8
"""Colours and dashes of lines; the ninth engine looks like the first."""
AXES = ("x", "y", "z")
WIDTH, HEIGHT = 370, 190
LARGEST = 340
"""The longer side of a view of paths [px]."""
AZIMUTH_RAD, ELEVATION_RAD = math.radians(-60), math.radians(30)
"""Where paths in space are seen from."""
FLATTEST = 0.15
"""The least side of the box around them, of its largest: each axis is to be seen."""
MOST_TASKS = 12
STILL_MM = 10.0
"""What moved less along each axis was waiting, as for the evaluator."""


@dataclass(frozen=True, kw_only=True)
class BandLine:
    """One side of a chart."""

    name: str
    style: str
    points: str


@dataclass(frozen=True, kw_only=True)
class BandChart:
    """Lines over the share of the motion, or over another coordinate, with the recorded band."""

    title: str
    words: str
    """What it shows, for those who cannot see it."""
    width: int
    height: int
    x: Axis
    y: Axis
    x_name: str
    band: str
    """Points of the recorded band's outline; empty without one."""
    lines: tuple[BandLine, ...]
    labels: tuple[tuple[float, float, str], ...] = ()
    """Words in the drawing, and where [px]."""


@dataclass(frozen=True, kw_only=True)
class BandGroup:
    """The charts of one body of one task."""

    task: str
    body: str
    sides: tuple[tuple[str, str, int], ...]
    """Name, style and number of runs."""
    charts: tuple[BandChart, ...]
    is_still: bool
    """Whether it stayed where it was as recorded: folded away."""


def band_groups(about: Mapping[str, Any]) -> tuple[BandGroup, ...]:
    """Draw what the evaluator kept of imported motions; nothing where it kept none.

    Args:
        about: Of the index: paths and distances in millimetres.
    """
    paths = about.get("paths", [])
    engines = sorted({path["side"] for path in paths if path["side"] != RECORDED})
    styles = {name: f"engine-{place % STYLES}" for place, name in enumerate(engines)}
    styles[RECORDED] = RECORDED
    keys = list(dict.fromkeys((path["task"], path["body"]) for path in paths))
    groups = []
    for task, body in keys[: 3 * MOST_TASKS]:
        mine = [path for path in paths if (path["task"], path["body"]) == (task, body)]
        distances = [each for each in about.get("distances", []) if each["task"] == task]
        charts = [_distance_chart(distances, styles)] if body == "tool" and distances else []
        charts += [_over_time(mine, place, styles) for place in range(3)]
        charts += [_view(mine, (0, 1), "from above", styles), _view(mine, (0, 2), "side", styles)]
        charts += [_space(mine, styles)]
        groups.append(
            BandGroup(
                task=task,
                body=body,
                sides=tuple((p["side"], styles[p["side"]], p["num_runs"]) for p in mine),
                charts=tuple(charts),
                is_still=_is_still(mine),
            )
        )
    return tuple(groups)


def _is_still(paths: Sequence[Mapping[str, Any]]) -> bool:
    recorded = next((path["mean_mm"] for path in paths if path["side"] == RECORDED), None)
    if recorded is None:
        return False
    columns = zip(*recorded, strict=True)
    return all(max(column) - min(column) < STILL_MM for column in columns)


def _distance_chart(distances: Sequence[Mapping[str, Any]], styles: Mapping[str, str]) -> BandChart:
    lines = {each["side"]: each["distance_mm"] for each in distances}
    band = distances[0]["band_mm"]
    return _chart(
        "Distance from the recorded mean",
        lines,
        ([0.0] * len(band), band) if band else None,
        styles,
        from_zero=True,
    )


def _over_time(
    paths: Sequence[Mapping[str, Any]], place: int, styles: Mapping[str, str]
) -> BandChart:
    lines = {path["side"]: [point[place] for point in path["mean_mm"]] for path in paths}
    recorded = next((path for path in paths if path["side"] == RECORDED), None)
    band = None
    if recorded is not None:
        low, high = ([p[place] for p in recorded[name]] for name in ("low_mm", "high_mm"))
        band = (low, high)
    return _chart(f"{AXES[place]} of the base frame", lines, band, styles)


def _chart(
    title: str,
    lines: Mapping[str, Sequence[float]],
    band: tuple[Sequence[float], Sequence[float]] | None,
    styles: Mapping[str, str],
    *,
    from_zero: bool = False,
) -> BandChart:
    values = [value for line in lines.values() for value in line]
    values += [*band[0], *band[1]] if band else []
    low, high = (0.0 if from_zero else min(values)), max(values)
    margin = max(0.05 * (high - low), 1.0)
    x = axis(0.0, 100.0, 46, WIDTH - 10, wanted=6)
    y = axis(low - (0.0 if from_zero else margin), high + margin, HEIGHT - 34, 8, wanted=4)
    outline = ""
    if band:
        there = _points(_shares(band[0]), band[0], x, y)
        back = _points(_shares(band[1]), band[1], x, y).split(" ")[::-1]
        outline = " ".join([there, *back])
    return BandChart(
        title=f"{title} [mm]",
        words=f"{title} over the motion, {', '.join(lines)}; the numbers are in the tables below",
        width=WIDTH,
        height=HEIGHT,
        x=x,
        y=y,
        x_name="share of the motion [%]",
        band=outline,
        lines=tuple(
            BandLine(name=name, style=styles[name], points=_points(_shares(line), line, x, y))
            for name, line in lines.items()
        ),
    )


def _shares(line: Sequence[float]) -> list[float]:
    return [100 * place / max(1, len(line) - 1) for place in range(len(line))]


def _view(
    paths: Sequence[Mapping[str, Any]],
    places: tuple[int, int],
    where: str,
    styles: Mapping[str, str],
) -> BandChart:
    """Draw paths in a plane, both axes at one scale."""
    across, up = places
    found = [point for path in paths for point in path["mean_mm"]]
    spans = []
    for place in places:
        low, high = (bound(point[place] for point in found) for bound in (min, max))
        margin = max(0.06 * (high - low), 5.0)
        spans.append((low - margin, high + margin))
    wide, tall = (high - low for low, high in spans)
    scale = min((WIDTH - 60) / wide, LARGEST / tall)
    height = round(tall * scale) + 50
    x = axis(*spans[0], 46, 46 + wide * scale, wanted=4)
    y = axis(*spans[1], height - 40, height - 40 - tall * scale, wanted=3)
    return BandChart(
        title=f"Path, {where}: {AXES[up]} over {AXES[across]} [mm]",
        words=f"mean paths seen {where}, {', '.join(path['side'] for path in paths)}",
        width=WIDTH,
        height=height,
        x=x,
        y=y,
        x_name=f"{AXES[across]} [mm]",
        band="",
        lines=tuple(
            BandLine(
                name=path["side"],
                style=styles[path["side"]],
                points=_points(
                    [p[across] for p in path["mean_mm"]], [p[up] for p in path["mean_mm"]], x, y
                ),
            )
            for path in paths
        ),
    )


def _space(paths: Sequence[Mapping[str, Any]], styles: Mapping[str, str]) -> BandChart:
    """Draw paths in space, all axes at one scale, in the box around them.

    Below the recorded path lies its shadow on the floor of that box.
    """
    found = [point for path in paths for point in path["mean_mm"]]
    bounds = [(min(column), max(column)) for column in zip(*found, strict=True)]
    least = max(1.0, FLATTEST * max(b - a for a, b in bounds))
    box = [(a, max(b, a + least)) for a, b in bounds]
    low = tuple(a for a, _ in box)
    corners = [_seen(corner) for corner in product(*box)]
    (left, right), (bottom, top) = ((min(c), max(c)) for c in zip(*corners, strict=True))
    scale = min((WIDTH - 40) / max(right - left, 1.0), LARGEST / max(top - bottom, 1.0))
    height = round((top - bottom) * scale) + 60
    x = axis(left, right, 20, 20 + (right - left) * scale)
    y = axis(bottom, top, height - 40, height - 40 - (top - bottom) * scale)

    def drawn(points: Sequence[Sequence[float]]) -> str:
        flat = [_seen(point) for point in points]
        return _points([u for u, _ in flat], [v for _, v in flat], x, y)

    lines, labels = [], []
    for place in range(3):
        end = [*low]
        end[place] = box[place][1]
        lines.append(BandLine(name=f"axis {AXES[place]}", style="axis", points=drawn([low, end])))
        u, v = _seen(end)
        labels.append((x.px(u), y.px(v), AXES[place]))
    for path in paths:
        if path["side"] == RECORDED:
            floor = [(px, py, low[2]) for px, py, _ in path["mean_mm"]]
            lines.append(BandLine(name="on the floor", style="shadow", points=drawn(floor)))
    lines += [
        BandLine(name=path["side"], style=styles[path["side"]], points=drawn(path["mean_mm"]))
        for path in paths
    ]
    spans = (f"{n} {round(a)} to {round(b)}" for n, (a, b) in zip(AXES, bounds, strict=True))
    return BandChart(
        title="Path in space [mm]",
        words=f"mean paths in space, {', '.join(path['side'] for path in paths)}",
        width=WIDTH,
        height=height,
        x=Axis(low=x.low, high=x.high, px_low=x.px_low, px_high=x.px_high),
        y=Axis(low=y.low, high=y.high, px_low=y.px_low, px_high=y.px_high),
        x_name=", ".join(spans).replace("-", "−"),
        band="",
        lines=tuple(lines),
        labels=tuple(labels),
    )


def _seen(p_mm: Sequence[float]) -> tuple[float, float]:
    """Project a point along parallel rays: to the right, and up."""
    x, y, z = p_mm
    c, s = math.cos(AZIMUTH_RAD), math.sin(AZIMUTH_RAD)
    up = math.cos(ELEVATION_RAD) * z - math.sin(ELEVATION_RAD) * (c * x + s * y)
    return c * y - s * x, up


def _points(across: Sequence[float], up: Sequence[float], x: Axis, y: Axis) -> str:
    return " ".join(f"{x.px(a):g},{y.px(b):g}" for a, b in zip(across, up, strict=True))
