"""One table as CSV, Markdown and terminal text; ``latex`` writes the same for a paper."""

import csv
import io
import shutil
from functools import lru_cache

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from evaluator.report.wording import cell_text, texts
from evaluator.result import Cell, Table


def used_columns(table: Table) -> list[int]:
    """Return the columns that say something in any row."""
    return [
        index
        for index in range(len(table.columns))
        if not table.rows or any(row[index] not in ("", None) for row in table.rows)
    ]


def is_number(table: Table, index: int) -> bool:
    """Say whether a column holds nothing but numbers."""
    cells = [row[index] for row in table.rows if row[index] is not None]
    return bool(cells) and all(
        isinstance(cell, int | float) and not isinstance(cell, bool) for cell in cells
    )


def as_csv(table: Table) -> str:
    """Write comma-separated values; unknown is an empty field."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(["" if cell is None else cell for cell in row] for row in table.rows)
    return stream.getvalue()


def as_markdown(table: Table) -> str:
    """Write a Markdown table with its title and note."""
    written = lru_cache(maxsize=None, typed=True)(_markdown_cell)
    heads = [written(name) for name in table.columns]
    lines = [f"**{table.title}**", "", _bar(heads), _bar(["---"] * len(heads))]
    lines += [_bar([written(cell) for cell in row]) for row in table.rows]
    return "\n".join(lines) + (f"\n\n{table.note}\n" if table.note else "\n")


def _markdown_cell(cell: Cell) -> str:
    return " ".join(cell_text(cell).split()).replace("|", r"\|")  # a row is one line


def _bar(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def as_text(table: Table, *, width: int | None = None) -> str:
    """Draw the table for a terminal, without the columns that are empty throughout."""
    drawn = RichTable(box=SIMPLE_HEAD, title=table.title, title_justify="left", padding=(0, 1))
    used = used_columns(table)
    for index in used:
        drawn.add_column(Text(table.columns[index]), overflow="fold")
    for row in table.rows:
        drawn.add_row(*(Text(texts(row)[index]) for index in used))
    stream = io.StringIO()
    width = width or shutil.get_terminal_size(fallback=(140, 24)).columns
    Console(file=stream, width=width, no_color=True, highlight=False).print(drawn)
    text = "\n".join(line.rstrip() for line in stream.getvalue().splitlines())
    return f"{text.rstrip()}\n{table.note}\n" if table.note else f"{text.rstrip()}\n"
