"""Imported motions as drawings: recorded band against simulators, over time and in space."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dashboards.figures import Axis, axis

RECORDED = "recorded"
STYLES = 8
"""Colours and dashes of lines; the ninth engine looks like the first."""
AXES = ("x", "y", "z")
WIDTH, HEIGHT = 370, 190
LARGEST = 340
"""The longer side of a view of paths [px]."""
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


def _points(across: Sequence[float], up: Sequence[float], x: Axis, y: Axis) -> str:
    return " ".join(f"{x.px(a):g},{y.px(b):g}" for a, b in zip(across, up, strict=True))
