"""What replanning gained, per task and side, in percentage points."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from evaluator.report.figures.drawing import (
    LIGHT,
    ON_PAPER,
    Drawing,
    NotDrawn,
    grid,
    listed,
    panel,
    words,
)
from evaluator.result import Measurement, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_ROWS = 40


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
        table=Table(
            id="figure_gains",
            title="",
            columns=("task", "side", "gain (pp)", "low", "high", "why no interval"),
            rows=tuple(
                (
                    _label(name),
                    word if side == "recorded" else "twin",
                    round(m.value or 0.0, 2),
                    None if m.interval is None else round(m.interval.low, 2),
                    None if m.interval is None else round(m.interval.high, 2),
                    m.reason_without_interval,
                )
                for name, side, m in lines
            ),
        ),
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
