"""The gate: its price and its probabilities."""

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
from evaluator.result import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
            price, [row[2] for row in rows], "s--", color=LIGHT["rec"], label="execute everything"
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
        height_in=2.6,
        draw=draw,
    )
