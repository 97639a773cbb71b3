"""One table as CSV, Markdown and terminal text; ``latex`` writes the same for a paper."""

import csv
import io
import re
import shutil
import textwrap
from functools import lru_cache

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from evaluator.compare.tables import AVERAGES, MEAN_OF_TASKS, METHOD_NAMES
from evaluator.report.views import Shown, View, is_number, used_columns, view
from evaluator.report.wording import cell_text
from evaluator.result import Table


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
    shown = view(table)
    heads = [written(name) for name in shown.columns]
    lines = [f"**{table.title}**", "", _bar(heads), _bar(["---"] * len(heads))]
    lines += [_bar([written(cell) for cell in row]) for row in shown.rows]
    return "\n".join(lines) + (f"\n\n{table.note}\n" if table.note else "\n")


def _markdown_cell(cell: Shown) -> str:
    return " ".join(cell_text(cell).split()).replace("|", r"\|")  # a row is one line


def _bar(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def as_text(table: Table, *, width: int | None = None) -> str:
    """Draw the table for a terminal, without the columns that are empty throughout.

    Lines break between words only. Columns that hold one value throughout are named once where the
    table is too wide, and rows become lists of their cells where it still is.

    Args:
        table: Any table of the evaluation.
        width: Characters in a line; None asks the terminal.
    """
    width = width or shutil.get_terminal_size(fallback=(80, 24)).columns
    shown = view(table)
    used = used_columns(shown)
    heads = [shown.columns[index] for index in used]
    rows = [[_kept_together(cell_text(row[index])) for index in used] for row in shown.rows]
    title = table.title
    if len(rows) > 1 and _whole_width(heads, rows) > width:
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


def _kept_together(text: str) -> str:
    return _TOGETHER.sub(lambda found: found[0].replace(" ", _NO_BREAK), text)


_EDGE, _GAP = 1, 3
"""Characters before the first column, and between two."""


def _whole_width(heads: list[str], rows: list[list[str]]) -> int:
    columns = zip(heads, *rows, strict=True)
    return _EDGE + sum(_GAP + max(map(len, column)) for column in columns)


def _widths(heads: list[str], rows: list[list[str]], width: int) -> list[int] | None:
    """Give each column its longest word and a share of what is left; None: not even that fits."""
    columns = list(zip(heads, *rows, strict=True))
    least = [
        max(len(word) for text in column for word in text.split() or [""]) for column in columns
    ]
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


_COMMANDS = {
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
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"{''}",
    "`": r"{`}",
    # A bracket or star after the end of a line would be read as that line's argument.
    "[": "{[}",
    "]": "{]}",
    "*": "{*}",
    "–": "--",
    "—": "---",
    "−": "$-$",
    "±": r"$\pm$",
    "×": r"$\times$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "≠": r"$\neq$",
    "→": r"$\rightarrow$",
    "°": r"$^\circ$",
    "…": r"\ldots{}",
    "’": "'",
    "‘": "`",
    "«": r"$\ll$",
    "»": r"$\gg$",
    "“": "``",
    "”": "''",
    "τ": r"$\tau$",
    "ρ": r"$\rho$",
    "φ": r"$\phi$",
    "λ": r"$\lambda$",
    "µ": r"$\mu$",
    "✓": "yes",
    "✗": "no",
    "\u2060": "{}",
}
_TRANSLATION = str.maketrans(_COMMANDS)
_NOT_SET = re.compile("[^\x20-\x7e\xa1-\u017f]|[ÐÞðþĄąĘęĮįŲųĐđĦħĸĿŀŉŊŋŦŧſ]")
"""What LaTeX since 2020 does not set in its default font encoding is written as U+XXXX; of the
letters up to U+017F that are those named here."""
_NAME = re.compile(r"[^A-Za-z0-9:.-]+")
_MINUS = re.compile(r"(?<![\w.-])-(?=\.?\d)")
_HYPHENS = re.compile("-(?=-)")
"""Two would become a dash: ``--goal``."""


def as_latex(table: Table) -> str:
    r"""Write a booktabs table: numbers to the right, no empty columns, the note below.

    The document needs ``\usepackage{booktabs,threeparttable}``; a table wider than the page also
    ``graphicx``, which shrinks it to the width of the text, and one longer than a page
    ``longtable``, which is set in a smaller size where it is wide. One wider than a column of a
    two-column article spans both (``table*``). Sentences are broken over lines; the caption is
    made from the content.
    """
    shown = view(table)
    used = used_columns(shown)
    align, characters = _columns(shown, used)
    head = " & ".join(latex(shown.columns[index]) for index in used)
    written = lru_cache(maxsize=None, typed=True)(_cell)  # tables say the same again and again
    body = [" & ".join([written(row[i]) for i in used]) + r" \\" for row in shown.rows]
    columns = f"@{{}}{align}@{{}}"
    caption = rf"\caption{{{latex(caption_of(table))}}}"
    label = rf"\label{{tab:{_NAME.sub('-', table.id)}}}"
    note = [rf"\par\smallskip\footnotesize {latex(table.note)}"] if table.note else []
    if len(body) > LONG_ROWS:
        lines = [
            rf"{{{_fitting(characters)}",
            rf"\begin{{longtable}}{{{columns}}}",
            rf"{caption}{label} \\",
            *(r"\toprule", rf"{head} \\", r"\midrule", r"\endhead", r"\bottomrule", r"\endfoot"),
            *body,
            r"\end{longtable}",
            *note,
            "}",
        ]
        return "\n".join(lines) + "\n"
    tabular = [
        rf"\begin{{tabular}}{{{columns}}}",
        *(r"\toprule", rf"{head} \\", r"\midrule"),
        *body,
        *(r"\bottomrule", r"\end{tabular}"),
    ]
    if characters > WIDE_CHARACTERS:
        tabular = [r"\resizebox{\textwidth}{!}{%", *tabular, "}", *note]
    elif table.note:
        notes = [r"\begin{tablenotes}", rf"\footnotesize\item {latex(table.note)}"]
        tabular = [*tabular, *notes, r"\end{tablenotes}"]
        tabular = [r"\begin{threeparttable}", caption, label, *tabular, r"\end{threeparttable}"]
        caption = label = ""
    kind = "table*" if characters > COLUMN_CHARACTERS else "table"
    lines = [
        *(rf"\begin{{{kind}}}[t]", r"\centering", caption, label, r"\small"),
        *tabular,
        rf"\end{{{kind}}}",
    ]
    return "\n".join(filter(None, lines)) + "\n"


NO_NAMES = {"", None, MEAN_OF_TASKS, *AVERAGES.values()}
"""What stands in a column of names and names nothing."""


def caption_of(table: Table) -> str:
    """Return a caption that can stand alone: the title, over what, and which intervals.

    Args:
        table: Any table of the evaluation.
    """
    counts = []
    for name, many in (("task", "tasks"), ("policy", "policies"), ("condition", "conditions")):
        if name in table.columns:
            values = {row[table.columns.index(name)] for row in table.rows} - NO_NAMES
            count = f"{len(values)} {many}"
            if len(values) > 1 and count not in table.title:
                counts.append(count)
    over = f" over {' and '.join(counts)}" if counts else ""
    methods = [
        str(row[place])
        for place, name in enumerate(table.columns)
        if name in ("interval", "method", "agree interval")
        for row in table.rows
        if row[place]
    ]
    named = [METHOD_NAMES.get(name, name) for name in dict.fromkeys(methods)]
    brackets = f" Brackets: 95 % intervals ({', '.join(named)})." if named else ""
    title = table.title.rstrip(".")
    ending = "" if title.endswith("?") and not over else "."
    return f"{title}{over}{ending}{brackets}"


COLUMN_CHARACTERS = 44
"""A line of text in a column of a two-column article, in the small size of tables."""
LONG_ROWS = 45
"""A table with more rows does not fit one page and is set over several (``longtable``)."""


WIDE_CHARACTERS = 84
"""A line of text in a usual article, in the small size of tables."""


SENTENCE = 45
"""Text longer than this is broken over lines, where it can be."""
SENTENCES = 0.6
"""Share of the width of the text that such columns have together."""
LONGEST_WORD = 20


def _columns(table: View, used: list[int]) -> tuple[str, float]:
    """Return how columns are set, and how many characters lie beside each other."""
    lines = [table.columns, *([cell_text(cell) for cell in row] for row in table.rows)]
    longest = {index: max(len(line[index]) for line in lines) for index in used}
    sentences = {
        index
        for index in used
        if longest[index] > SENTENCE
        and all(len(word) <= LONGEST_WORD for line in lines for word in line[index].split())
    }
    share = SENTENCES / max(1, len(sentences))
    align, characters = "", 0.0
    for index in used:
        if index in sentences:
            align += rf"p{{{share:.2f}\textwidth}}"
            characters += share * WIDE_CHARACTERS + 2
        else:
            align += "r" if is_number(table, index) else "l"
            characters += longest[index] + 2
    return align, characters


def _fitting(characters: float) -> str:
    """Return the size in which a table of several pages, which cannot be shrunk, is as wide."""
    if characters <= WIDE_CHARACTERS:
        return r"\small"
    size = "scriptsize" if characters <= 1.2 * WIDE_CHARACTERS else "tiny"
    return rf"\{size}\setlength{{\tabcolsep}}{{2pt}}"


def _cell(cell: Shown) -> str:
    return latex(cell_text(cell))


def latex(text: str) -> str:
    """Escape what LaTeX would read as a command, and write what it cannot set as U+XXXX.

    A minus before a number is set as one; hyphens in a row stay hyphens, where LaTeX makes dashes.
    """
    plain = _MINUS.sub("−", " ".join(text.split()))
    plain = _HYPHENS.sub("-\u2060", plain).translate(_TRANSLATION)
    return _NOT_SET.sub(lambda found: f"U+{ord(found[0]):04X}", plain)
