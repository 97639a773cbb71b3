"""One table as CSV, Markdown, LaTeX (booktabs) and terminal text."""

import csv
import io
import shutil

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from evaluator.report.wording import texts
from evaluator.result import Table

_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "–": "--",
}


def as_csv(table: Table) -> str:
    """Write comma-separated values; unknown is an empty field."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(["" if cell is None else cell for cell in row] for row in table.rows)
    return stream.getvalue()


def as_markdown(table: Table) -> str:
    """Write a Markdown table with its title and note."""
    lines = [f"**{table.title}**", "", _bar(table.columns), _bar(["---"] * len(table.columns))]
    lines += [_bar([text.replace("|", r"\|") for text in texts(row)]) for row in table.rows]
    return "\n".join(lines) + (f"\n\n{table.note}\n" if table.note else "\n")


def _bar(cells: tuple[str, ...] | list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def as_latex(table: Table) -> str:
    """Write a booktabs table; special characters are escaped."""
    columns = " & ".join(rf"\textbf{{{latex(name)}}}" for name in table.columns)
    body = [" & ".join(latex(text) for text in texts(row)) + r" \\" for row in table.rows]
    lines = [
        r"\begin{table}[h]",
        r"\centering",
        rf"\caption{{{latex(table.title)}. {latex(table.note)}}}",
        rf"\label{{tab:{table.id}}}",
        rf"\begin{{tabular}}{{@{{}}{'l' * len(table.columns)}@{{}}}}",
        r"\toprule",
        columns + r" \\",
        r"\midrule",
        *body,
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def latex(text: str) -> str:
    """Escape what LaTeX would read as a command."""
    return "".join(_LATEX.get(character, character) for character in text)


def as_text(table: Table, *, width: int | None = None) -> str:
    """Draw the table for a terminal, without the columns that are empty throughout."""
    drawn = RichTable(box=SIMPLE_HEAD, title=table.title, title_justify="left", padding=(0, 1))
    used = [
        index
        for index in range(len(table.columns))
        if any(row[index] not in ("", None) for row in table.rows)
    ]
    for index in used:
        drawn.add_column(Text(table.columns[index]), overflow="fold")
    for row in table.rows:
        drawn.add_row(*(Text(texts(row)[index]) for index in used))
    stream = io.StringIO()
    width = width or shutil.get_terminal_size(fallback=(140, 24)).columns
    Console(file=stream, width=width, no_color=True, highlight=False).print(drawn)
    text = "\n".join(line.rstrip() for line in stream.getvalue().splitlines())
    return f"{text.rstrip()}\n{table.note}\n" if table.note else f"{text.rstrip()}\n"
