"""Where trials are lost: the funnel of stages, one block per task and condition."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from evaluator.report.figures.drawing import LIGHT, Drawing, NotDrawn, grid, listed, panel, words
from evaluator.result import Cell, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_LINES = 60
Row = tuple[Cell, ...]


def funnel(tables: Sequence[Table]) -> Drawing | NotDrawn:
    """Draw how many trials reached and passed each stage."""
    table = next((table for table in tables if table.id == "funnel"), None)
    if table is None or not table.rows:
        return NotDrawn(id="funnel", reason="no trial has labelled stages")
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in table.rows:
        groups.setdefault((str(row[0]), str(row[1])), []).append(row)
    shown: list[tuple[tuple[str, str], list[Row]]] = []
    for key, rows in groups.items():
        if shown and sum(len(rows) + 1 for _, rows in shown) + len(rows) + 1 > MAX_LINES:
            break
        shown.append((key, rows))
    lines = sum(len(rows) + 1 for _, rows in shown)
    most = max(int(str(row[3] or 0)) for _, rows in shown for row in rows)

    def draw(figure: "Figure") -> None:
        axes = panel(figure, left=1.0, right=0.7, bottom=0.4, top=0.05)
        axes.spines["left"].set_visible(False)
        grid(axes, "x")
        axes.set_xlim(0, max(most, 1))
        axes.set_ylim(lines, 0)
        axes.set_yticks([])
        axes.locator_params(axis="x", integer=True, nbins=5)
        axes.set_xlabel("trials")
        y = 0.0
        for (task, condition), rows in shown:
            axes.text(
                -0.92 / 1.8 * max(most, 1), y + 0.6, words(task, condition), va="center",
                fontsize=8,
            )  # fmt: skip
            y += 1
            for row in rows:
                _bar(axes, row, y, max(most, 1))
                y += 1

    rest = "" if len(shown) == len(groups) else f" The first {len(shown)} of {len(groups)} groups."
    return Drawing(
        id="funnel",
        title="Stage funnel",
        caption="Pale: trials that reached a stage, every earlier one having succeeded; solid: "
        f"those that passed it. Counts: passed / reached.{rest}",
        alt="Passed of reached: "
        + listed(
            [f"{words(*map(str, row[:3]))}: {row[4]} of {row[3]}" for row in table.rows], at_most=12
        ),
        table=Table(id="figure_funnel", title="", columns=table.columns, rows=table.rows),
        height_in=0.5 + 0.2 * lines,
        draw=draw,
    )


def _bar(axes: "Axes", row: Row, y: float, most: int) -> None:
    reached, passed = (int(str(value or 0)) for value in row[3:5])
    middle = y + 0.5
    colour = LIGHT["sim"]
    axes.barh(middle, reached, height=0.62, color=colour, alpha=0.25, linewidth=0)
    axes.barh(middle, passed, height=0.62, color=colour, alpha=0.85, linewidth=0)
    name = str(row[2]).replace("_", " ")
    name = name if len(name) <= 19 else f"{name[:18]}…"
    axes.text(-0.03 * most, middle, name, ha="right", va="center", fontsize=7.5)
    text = f"{passed}/{reached}"
    if row[5]:
        text += f" ({row[5]} unknown)"
    axes.text(1.04 * most, middle, text, va="center", fontsize=7.5, clip_on=False)
