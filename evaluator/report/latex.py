"""Tables for a paper: LaTeX with booktabs, its special characters escaped."""

import re
from functools import lru_cache

from evaluator.report.tables import is_number, used_columns
from evaluator.report.wording import cell_text, texts
from evaluator.result import Cell, Table

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
    "“": "``",
    "”": "''",
    "τ": r"$\tau$",
    "ρ": r"$\rho$",
    "φ": r"$\phi$",
    "λ": r"$\lambda$",
    "µ": r"$\mu$",
    "✓": "yes",
    "✗": "no",
}
_TRANSLATION = str.maketrans(_COMMANDS)
_NOT_SET = re.compile("[^\x20-\x7e\xa1-\u017f]")
"""Letters up to U+017F are known to every LaTeX since 2018; others are written as U+XXXX."""
_NAME = re.compile(r"[^A-Za-z0-9:.-]+")


def as_latex(table: Table) -> str:
    r"""Write a booktabs table: numbers to the right, no empty columns, the note below.

    The document needs ``\usepackage{booktabs}``; a table wider than the page also ``graphicx``,
    which shrinks it to the width of the text, and one longer than a page ``longtable``.
    """
    used = used_columns(table)
    align = "".join("r" if is_number(table, index) else "l" for index in used)
    head = " & ".join(latex(table.columns[index]) for index in used)
    written = lru_cache(maxsize=None, typed=True)(_cell)  # tables say the same again and again
    body = [" & ".join([written(row[i]) for i in used]) + r" \\" for row in table.rows]
    columns = f"@{{}}{align}@{{}}"
    caption = rf"\caption{{{latex(table.title)}}}"
    label = rf"\label{{tab:{_NAME.sub('-', table.id)}}}"
    note = [rf"\par\smallskip\footnotesize {latex(table.note)}"] if table.note else []
    if len(body) > LONG_ROWS:
        lines = [
            r"{\small",
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
    if _is_wide(table, used):
        tabular = [r"\resizebox{\textwidth}{!}{%", *tabular, "}"]
    lines = [
        *(r"\begin{table}[t]", r"\centering", caption, label, r"\small"),
        *tabular,
        *note,
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


LONG_ROWS = 45
"""A table with more rows does not fit one page and is set over several (``longtable``)."""


WIDE_CHARACTERS = 84
"""A line of text in a usual article, in the small size of tables."""


def _is_wide(table: Table, used: list[int]) -> bool:
    """Say whether the longest cells of all columns would not fit beside each other."""
    lines = [table.columns, *(texts(row) for row in table.rows)]
    return sum(max(len(line[index]) for line in lines) + 2 for index in used) > WIDE_CHARACTERS


def _cell(cell: Cell) -> str:
    return latex(cell_text(cell))


def latex(text: str) -> str:
    """Escape what LaTeX would read as a command, and write what it cannot set as U+XXXX."""
    plain = " ".join(text.split()).translate(_TRANSLATION)
    return _NOT_SET.sub(lambda found: f"U+{ord(found[0]):04X}", plain)
