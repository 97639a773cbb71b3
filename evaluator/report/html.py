"""Pieces of the page: tables, numbers beside their intervals, figures with their data."""

import re
from collections.abc import Sequence
from html import escape

from evaluator.report.figures.drawing import Drawing
from evaluator.report.views import Figures, Shown, is_number, used_columns, view
from evaluator.report.wording import cell_text, count_text, ends_text, method_text, value_text
from evaluator.result import Measurement, Table

SHOWN_ROWS = 200
"""Rows of a table on the page; the whole table lies beside it as CSV."""
SHOWN_NUMBERS = 16
"""Numbers in one part; the list of all numbers has the others."""
OPEN_ROWS = 14
"""A longer table is folded away: it is looked things up in, not read."""
ALWAYS_OPEN = ("published", "success", "layout", "trials")


def table_html(
    table: Table,
    number: int,
    *,
    whole: str | None = None,
    shown_rows: int = SHOWN_ROWS,
    folded: bool | None = None,
) -> str:
    """Write a numbered table with its caption, its note, and where the whole of it lies.

    Args:
        table: Columns that are empty throughout are left out.
        number: Which table of the page it is.
        whole: File that holds every row, for the sentence below a table that was cut.
        shown_rows: How many rows the page holds at most.
        folded: Whether a click shows it; long tables are folded without it.
    """
    if folded is None:
        folded = len(table.rows) > OPEN_ROWS and table.id not in ALWAYS_OPEN
    notes = [table.note] if table.note else []
    if len(table.rows) > shown_rows:
        where = f"; the whole is in {whole}" if whole else ""
        notes.append(f"The first {shown_rows:,} of {len(table.rows):,} rows{where}.")
    note = f'<p class="note">{escape(" ".join(notes))}</p>' if notes else ""
    title = f"<b>Table {number}.</b> {escape(table.title)}"
    unseen = ' class="unseen"' if folded else ""
    box = (
        f'<div class="scroll" role="region" aria-label="Table {number}" tabindex="0"><table>'
        f"<caption{unseen}><span>{title}</span></caption>"
        f"{_grid(table, shown_rows)}</table></div>{note}"
    )
    if folded:
        count = f'<span class="soft">({len(table.rows):,} rows)</span>'
        box = f"<details><summary>{title} {count}</summary>{box}</details>"
    kind = "tablebox folded" if folded else "tablebox"
    return f'<div class="{kind}" id="table-{escape(table.id)}">{box}</div>'


def _grid(table: Table, rows: int) -> str:
    """Write head and body of a table; the first column names its rows unless it holds numbers."""
    shown = view(table)
    used = used_columns(shown)
    right = {i: is_number(shown, i) for i in used}
    head = "".join(
        f'<th scope="col"{_NUMBER * right[i]}>{escape(shown.columns[i])}</th>' for i in used
    )
    first = used[0] if used and not right[used[0]] else None
    body = "".join(
        f"<tr>{''.join(_td(row[i], i == first, right[i]) for i in used)}</tr>"
        for row in shown.rows[:rows]
    )
    return f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody>"


_NUMBER = ' class="number"'


def _td(cell: Shown, is_head: bool, right: bool) -> str:
    text = breakable(cell_text(cell))
    if is_head:
        return f'<th scope="row">{text}</th>'
    if cell is None and right:
        return '<td class="number soft">–</td>'
    if cell in ("success", "failure"):
        mark = "✓" if cell == "success" else "✗"
        return f'<td class="{cell}">{mark} {text}</td>'
    if isinstance(cell, int | float) and not isinstance(cell, bool):
        return f'<td class="number">{minus(text)}</td>'
    if isinstance(cell, Figures):
        return f'<td class="number">{_parts(cell)}</td>'
    return f"<td>{text}</td>"


def _parts(figures: Figures) -> str:
    counted = f'<span class="count">{escape(figures.count)}</span> ' if figures.count else ""
    interval = f' <span class="ends">[{minus(escape(figures.ends))}]</span>' if figures.ends else ""
    return f"{counted}<span>{minus(escape(figures.value))}</span>{interval}"


