"""Success over a session: does the cell change while it is recorded?"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from evaluator.report.figures.drawing import (
    LIGHT,
    MARKERS,
    Drawing,
    NotDrawn,
    grid,
    legend,
    listed,
    panel,
    percent_axis,
)
from evaluator.result import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("rec", "sim", "ink")
"""Of the conditions, in turn."""


def session_order(tables: Sequence[Table]) -> Drawing | NotDrawn:
    """Draw the success rate of each part of a session, by condition.

    Args:
        tables: Tables of the evaluation; the one called ``session_order`` is drawn.
    """
    table = next((table for table in tables if table.id == "session_order"), None)
    if table is None:
        return NotDrawn(id="order", reason="fewer than 8 trials have a known outcome")
    rows = [row for row in table.rows if row[5] is not None]
    conditions = list(dict.fromkeys(str(row[2]) for row in rows))

    def draw(figure: "Figure") -> None:
        axes = panel(figure, left=0.5, bottom=0.4, top=0.36)
        grid(axes)
        for number, condition in enumerate(conditions):
            mine = [row for row in rows if row[2] == condition]
            aside = 0.4 * (number - (len(conditions) - 1) / 2)  # intervals do not cover each other
            middle = [(float(str(row[0])) + float(str(row[1]))) / 2 + aside for row in mine]
            rate = [100 * float(str(row[5])) for row in mine]
            colour = LIGHT[COLOURS[number % len(COLOURS)]]
            for x, row in zip(middle, mine, strict=True):
                if row[6] is not None and row[7] is not None:
                    ends = [100 * float(str(row[6])), 100 * float(str(row[7]))]
                    axes.plot([x, x], ends, color=colour, alpha=0.4, linewidth=1.0)
            marker = MARKERS[number % len(MARKERS)]
            axes.plot(middle, rate, f"{marker}-", color=colour, label=condition or "all trials")
        percent_axis(axes, "y", "success")
        axes.set_xlabel("trial, in the order of recording")
        legend(axes)

    return Drawing(
        id="order",
        title="Success by the order of the trials",
        caption="Success rate of equal parts of the session, with 95 % Wilson intervals. A cell "
        "that wears, warms up or is put right during a session shows as a trend.",
        alt="Success by part of the session: "
        + listed(
            [f"trials {row[0]} to {row[1]}, {row[2]}: {row[3]} of {row[4]}" for row in rows],
            at_most=10,
        ),
        table=Table(id="figure_order", title="", columns=table.columns, rows=tuple(rows)),
        height_in=2.4,
        draw=draw,
    )
