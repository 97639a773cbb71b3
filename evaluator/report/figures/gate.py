"""The gate: counts of what it said and what happened, its price, its probabilities."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from evaluator.compare.plot_data import ReliabilityPoint
from evaluator.report.figures.drawing import (
    COLUMN_IN,
    LIGHT,
    Drawing,
    NotDrawn,
    framed,
    grid,
    legend,
    listed,
    panel,
    percent_axis,
)
from evaluator.result import Cell, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_MATRICES = 6
STRONGEST = 0.42
"""Opacity of the fullest field: numbers stay readable on it, light and dark."""


def confusion(tables: Sequence[Table], word: str) -> Drawing | NotDrawn:
    """Draw a two by two field of counts for each way the twin was asked.

    Args:
        tables: Tables of the evaluation; the one called ``confusion`` is drawn.
        word: What the recorded side is called: stand-in, real or recorded.
    """
    table = next((table for table in tables if table.id == "confusion"), None)
    asked = [row for row in (() if table is None else table.rows) if row[5]][:MAX_MATRICES]
    if not asked:
        return NotDrawn(id="confusion", reason="no trial has an answer of the twin and an outcome")
    side, rows = 1.06, (len(asked) + 1) // 2
    height = 0.1 + rows * 1.78

    def draw(figure: "Figure") -> None:
        for index, row in enumerate(asked):
            left = 0.5 + (index % 2) * 1.72
            bottom = height - 0.42 - side - (index // 2) * 1.78
            axes = framed(figure, (left, bottom, side, side))
            _matrix(axes, row, word)

    return Drawing(
        id="confusion",
        title="Prediction of the twin against the outcome",
        caption="Trials with a known outcome. Diagonal from the upper left: the twin was right. "
        "Executed-in-twin is diagnosis only. Refused plans are not executed with replanning, so "
        "an obeyed verdict cannot show its false refusals.",
        alt="Counts of trials: "
        + listed(
            [
                f"{row[0]}: both success {row[1]}, only the twin {row[2]}, only {word} {row[3]}, "
                f"neither {row[4]}"
                for row in asked
            ]
        ),
        table=Table(
            id="figure_confusion",
            title="",
            columns=() if table is None else table.columns,
            rows=tuple(asked),
        ),
        height_in=height,
        draw=draw,
    )


def _matrix(axes: "Axes", row: Sequence[Cell], word: str) -> None:
    both, only_twin, only_real, neither = (int(str(value or 0)) for value in row[1:5])
    total = max(both + only_twin + only_real + neither, 1)
    axes.set_xlim(0, 2)
    axes.set_ylim(2, 0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    for (x, y), count, right in (
        ((0, 0), both, True),
        ((1, 0), only_twin, False),
        ((0, 1), only_real, False),
        ((1, 1), neither, True),
    ):
        colour = LIGHT["sim" if right else "rec"]
        opacity = STRONGEST * count / total
        axes.fill(
            [x, x + 1, x + 1, x], [y, y, y + 1, y + 1], color=colour, alpha=opacity, linewidth=0
        )
        axes.plot(
            [x, x + 1, x + 1, x, x], [y, y, y + 1, y + 1, y], color=LIGHT["line"], linewidth=0.8
        )
        axes.text(x + 0.5, y + 0.53, str(count), ha="center", va="center", fontsize=10)
    axes.set_xticks([0.5, 1.5], ["success", "failure"])
    axes.set_yticks([0.5, 1.5], ["success", "failure"], rotation=90, va="center")
    axes.tick_params(length=0, pad=2, labelsize=7)
    axes.set_xlabel(word, labelpad=1, fontsize=7.5)
    axes.set_ylabel("twin predicted", labelpad=2, fontsize=7.5)
    axes.set_title(str(row[0]).replace(" (", "\n("), fontsize=7.5, pad=4, color=LIGHT["ink"])


def reliability(bins: Sequence[ReliabilityPoint]) -> Drawing | NotDrawn:
    """Draw how often trials succeeded against the probability that was stated for them."""
    if not bins:
        return NotDrawn(id="reliability", reason="no trial has p_success and an outcome")
    side = COLUMN_IN - 0.62

    def draw(figure: "Figure") -> None:
        axes = framed(figure, (0.5, 1.02, side, side))
        grid(axes)
        percent_axis(axes, "y", "trials that succeeded")
        axes.set_xlim(-3, 103)
        axes.set_xticks(range(0, 101, 20), [""] * 6)
        axes.plot([0, 100], [0, 100], color=LIGHT["soft"], linewidth=0.9, dashes=(4, 3))
        for b in bins:
            if b.rate_low is not None and b.rate_high is not None:
                axes.plot(
                    [100 * b.mean_probability] * 2, [100 * b.rate_low, 100 * b.rate_high],
                    color=LIGHT["sim"], linewidth=1.4, alpha=0.6,
                )  # fmt: skip
            axes.plot(
                [100 * b.mean_probability], [100 * b.rate], "o", color=LIGHT["sim"], markersize=5
            )
        counts = framed(figure, (0.5, 0.42, side, 0.5))
        counts.bar(
            [50 * (b.low + b.high) for b in bins], [b.n for b in bins], width=9.2,
            color=LIGHT["sim"], alpha=0.45, linewidth=0,
        )  # fmt: skip
        percent_axis(counts, "x", "stated probability of success")
        most = max(b.n for b in bins)
        counts.set_ylim(0, 1.15 * most)
        counts.set_yticks([0, most])
        counts.set_ylabel("trials")

    return Drawing(
        id="reliability",
        title="Is the stated success probability kept?",
        caption="Bins of equal width with 95 % Wilson intervals; below: trials per bin. On the "
        "dashed line a probability is kept; below it the twin promises too much.",
        alt="Bins of the stated probability: "
        + listed(
            [
                f"mean {100 * b.mean_probability:.0f} %, {b.succeeded} of {b.n} succeeded"
                for b in bins
            ],
            at_most=10,
        ),
        table=Table(
            id="figure_reliability",
            title="",
            columns=(
                *("bin from (%)", "to", "mean probability (%)", "succeeded", "trials"),
                *("rate (%)", "low", "high"),
            ),
            rows=tuple(
                (
                    round(100 * b.low),
                    round(100 * b.high),
                    round(100 * b.mean_probability, 1),
                    b.succeeded,
                    b.n,
                    round(100 * b.rate, 1),
                    None if b.rate_low is None else round(100 * b.rate_low, 1),
                    None if b.rate_high is None else round(100 * b.rate_high, 1),
                )
                for b in bins
            ),
        ),
        height_in=1.02 + side + 0.12,
        draw=draw,
    )


def costs(tables: Sequence[Table]) -> Drawing | NotDrawn:
    """Draw what a trial costs with and without the gate, by the price of a refused good plan."""
    table = next((table for table in tables if table.id == "gate_costs"), None)
    if table is None or not table.rows:
        return NotDrawn(id="costs", reason="no executed trial has an advisory verdict")
    rows = [tuple(float(str(value)) for value in row[:3]) for row in table.rows]

    def draw(figure: "Figure") -> None:
        axes = panel(figure, left=0.5, bottom=0.4, top=0.36)
        grid(axes)
        price = [row[0] for row in rows]
        axes.plot(price, [row[1] for row in rows], "o-", color=LIGHT["sim"], label="obey the gate")
        axes.plot(
            price, [row[2] for row in rows], "s--", color=LIGHT["third"], label="execute everything"
        )
        axes.set_xlabel("price of refusing a good plan (bad executions)")
        axes.set_ylabel("cost per trial (bad executions)")
        axes.set_ylim(bottom=0)
        legend(axes)

    return Drawing(
        id="costs",
        title="What the gate costs and avoids",
        caption=f"Where the circles lie lower, obeying the gate pays. {table.note}",
        alt="Mean cost per trial, obeying the gate against executing everything: "
        + listed([f"at price {row[0]:g}: {row[1]:.3g} against {row[2]:.3g}" for row in rows]),
        table=Table(id="figure_costs", title="", columns=table.columns[:3], rows=tuple(rows)),
        height_in=2.6,
        draw=draw,
    )
