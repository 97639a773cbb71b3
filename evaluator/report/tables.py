"""One table as CSV, as text for a terminal, and as LaTeX for a paper."""

import csv
import io
import re
import shutil
import textwrap
from functools import partial

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from evaluator.report.views import is_number, used_columns, view
from evaluator.report.wording import cell_text
from evaluator.result import Table


def as_csv(table: Table) -> str:
    """Write comma-separated values; unknown is an empty field."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(["" if cell is None else cell for cell in row] for row in table.rows)
    return stream.getvalue()


def as_text(table: Table, *, width: int | None = None) -> str:
    """Draw the table for a terminal, without the columns that are empty throughout.

    Lines break between words only. Columns that hold one value throughout are named once where the
    table is too wide, and rows become lists of their cells where it still is. Without ``width``
    the terminal says how many characters fit a line.
    """
    width = width or shutil.get_terminal_size(fallback=(80, 24)).columns
    shown = view(table)
    used = used_columns(shown)
    heads = [shown.columns[index] for index in used]
    together = partial(_TOGETHER.sub, lambda found: found[0].replace(" ", _NO_BREAK))
    rows = [[together(cell_text(row[index])) for index in used] for row in shown.rows]
    title = table.title
    whole = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    if len(rows) > 1 and _EDGE + _GAP * len(heads) + sum(whole) > width:
        same = [k for k in range(len(heads)) if len({row[k] for row in rows}) == 1]
        kept = [k for k in range(len(heads)) if k not in same]
        if same and kept:
            title += f" ({'; '.join(f'{heads[k]}: {rows[0][k]}' for k in same)})"
            heads, rows = [heads[k] for k in kept], [[row[k] for k in kept] for row in rows]
    widths = _widths(heads, rows, width)
    body = _listed(heads, rows, width) if widths is None else _drawn(heads, rows, widths)
    parts = [*_filled(title, width), *body]
    text = "\n".join(parts + (_filled(table.note, width) if table.note else [])) + "\n"
    return text.replace(_NO_BREAK, " ")


_NO_BREAK = "\ue000"
"""Stands for a space while lines are broken: rich breaks at every kind of space."""
_TOGETHER = re.compile(r"\[[^\]]*\]|[\d/]+ = [\d.]+ %|[+-]?[\d.]+ (%|pp|mm|°)")
"""An interval, a share, a number with its unit: each stays on one line."""
_EDGE, _GAP = 1, 3
"""Characters before the first column, and between two."""


def _widths(heads: list[str], rows: list[list[str]], width: int) -> list[int] | None:
    """Give each column its longest word and a share of what is left; None: not even that fits."""
    columns = list(zip(heads, *rows, strict=True))
    least = [max(map(len, " ".join(column).split()), default=0) for column in columns]
    whole = [max(map(len, column)) for column in columns]
    spare = width - _EDGE - _GAP * len(columns) - sum(least)
    if spare < 0:
        return None
    wanted = sum(whole) - sum(least)
    share = min(1.0, spare / wanted) if wanted else 0.0
    return [low + int(share * (high - low)) for low, high in zip(least, whole, strict=True)]


def _drawn(heads: list[str], rows: list[list[str]], widths: list[int]) -> list[str]:
    drawn = RichTable(box=SIMPLE_HEAD, padding=(0, 1))
    for head, column in zip(heads, widths, strict=True):
        drawn.add_column(Text(head), overflow="fold", width=column)
    for row in rows:
        drawn.add_row(*map(Text, row))
    stream = io.StringIO()
    width = _EDGE + _GAP * len(widths) + sum(widths)
    Console(file=stream, width=width, no_color=True, highlight=False).print(drawn)
    return [line.rstrip() for line in stream.getvalue().rstrip().splitlines()]


def _listed(heads: list[str], rows: list[list[str]], width: int) -> list[str]:
    """Write each row as its cells with their heads, one below the other."""
    lines: list[str] = []
    for row in rows:
        cells = [f"{head}: {text}" for head, text in zip(heads, row, strict=True) if text]
        lines += ["", *(line for cell in cells for line in _filled(cell, width, "  "))]
    return lines


def _filled(text: str, width: int, indent: str = "") -> list[str]:
    return textwrap.wrap(
        text,
        width,
        initial_indent=indent,
        subsequent_indent=2 * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


_SPECIAL = re.compile(r"([&%$#_{}])")


def as_latex(table: Table) -> str:
    r"""Write a table for a paper; the document needs ``\usepackage{booktabs}``."""
    import pandas as pd  # noqa: PLC0415  # takes a moment, and only this needs it

    shown = view(table)
    used = used_columns(shown)
    rows = [[cell_text(row[index]) for index in used] for row in shown.rows]
    text: str = pd.DataFrame(rows, columns=[shown.columns[index] for index in used]).to_latex(
        index=False,
        escape=True,
        column_format="".join("r" if is_number(shown, index) else "l" for index in used),
        caption=_SPECIAL.sub(r"\\\1", table.title),
        label=f"tab:{table.id}",
        position="t",
    )
    return text
