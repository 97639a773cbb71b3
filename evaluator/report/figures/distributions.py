"""Many values at once: error over time as bands, and distributions as steps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from evaluator.compare.plot_data import CurveBand, Shares
from evaluator.report.figures.drawing import (
    LEGEND_LINE_IN,
    LIGHT,
    Drawing,
    NotDrawn,
    framed,
    grid,
    legend,
    legend_columns,
    listed,
    log_axis,
    panel,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from evaluator.compare.images.scores import ViewQuality
from evaluator.compare.plot_data import shares_of
from evaluator.compare.states import StateSummary
from evaluator.report.pairs import ViewPair

if TYPE_CHECKING:
    from matplotlib.figure import Figure


COLOURS = ("sim", "executed", "third", "fourth", "rec", "soft")
LINES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1)), (0, (3, 1, 1, 1, 1, 1)))


def motions(bands: Sequence[CurveBand]) -> Drawing | NotDrawn:
    """Draw the distance of recorded and replayed tool over normalised time."""
    if not bands:
        return NotDrawn(id="motions", reason="no trial has both a recorded tool and a replayed one")

    shown = bands[: len(COLOURS)]
    head = 0.12 + LEGEND_LINE_IN * len(shown)

    def draw(figure: "Figure") -> None:
        axes = panel(figure, left=0.5, bottom=0.4, top=head)
        grid(axes)
        for index, band in enumerate(shown):
            time = _percent_of(len(band.median))
            colour = LIGHT[COLOURS[index]]
            low, high, median = (
                [1000 * v for v in side] for side in (band.low, band.high, band.median)
            )
            axes.fill_between(time, low, high, color=colour, alpha=0.18, linewidth=0)
            axes.plot(
                time, median, color=colour, linestyle=LINES[index], linewidth=1.5,
                label=f"{band.name} (n = {band.num_curves})",
            )  # fmt: skip
        axes.set_xlim(0, 100)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("time from start to end (%)")
        axes.set_ylabel("distance of the tool (mm)")
        legend(axes, columns=1)

    middle = [(band, len(band.median) // 2) for band in bands]
    return Drawing(
        id="motions",
        title="Recorded against replayed motion",
        caption="Distance of the recorded tool centre point from the replayed one over normalised "
        "time: median over trials, band from the 10th to the 90th percentile. Planned: what was "
        "commanded, so the controller's tracking error; executed: the joints the robot reported, "
        "so kinematics and calibration.",
        alt="Median distance: "
        + listed(
            [
                f"{band.name}: {1000 * band.median[0]:.1f} mm at the start, "
                f"{1000 * band.median[half]:.1f} mm half-way, {1000 * band.median[-1]:.1f} mm at "
                f"the end, {band.num_curves} trials"
                for band, half in middle
            ]
        ),
        height_in=2.35 + head,
        draw=draw,
    )


def _percent_of(count: int) -> list[float]:
    return [100 * i / max(1, count - 1) for i in range(count)]


@dataclass(frozen=True, kw_only=True)
class Panel:
    """Distributions that share one axis."""

    label: str
    """With its unit."""
    groups: tuple[Shares, ...]
    log: bool = False
    """Errors spread over decades; quality scores do not."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """The words of a figure of distributions."""

    id: str
    title: str
    caption: str
    reason: str
    """Why there is none, when there are no values."""


def distributions(subject: Subject, panels: Sequence[Panel]) -> Drawing | NotDrawn:
    """Draw for each panel which share of the values is at most as large."""
    panels = [panel for panel in panels if panel.groups]
    if not panels:
        return NotDrawn(id=subject.id, reason=subject.reason)
    names = list(dict.fromkeys(group.name for panel in panels for group in panel.groups))
    drawn = names[: len(COLOURS)]
    columns = legend_columns([f"{name} (n = 100)" for name in drawn])
    head = LEGEND_LINE_IN * -(-len(drawn) // columns) + 0.12
    tall = 1.55
    height = head + len(panels) * (tall + 0.52)

    def draw(figure: "Figure") -> None:
        for index, item in enumerate(panels):
            bottom = height - head - index * (tall + 0.52) - tall
            axes = framed(figure, (0.5, bottom, 2.88, tall))
            grid(axes)
            if item.log and _decades(item.groups) > 1:
                log_axis(axes)
            for group in item.groups:
                if group.name not in drawn:
                    continue
                place = drawn.index(group.name)
                axes.step(
                    group.values, [100 * s for s in group.shares], where="post",
                    color=LIGHT[COLOURS[place]], linestyle=LINES[place], linewidth=1.4,
                    label=f"{group.name} (n = {group.n})",
                )  # fmt: skip
                if group.n <= 12:
                    axes.plot(
                        group.values, [100 * s for s in group.shares], "o", markersize=3,
                        color=LIGHT[COLOURS[place]],
                    )  # fmt: skip
            _widen(axes, item.groups)
            axes.set_ylim(0, 103)
            axes.set_yticks(range(0, 101, 25))
            axes.set_xlabel(item.label, labelpad=1)
            axes.set_ylabel("share at most (%)")
            if index == 0:
                legend(axes, columns=columns)

    hidden = f" {len(names) - len(drawn)} more are not drawn." if len(names) > len(drawn) else ""
    return Drawing(
        id=subject.id,
        title=subject.title,
        caption=f"{subject.caption} Height: the share of values that are at most this large."
        f"{hidden}",
        alt="Distributions: "
        + listed(
            [
                f"{item.label}, {group.name}: {group.values[0]:.4g} to {group.values[-1]:.4g}, "
                f"middle {_at(group, 0.5):.4g}, n = {group.n}"
                for item in panels
                for group in item.groups
            ]
        ),
        height_in=height,
        draw=draw,
    )


def _widen(axes: "Axes", groups: Sequence[Shares]) -> None:
    """Show values that are all but equal as equal, not as noise blown up."""
    low = min(group.values[0] for group in groups)
    high = max(group.values[-1] for group in groups)
    if high - low < ALIKE * max(abs(low), abs(high)) or high == low:
        room = max(abs(high), 1.0)
        axes.set_xlim(low - room, high + room)


ALIKE = 1e-3
"""Share of a value by which others may differ and still look the same."""


def _decades(groups: Sequence[Shares]) -> float:
    """Powers of ten that positive values span."""
    values = [value for group in groups for value in group.values if value > 0]
    return math.log10(max(values) / min(values)) if values else 0.0


def _at(group: Shares, share: float) -> float:
    """Read a drawn distribution at one height."""
    pairs = zip(group.values, group.shares, strict=True)
    return next((value for value, part in pairs if part >= share - 1e-12), group.values[-1])


PAIRS = (
    ("plan", "recorded", "plan to localised"),
    ("planned", "recorded", "planned replay to localised"),
    ("executed", "recorded", "executed replay to localised"),
    ("plan", "planned", "plan to planned replay"),
)
"""Who predicts, what it is held against, and what the line is called."""

FINAL_STATES = Subject(
    id="states",
    title="Predicted final states",
    caption="Final state of each object: distance of what was predicted from where it was "
    "localised after the trial, or from where the replay left it; rotation modulo the object's "
    "symmetry. Soft objects: distance of the middles, and the largest difference of an extent.",
    reason="no plan predicts a final state that was localised or replayed",
)


def state_panels(states: Sequence[StateSummary]) -> tuple[Subject, list[Panel]]:
    """Return one panel for each kind of error that any state has."""
    final: dict[tuple[str, str], list[StateSummary]] = {}
    for state in states:
        if state.is_last:
            final.setdefault((state.predicted_by, state.against), []).append(state)
    panels = [
        Panel(label=label, groups=_groups(final, value), log=True)
        for label, value in (
            ("position error (mm)", lambda s: _scaled(s.position_m, 1000.0)),
            ("rotation error (°)", lambda s: _scaled(s.rotation_rad, 180.0 / math.pi)),
            ("error of the extents, soft objects (mm)", lambda s: _scaled(s.extents_m, 1000.0)),
        )
    ]
    return FINAL_STATES, panels


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


def _groups(
    states: Mapping[tuple[str, str], Sequence[StateSummary]],
    value: Callable[[StateSummary], float | None],
) -> tuple[Shares, ...]:
    found = []
    for predicted_by, against, name in PAIRS:
        errors = map(value, states.get((predicted_by, against), ()))
        values = [error for error in errors if error is not None]
        shares = shares_of(name, values)
        if shares is not None:
            found.append(shares)
    return tuple(found)


METRICS = (
    ("psnr_db", "PSNR (dB), higher is better"),
    ("ssim", "SSIM, higher is better"),
    ("lpips", "LPIPS, lower is better"),
)
"""First part of a metric's name, and the label of its axis."""
WORST_BY = "psnr_db"