def breakable(text: str) -> str:
    """Escape text; a long name may break after an underscore."""
    return escape(text).replace("_", "_<wbr>")


def minus(text: str) -> str:
    """Write a minus as long as a plus is wide; hyphens inside words stay."""
    return re.sub(r"(?<![\w.])-(?=[\d.])", "−", text)


def numbers_html(numbers: Sequence[tuple[str, Measurement]], label: str) -> str:
    """Write numbers with interval, count and method in aligned columns; reasons are footnotes."""
    if not numbers:
        return ""
    shown = numbers[:SHOWN_NUMBERS]
    reasons: dict[str, str] = {}
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th>{_number_cells(measurement, reasons)}</tr>'
        for name, measurement in shown
    )
    notes = "".join(
        f"<li><sup>{mark}</sup> {escape(reason)}</li>" for reason, mark in reasons.items()
    )
    notes = f'<ul class="note">{notes}</ul>' if notes else ""
    more = len(numbers) - len(shown)
    if more > 0:
        link = '<a href="#numbers">every number</a>'
        notes += f'<p class="note">{more} more of this kind stand under {link}.</p>'
    return (
        f'<div class="tablebox"><div class="scroll" role="region" aria-label="{escape(label)}" '
        f'tabindex="0"><table class="numbers"><caption class="unseen">{escape(label)}</caption>'
        '<thead><tr><th scope="col">number</th><th scope="col" class="number">value</th>'
        '<th scope="col" class="number">interval</th><th scope="col" class="number">of</th>'
        f'<th scope="col">how</th></tr></thead><tbody>{rows}</tbody></table></div>{notes}</div>'
    )


def _number_cells(measurement: Measurement, reasons: dict[str, str]) -> str:
    count = f'<td class="number count">{escape(count_text(measurement))}</td>'
    if measurement.value is None:
        mark = _mark(measurement.reason_if_undefined, reasons)
        return (
            f'<td class="number soft">undefined{mark}</td><td class="number"></td>{count}'
            '<td class="how"></td>'
        )
    ends = minus(escape(ends_text(measurement)))
    how = escape(method_text(measurement))
    if not how and measurement.reason_without_interval:
        how = f"no interval{_mark(measurement.reason_without_interval, reasons)}"
    return (
        f'<td class="number"><b>{minus(escape(value_text(measurement)))}</b></td>'
        f'<td class="number ends">{ends}</td>{count}<td class="how">{how}</td>'
    )


def _mark(reason: str | None, reasons: dict[str, str]) -> str:
    """Return the footnote mark of a reason; equal reasons share one."""
    if not reason:
        return ""
    letter = reasons.setdefault(reason, chr(ord("a") + len(reasons)))
    return f" <sup>{letter}</sup>"


def figure_html(drawing: Drawing, inline: str | None, number: int) -> str:
    """Write a figure with caption, file names, and the numbers it was drawn from."""
    picture = inline or '<p class="soft">Not drawn; the numbers are below.</p>'
    files = f"figures/{drawing.id}.csv"
    if inline is not None:
        files = f"figures/{drawing.id}.svg, .pdf and .csv"
    table = drawing.table
    cut = ""
    if len(table.rows) > SHOWN_ROWS:
        cut = f'<p class="note">The first {SHOWN_ROWS} of {len(table.rows):,} rows.</p>'
    return (
        f'<figure id="figure-{escape(drawing.id)}">{picture}'
        f"<figcaption><b>Figure {number}.</b> <strong>{escape(_ended(drawing.title))}</strong> "
        f"{escape(drawing.caption)}</figcaption>"
        f"<details><summary>Numbers of figure {number}</summary>"
        f'<div class="scroll" role="region" aria-label="Numbers of figure {number}" tabindex="0">'
        f'<table><caption class="unseen">Numbers of figure {number}: {escape(drawing.title)}'
        f"</caption>{_grid(table, SHOWN_ROWS)}</table></div>{cut}"
        f'<p class="note">Files: {escape(files)}</p></details></figure>'
    )


def _ended(sentence: str) -> str:
    return sentence if sentence.endswith("?") else f"{sentence}."
