"""Tables as people read them: numbers of several columns become one text, ``4/5 = 80.0 %``.

Tables hold numbers, one to a column, in ``results.json``, CSV and Parquet. What is printed,
drawn on the page and set in LaTeX is a view of them, made here row by row.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from evaluator.result import Cell, Table

Record = dict[str, Any]
"""One row by the names of its columns, in their order."""
Rows = Sequence[Record]


@dataclass(frozen=True)
class Figures:
    """A number as people read it, with its count and the ends of its interval."""

    value: str
    """With its unit."""
    ends: str = ""
    count: str = ""

    def __str__(self) -> str:
        """Write it in one line."""
        count = f"{self.count} = " if self.count else ""
        return f"{count}{self.value}" + (f" [{self.ends}]" if self.ends else "")


Shown = Cell | Figures
"""What a view may hold."""


@dataclass(frozen=True, kw_only=True)
class View:
    """A table as it is printed."""

    id: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Shown, ...], ...]
    note: str


def view(table: Table) -> View:
    """Return what is printed of a table."""
    build = _VIEWS.get(table.id)
    if build is None or not table.rows:
        return View(**vars(table))
    records = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    shown = build(records)
    rows = tuple(tuple(row.values()) for row in shown)
    return View(**(vars(table) | {"columns": tuple(shown[0]), "rows": rows}))


def used_columns(table: View) -> list[int]:
    """Return the columns that say something in any row."""
    return [
        index
        for index in range(len(table.columns))
        if not table.rows or any(row[index] not in ("", None) for row in table.rows)
    ]


def is_number(table: View, index: int) -> bool:
    """Say whether a column holds numbers, or mostly numbers with their intervals."""
    cells = [row[index] for row in table.rows if row[index] is not None]
    if any(isinstance(cell, Figures) for cell in cells):
        return 2 * sum(isinstance(cell, Figures) for cell in cells) > len(cells)
    return bool(cells) and all(
        isinstance(cell, int | float) and not isinstance(cell, bool) for cell in cells
    )


def _known(value: Any) -> bool:
    return value is not None and value == value  # NaN is not


def percent(value: float | None, low: Any = None, high: Any = None, digits: int = 1) -> Shown:
    """Write a share and its interval in percent; nothing where it is unknown.

    Args:
        value: The share, 0 to 1; None where it is unknown.
        low: Lower end of its interval, 0 to 1; None leaves the interval out.
    """
    if not _known(value):
        return None
    ends = ""
    if _known(low):
        ends = f"{100 * low:.{digits}f}, {100 * high:.{digits}f}"
    return Figures(f"{100 * (value or 0.0):.{digits}f} %", ends)


def _rate(row: Record) -> Shown:
    """Write a rate with its count and interval: ``4/5 = 80.0 % [37.6, 96.4]``."""
    if not _known(row["rate"]):
        return f"undefined: {row['why undefined']}"
    shown = percent(row["rate"], row["low"], row["high"])
    if not _known(row["k"]):
        return f"{shown} (no n)"
    return replace(shown, count=f"{row['k']}/{row['n']}") if isinstance(shown, Figures) else shown


def _picked(row: Record, *names: str) -> Record:
    """Return some columns of a row, in this order."""
    return {name: row[name] for name in names}


def _words(text: str) -> str:
    return text.replace("_", " ")


def _success(rows: Rows) -> Rows:
    """Put the sides of a group beside each other."""
    sides = list(dict.fromkeys(row["side"] for row in rows))
    of_side = [[row for row in rows if row["side"] == side] for side in sides]
    (gap,) = (name for name in rows[0] if name.startswith("sim - "))
    plain = {row["unit"] for row in of_side[0]} == {"trial"}  # as everybody counts
    found = []
    for group in zip(*of_side, strict=True):
        first = group[0]
        shown = _picked(first, "task", "condition", "policy", "unit")
        shown |= {"condition": _words(first["condition"])} | ({"unit": None} if plain else {})
        shown |= {row["side"]: _rate(row) for row in group}
        found.append(shown | {gap: first[gap]})
    return found


def _points(value: float, row: Record) -> Figures:
    """Write percentage points with the interval that stands in the row."""
    ends = f"{row['low']:+.1f}, {row['high']:+.1f}" if _known(row["low"]) else ""
    return Figures(f"{value:+.1f} pp", ends)


def _points_of(row: Record, name: str) -> Shown:
    return _points(row[name], row) if _known(row[name]) else None


def _layout(rows: Rows) -> Rows:
    rates = list(rows[0])[2:]
    return [row | {name: percent(row[name]) or "undefined" for name in rates} for row in rows]


def _conclusions(rows: Rows) -> Rows:
    """Put the bias and its interval into one cell, and a yes beside those that were right."""

    def shown(row: Record) -> Record:
        right = succeeded = None
        if row["yes"]:
            right = Figures(f"{row['yes and right']} of {row['yes']}")
            succeeded = Figures(f"{row['succeeded']} of {row['trials']}")
        return {
            **_picked(row, "task", "groups"),
            "bias": _points_of(row, "bias (pp)"),
            "interval": row["interval"],
            "yes and right": right,
            "succeeded at all": succeeded,
            **_picked(row, "candidates", "best recorded", "ranked", "more trials"),
        }

    return [shown(row) for row in rows]


def _states(rows: Rows) -> Rows:
    """Put both ends of the interval into one cell, where the lower one stood."""

    def interval(row: Record) -> Shown:
        known = _known(row["low (mm)"])
        return f"[{row['low (mm)']:.1f}, {row['high (mm)']:.1f}]" if known else None

    return [
        {
            ("interval (mm)" if name == "low (mm)" else name): (
                interval(row) if name == "low (mm)" else cell
            )
            for name, cell in row.items()
            if name != "high (mm)"
        }
        for row in rows
    ]


def _published(rows: Rows) -> Rows:
    def recomputed(row: Record) -> Shown:
        value = row["recomputed"]
        if not _known(value):
            return str(row["instead"])
        return f"{value:.4g}" if abs(value) < 1 else f"{value:.2f}"

    return [
        {name: cell for name, cell in row.items() if name != "instead"}
        | {"recomputed": recomputed(row)}
        for row in rows
    ]


def _comparisons(rows: Rows) -> Rows:
    """Leave what the sentences say in words to programs."""
    return [_picked(row, "answer", "task") for row in rows]


_VIEWS: dict[str, Callable[[Rows], Rows]] = {
    "conclusions": _conclusions,
    "comparisons": _comparisons,
    "success": _success,
    "layout": _layout,
    "final_states": _states,
    "published": _published,
}
"""By table; the others are printed as they are."""