IMAGE_METRICS = Subject(
    id="views",
    title="Image metrics over all views",
    caption="Raw values over the full frame; gain: after one fitted gain per image and channel. "
    "Their protocols stand with each number.",
    reason="no rendered view has a recorded image",
)


def view_panels(views: Sequence[ViewQuality]) -> tuple[Subject, list[Panel]]:
    """Return one panel for each metric that any view has, a line for each method."""
    methods = list(dict.fromkeys(view.method for view in views))
    known = sorted({name for view in views for name in view.values})
    panels = []
    for start, label in METRICS:
        name = start if start in known else next((n for n in known if n.startswith(start)), None)
        if name is None:
            continue
        lines = [(method, method, name) for method in methods]
        if len(methods) == 1:
            lines += [
                (f"{methods[0]}, {variant}", methods[0], other)
                for variant, other in (("gain", _gain_of(name)),)
                if other in known
            ]
        shown = label if name == start else f"{label} ({name})"
        groups = [_shares(views, *line) for line in lines]
        panels.append(Panel(label=shown, groups=tuple(g for g in groups if g is not None)))
    return IMAGE_METRICS, panels


def _gain_of(name: str) -> str:
    return f"{name.removesuffix('_db')}_gain{'_db' if name.endswith('_db') else ''}"


def _shares(views: Sequence[ViewQuality], label: str, method: str, name: str) -> Shares | None:
    values = [v.values[name] for v in views if v.method == method and name in v.values]
    return shares_of(label, values)


def worst_pairs(views: Sequence[ViewQuality]) -> list[ViewPair]:
    """Return the views that hold pictures, worst first."""
    found = []
    for view in views:
        if view.recorded_u8 is None or view.rendered_u8 is None:
            continue
        score = view.values.get(WORST_BY)
        text = "no PSNR" if score is None else f"PSNR {score:.2f} dB"
        name = " · ".join(part for part in (view.method, view.episode, view.view_id) if part)
        pair = ViewPair(
            name=name, score=text, recorded_u8=view.recorded_u8, rendered_u8=view.rendered_u8
        )
        found.append((score if score is not None else float("inf"), pair))
    return [pair for _, pair in sorted(found, key=lambda item: item[0])]
