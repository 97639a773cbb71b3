"""Success rates: the twin's against the recorded ones, and the gain with replanning."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from evaluator.compare.rows import RateGroup
from evaluator.compare.success import WITH
from evaluator.report.figures.drawing import (
    COLUMN_IN,
    LIGHT,
    MARKERS,
    ON_PAPER,
    Drawing,
    NotDrawn,
    framed,
    grid,
    listed,
    panel,
    percent_axis,
    words,
)
from evaluator.result import Measurement
from evaluator.statistics.agreement import counted_groups

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def gains(measurements: Sequence[Measurement], word: str) -> Drawing | NotDrawn:
    """Draw every gain with its interval around the line of no gain."""
    found: dict[str, dict[str, Measurement]] = {}
    for measurement in measurements:
        if measurement.id.startswith("gain.pp.") and measurement.value is not None:
            side, name = measurement.id.split(".", 3)[2:]
            found.setdefault(name, {})[side] = measurement
    if not found:
        return NotDrawn(id="gains", reason="no task was tried without and with replanning")
    names = list(found)
    shown = names[:MAX_ROWS]
    reach = max(_reach(m) for sides in found.values() for m in sides.values())

    def draw(figure: "Figure") -> None:
        axes = panel(figure, left=0.12, right=0.72, bottom=0.4, top=0.3)
        axes.spines["left"].set_visible(False)
        grid(axes, "x")
        axes.axvline(0, color=LIGHT["ink"], linewidth=0.9)
        axes.set_xlim(-reach, reach)
        axes.set_xlabel("gain with replanning (percentage points)")
        axes.set_ylim(len(shown), 0)
        axes.set_yticks([])
        for index, name in enumerate(shown):
            axes.text(-reach, index + 0.22, _label(name), va="center", fontsize=8, bbox=ON_PAPER)
            for side, y, marker in (("sim", 0.5, "o"), ("recorded", 0.76, "s")):
                if side in found[name]:
                    _gain(axes, found[name][side], index + y, side, marker, reach)
        for x, side, marker, text in ((0.0, "sim", "o", "twin"), (0.25, "rec", "s", word)):
            at = -reach + 2 * reach * x
            axes.plot(
                [at + 0.03 * reach], [-0.3], marker=marker, color=LIGHT[side], markersize=5,
                linestyle="", clip_on=False,
            )  # fmt: skip
            axes.text(at + 0.1 * reach, -0.3, text, va="center")

    lines = [(name, side, m) for name, sides in found.items() for side, m in sides.items()]
    rest = f" The first {MAX_ROWS} of {len(names)}." if len(names) > MAX_ROWS else ""
    return Drawing(
        id="gains",
        title="Gain with replanning",
        caption="Difference of the success rates with and without replanning; bars are 95 % "
        "intervals. One that reaches left of the line does not show a gain. A gain without a bar "
        f"has no interval; its measurement says why.{rest}",
        alt="Gains in percentage points: "
        + listed([f"{_label(name)}, {side}: {m.value:+.1f}" for name, side, m in lines]),
        height_in=0.7 + 0.56 * len(shown),
        draw=draw,
    )


def _label(name: str) -> str:
    return "mean of tasks" if name == "average" else words(*name.removesuffix(".-").split("."))


def _reach(gain: Measurement) -> float:
    """How far from zero the axis must reach [pp]."""
    ends = [abs(gain.value or 0.0)]
    if gain.interval is not None:
        ends += [abs(gain.interval.low), abs(gain.interval.high)]
    return min(105.0, max(20.0, 1.08 * max(ends)))


def _gain(axes: "Axes", gain: Measurement, y: float, side: str, marker: str, reach: float) -> None:
    colour = LIGHT["sim" if side == "sim" else "rec"]
    value = gain.value or 0.0
    if gain.interval is not None:
        ends = [gain.interval.low, gain.interval.high]
        axes.plot(ends, [y, y], color=colour, linewidth=1.6, solid_capstyle="butt", alpha=0.6)
    axes.plot([value], [y], marker=marker, color=colour, markersize=5)
    axes.text(1.1 * reach, y, f"{value:+.1f}", va="center", fontsize=7.5, clip_on=False)


MAX_GROUPS = len(MARKERS)
MAX_ROWS = 40
"""Groups drawn one below the other; a longer figure would not fit a page."""


def scatter(groups: Sequence[RateGroup], word: str) -> Drawing | NotDrawn:
    """Draw sim against recorded rates with both intervals and the identity line."""
    drawn = [group for group in groups if all(rate.value is not None for rate in group.pair)]
    if not drawn:
        return NotDrawn(id="scatter", reason="no group has both rates")
    series = list(dict.fromkeys((group.task, group.policy) for group in drawn))
    legend_rows = min(len(series), MAX_GROUPS) + (len(series) > MAX_GROUPS)
    below = 0.55 + 0.17 * (legend_rows + 1)
    side = COLUMN_IN - 0.62

    def draw(figure: "Figure") -> None:
        axes = framed(figure, (0.5, below, side, side))
        grid(axes)
        percent_axis(axes, "x", "success rate in the twin")
        percent_axis(axes, "y", f"{word} success rate")
        axes.plot([0, 100], [0, 100], color=LIGHT["soft"], linewidth=0.9, dashes=(4, 3), zorder=1)
        axes.text(
            *(13, 15), "equal", ha="left", va="bottom", rotation=45, rotation_mode="anchor",
            color=LIGHT["soft"], fontsize=7,
        )  # fmt: skip
        taken: dict[tuple[float, float], int] = {}
        for group in drawn:
            _point(axes, group, series.index((group.task, group.policy)), taken)
        _legend(axes, series, any(group.condition == WITH for group in drawn))

    return Drawing(
        id="scatter",
        title=f"Success in the twin against {word} success",
        caption="One mark per group (task, condition, policy), over the trials where both sides "
        "are known; bars are 95 % intervals of both rates. Below the dashed line the twin is "
        "optimistic. Marks that coincide are set apart.",
        alt=f"Scatter of {counted_groups(len(drawn))}: "
        + listed([f"{c.label}: twin {_text(c.pair[0])}, {word} {_text(c.pair[1])}" for c in drawn]),
        height_in=below + side + 0.12,
        draw=draw,
    )


def _point(
    axes: "Axes", group: RateGroup, place: int, taken: dict[tuple[float, float], int]
) -> None:
    sim, recorded = group.pair
    at = (100 * (sim.value or 0.0), 100 * (recorded.value or 0.0))
    nudge = 2.6 * taken.get(at, 0)
    taken[at] = taken.get(at, 0) + 1
    # Towards the middle, so that marks in a corner stay inside.
    x = at[0] - nudge if at[0] >= 50 else at[0] + nudge
    y = at[1] + nudge if at[1] <= 50 else at[1] - nudge
    style = {"color": LIGHT["ink"], "linewidth": 0.8, "alpha": 0.55, "zorder": 2}
    if sim.interval is not None:
        axes.plot([100 * sim.interval.low, 100 * sim.interval.high], [y, y], **style)  # type: ignore[arg-type]
    if recorded.interval is not None:
        ends = [100 * recorded.interval.low, 100 * recorded.interval.high]
        axes.plot([x, x], ends, **style)  # type: ignore[arg-type]
    axes.plot(
        [x], [y], linestyle="", marker=MARKERS[place % MAX_GROUPS], markersize=6,
        markerfacecolor=LIGHT["sim"] if group.condition == WITH else LIGHT["paper"],
        markeredgecolor=LIGHT["sim"], markeredgewidth=1.4, zorder=3,
    )  # fmt: skip


def _legend(axes: "Axes", series: Sequence[tuple[str, str]], conditions: bool) -> None:
    """List the series below the axes; long names have the whole width."""
    step = 0.17 / (COLUMN_IN - 0.62)
    y = -0.46 / (COLUMN_IN - 0.62)
    where: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False}
    for index, (task, policy) in enumerate(series[:MAX_GROUPS]):
        axes.plot(
            [0.02], [y + 0.01], linestyle="", marker=MARKERS[index], markersize=5,
            markerfacecolor=LIGHT["paper"], markeredgecolor=LIGHT["sim"], markeredgewidth=1.2,
            **where,
        )  # fmt: skip
        axes.text(0.06, y, words(task, policy), va="center", **where)
        y -= step
    notes = ["hollow: without replanning, solid: with"] if conditions else []
    if len(series) > MAX_GROUPS:
        notes.insert(0, f"{len(series)} series share {MAX_GROUPS} marks; the table names them")
    for note in notes:
        axes.text(0.0, y, note, va="center", color=LIGHT["soft"], **where)
        y -= step


def success(groups: Sequence[RateGroup], word: str) -> Drawing | NotDrawn:
    """Draw both rates of every group, one group below the other, with their intervals."""
    known = [
        group
        for group in groups
        if group.shown_sim.value is not None or group.recorded.value is not None
    ]
    if not known:
        return NotDrawn(id="success", reason="no group has a rate")
    shown = known[:MAX_ROWS]
    side = "planned" if any(group.executed is None for group in known) else "executed"
    row = 0.56

    def draw(figure: "Figure") -> None:
        axes = panel(figure, left=0.12, right=0.72, bottom=0.4, top=0.3)
        axes.spines["left"].set_visible(False)
        grid(axes, "x")
        percent_axis(axes, "x", "success rate")
        axes.set_ylim(len(shown), 0)
        axes.set_yticks([])
        for index, group in enumerate(shown):
            label = words(group.task, group.condition, group.policy)
            axes.text(-3, index + 0.22, label, va="center", fontsize=8, bbox=ON_PAPER)
            _rate(axes, group.shown_sim, index + 0.5, "sim", "o")
            _rate(axes, group.recorded, index + 0.76, "rec", "s")
        for x, name, marker, text in ((0, "sim", "o", "twin"), (24, "rec", "s", word)):
            axes.plot(
                [x], [-0.3], marker=marker, color=LIGHT[name], markersize=5, clip_on=False,
                linestyle="",
            )  # fmt: skip
            axes.text(x + 3, -0.3, text, va="center")

    more = len(known) - len(shown)
    rest = f" The first {MAX_ROWS} of {len(known)} groups; the table has all." if more else ""
    return Drawing(
        id="success",
        title=f"Success rates in the twin and {word}",
        caption=f"Circle: {side}-in-twin; square: as labelled. Bars are 95 % intervals; the counts "
        f"stand at the right.{rest}",
        alt=f"Rates of {counted_groups(len(known))}: "
        + listed(
            [f"{c.label}: twin {_text(c.shown_sim)}, {word} {_text(c.recorded)}" for c in known]
        ),
        height_in=0.7 + row * len(shown),
        draw=draw,
    )


def _rate(axes: "Axes", rate: Measurement, y: float, name: str, marker: str) -> None:
    colour = LIGHT[name]
    if rate.value is None:
        axes.text(0, y, "undefined", va="center", color=LIGHT["soft"], fontsize=7)
        return
    if rate.interval is not None:
        ends = [100 * rate.interval.low, 100 * rate.interval.high]
        axes.plot(ends, [y, y], color=colour, linewidth=1.6, solid_capstyle="butt", alpha=0.6)
    axes.plot([100 * rate.value], [y], marker=marker, color=colour, markersize=5)
    axes.text(108, y, _text(rate), va="center", fontsize=7.5, clip_on=False)


def _text(rate: Measurement) -> str:
    if rate.value is None:
        return "undefined"
    if rate.k is None or rate.n is None:
        return f"{100 * rate.value:.0f} %"
    return f"{rate.k}/{rate.n}"
