"""Small multiples, one panel for each task: does the twin order what can be chosen inside it?"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from evaluator.compare.rows import RateGroup
from evaluator.report.figures.drawing import (
    COLUMN_IN,
    LIGHT,
    MARKERS,
    Drawing,
    NotDrawn,
    framed,
    grid,
    listed,
    words,
)
from evaluator.statistics.agreement import counted_groups

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PANELS = 12
ACROSS = 3
SIDE_IN = (COLUMN_IN - 0.55 - 0.16 * (ACROSS - 1)) / ACROSS
ABOVE_IN, BELOW_IN, STEP_IN = 0.2, 0.42, 0.17
LONGEST_BESIDE = 24
"""Characters of a name that has room beside another in the legend."""
LONGEST_TITLE = 18


def tasks(groups: Sequence[RateGroup], word: str) -> Drawing | NotDrawn:
    """Draw sim against recorded rates, a panel for each task, its candidates joined by rank.

    Args:
        groups: Success rates per task, condition and policy; only those with both rates are drawn.
    """
    by_task: dict[str, list[RateGroup]] = {}
    for group in groups:
        if all(rate.value is not None for rate in group.pair):
            by_task.setdefault(group.task, []).append(group)
    chosen = {task: members for task, members in by_task.items() if len(members) > 1}
    if len(chosen) < 2:
        reason = "fewer than two tasks have several conditions or policies"
        return NotDrawn(id="tasks", reason=reason)
    shown = dict(list(chosen.items())[:MAX_PANELS])
    candidates = list(dict.fromkeys(_candidate(g) for members in shown.values() for g in members))
    rows = math.ceil(len(shown) / ACROSS)
    across = 1 if any(len(name) > LONGEST_BESIDE for name in candidates) else 2
    legend_lines = math.ceil(min(len(candidates), len(MARKERS)) / across)
    legend_lines += len(candidates) > len(MARKERS)
    foot_in = BELOW_IN + STEP_IN * legend_lines
    height_in = foot_in + rows * (SIDE_IN + ABOVE_IN) + 0.05

    def draw(figure: "Figure") -> None:
        for place, (task, members) in enumerate(shown.items()):
            column, row = place % ACROSS, rows - 1 - place // ACROSS
            left = 0.47 + column * (SIDE_IN + 0.16)
            bottom = foot_in + row * (SIDE_IN + ABOVE_IN)
            axes = framed(figure, (left, bottom, SIDE_IN, SIDE_IN))
            _panel(axes, task, members, candidates)
            axes.tick_params(labelleft=column == 0, labelbottom=place + ACROSS >= len(shown))
        figure.text(0.5, (foot_in - 0.36) / height_in, "success rate in the twin (%)", ha="center")
        figure.text(0.012, 0.5 + foot_in / height_in / 2, f"{word} (%)", va="center", rotation=90)
        _legend(figure, candidates, across, (foot_in - 0.42, height_in))

    more = f" The first {MAX_PANELS} of {len(chosen)} tasks." if len(chosen) > MAX_PANELS else ""
    drawn = [group for members in shown.values() for group in members]
    return Drawing(
        id="tasks",
        title=f"Success in the twin against {word} success, task by task",
        caption="One panel per task, one mark per policy or condition; bars are 95 % intervals of "
        "both rates. The line joins a task's marks by their rate in the twin: where it rises the "
        "twin orders them as they were recorded, where it falls it does not. Below the dashed "
        f"line the twin is optimistic.{more}",
        alt=f"{len(shown)} panels with {counted_groups(len(drawn))}: "
        + listed([f"{group.label}: {_rates(group)}" for group in drawn]),
        height_in=height_in,
        draw=draw,
    )


def _candidate(group: RateGroup) -> str:
    return words(group.condition, group.policy)


def _rates(group: RateGroup) -> str:
    sim, recorded = (100 * (rate.value or 0.0) for rate in group.pair)
    return f"twin {sim:.0f} %, recorded {recorded:.0f} %"


def _panel(
    axes: "Axes", task: str, members: Sequence[RateGroup], candidates: Sequence[str]
) -> None:
    grid(axes)
    for which in ("x", "y"):
        getattr(axes, f"set_{which}lim")(-6, 106)
        getattr(axes, f"set_{which}ticks")((0, 50, 100))
    title = words(task)
    title = title if len(title) <= LONGEST_TITLE else title[: LONGEST_TITLE - 2] + ".."
    axes.set_title(title, fontsize=6.5, pad=2.5, loc="left")
    axes.plot([0, 100], [0, 100], color=LIGHT["soft"], linewidth=0.8, dashes=(4, 3), zorder=1)
    points = sorted(members, key=lambda group: [rate.value or 0.0 for rate in group.pair])
    course = [tuple(100 * (rate.value or 0.0) for rate in group.pair) for group in points]
    axes.plot(*zip(*course, strict=True), color=LIGHT["sim"], linewidth=0.9, alpha=0.5, zorder=2)
    for group, (x, y) in zip(points, course, strict=True):
        for rate, fixed, is_x in ((group.pair[0], y, True), (group.pair[1], x, False)):
            if rate.interval is not None:
                span = [100 * rate.interval.low, 100 * rate.interval.high]
                line = (span, [fixed, fixed]) if is_x else ([fixed, fixed], span)
                axes.plot(*line, color=LIGHT["ink"], linewidth=0.6, alpha=0.4, zorder=1.5)
        axes.plot(
            [x], [y], linestyle="", marker=MARKERS[candidates.index(_candidate(group)) % 8],
            markersize=4.5, markerfacecolor=LIGHT["paper"], markeredgecolor=LIGHT["sim"],
            markeredgewidth=1.1, zorder=3,
        )  # fmt: skip


def _legend(
    figure: "Figure", candidates: Sequence[str], across: int, size_in: tuple[float, float]
) -> None:
    """Name the marks below the panels, so many beside each other."""
    top_in, height_in = size_in
    axes = figure.add_axes((0.0, 0.0, 1.0, top_in / height_in))
    axes.set_axis_off()
    axes.set_xlim(0, 2)
    axes.set_ylim(top_in, 0)
    for place, name in enumerate(candidates[: len(MARKERS)]):
        x, y = 0.27 + place % across, STEP_IN * (place // across + 0.5)
        axes.plot(
            [x], [y], linestyle="", marker=MARKERS[place], markersize=4.5,
            markerfacecolor=LIGHT["paper"], markeredgecolor=LIGHT["sim"], markeredgewidth=1.1,
        )  # fmt: skip
        axes.text(x + 0.06, y, name, va="center", fontsize=7)
    if len(candidates) > len(MARKERS):
        note = f"{len(candidates)} candidates share {len(MARKERS)} marks; the table names them"
        axes.text(0.25, top_in - 0.6 * STEP_IN, note, color=LIGHT["soft"], va="center", fontsize=7)
