"""Tables as people read them: numbers of several columns become one text, ``4/5 = 80.0 %``.

Tables hold numbers, one to a column, in ``results.json``, CSV and Parquet. What is printed,
drawn on the page and set in LaTeX is a view of them, made here row by row.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
    if not table.rows:
        return View(**vars(table))
    build = _VIEWS.get(table.id, _folded)
    shown = build([dict(zip(table.columns, row, strict=True)) for row in table.rows])
    rows = tuple(tuple(row.values()) for row in shown)
    return View(**(vars(table) | {"columns": tuple(map(shown_word, shown[0])), "rows": rows}))


def shown_word(name: str) -> str:
    """Write a column's name, or a side's, in the two words that a page has for the two sides."""
    return _SIDE.sub(lambda found: SIDES[found[0]], name)


SIDES = {"sim": "twin", "real": "recorded", "stand-in": "recorded (stand-in)", "pp": "points"}
"""Words of tables as they are stored, and of those that are read."""
_SIDE = re.compile(rf"\b({'|'.join(SIDES)})\b")


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


def _last_word(name: str) -> str:
    return name.partition(" (")[0].rpartition(" ")[2]


def _folded(rows: Rows) -> Rows:
    """Put each number, the count before it and the interval behind it into one cell.

    A count is the two columns ``k`` and ``n``, an interval the two columns ``low`` and ``high``,
    perhaps with a word before and a unit behind; ``why undefined`` stands where there is none.
    """
    names = list(rows[0])
    ends: dict[str, Sequence[str]] = {}
    counts: dict[str, Sequence[str]] = {}
    for place, name in enumerate(names):
        after, before = names[place + 1 : place + 3], names[max(0, place - 2) : place]
        if [_last_word(each) for each in after] == ["low", "high"]:
            ends[name] = after
        if [_last_word(each) for each in before] == ["k", "n"]:
            counts[name] = before
    gone = {each for pair in (*ends.values(), *counts.values()) for each in pair}
    gone |= {"interval", "why undefined"} if ends else set()
    kinds = {name: kind for name in names if (kind := _kind(name)) or name in ends}
    if not kinds:  # as the table of all trials
        return rows
    return [
        {
            name: _number(
                kinds[name],
                row[name],
                [row[each] for each in ends.get(name, ())],
                [row[each] for each in counts.get(name, ())],
                row.get("why undefined"),
            )
            if name in kinds
            else row[name]
            for name in names
            if name not in gone
        }
        for row in rows
    ]


def _kind(name: str) -> str:
    """Say what a column of this name holds: points, a change or a share; empty for others.

    Points stand without a unit: the column's name ends in it.
    """
    if name.endswith("(pp)"):
        return "points"
    return "change" if name.startswith("relative") else "share" * (_last_word(name) == "rate")


def _number(
    kind: str, value: Any, ends: Sequence[Any], count: Sequence[Any], why: str | None
) -> Shown:
    """Write a cell with its interval and count; what is not a number stays as it is."""
    if isinstance(value, str):
        return value
    if not _known(value):
        return f"undefined: {why}" if why and kind else None
    factor, unit = (100.0, " %") if kind in ("share", "change") else (1.0, "")
    form = {"points": "+.1f", "change": "+.1f", "share": ".1f"}.get(kind, ".4g")
    known = [_signed(f"{factor * end:{form}}") for end in ends if _known(end)]
    told = Figures(
        _signed(f"{factor * value:{form}}") + unit,
        ", ".join(known),
        f"{count[0]}/{count[1]}" if count and _known(count[0]) else "",
    )
    return f"{told} (no n)" if count and not told.count else told


def _signed(text: str) -> str:
    return text if float(text) else text.lstrip("+-")


def _known(value: Any) -> bool:
    return value is not None and value == value  # NaN is not


def _picked(row: Record, *names: str) -> Record:
    """Return some columns of a row, in this order."""
    return {name: row[name] for name in names}


def _success(rows: Rows) -> Rows:
    """Put the sides of a group beside each other."""
    folded = _folded(rows)
    sides = list(dict.fromkeys(row["side"] for row in rows))
    of_side = [[row for row in folded if row["side"] == side] for side in sides]
    (gap,) = (name for name in rows[0] if name.startswith("sim - "))
    plain = {row["unit"] for row in of_side[0]} == {"trial"}  # as everybody counts
    return [
        _picked(group[0], "task", "condition", "policy", "unit")
        | {"condition": group[0]["condition"].replace("_", " ")}
        | ({"unit": None} if plain else {})
        | {row["side"]: row["rate"] for row in group}
        | {gap: group[0][gap]}
        for group in zip(*of_side, strict=True)
    ]


def _conclusions(rows: Rows) -> Rows:
    """Put a yes beside those that were right, and what succeeded at all."""

    def of(row: Record, k: str, n: str) -> Shown:
        return Figures(f"{row[k]} of {row[n]}") if row["yes"] else None

    return [
        _picked(folded, "task", "groups", "bias (pp)")
        | {"yes and right": of(row, "yes and right", "yes")}
        | {"succeeded at all": of(row, "succeeded", "trials")}
        for row, folded in zip(rows, _folded(rows), strict=True)
    ]


def _published(rows: Rows) -> Rows:
    def recomputed(row: Record) -> Shown:
        value = row["recomputed"]
        if not _known(value):
            return str(row["instead"])
        return f"{value:.4g}" if abs(value) < 1 else f"{value:.2f}"

    kept = [name for name in rows[0] if name != "instead"]
    return [_picked(row, *kept) | {"recomputed": recomputed(row)} for row in rows]


_VIEWS: dict[str, Callable[[Rows], Rows]] = {
    "conclusions": _conclusions,
    "comparisons": lambda rows: [_picked(row, "answer", "task") for row in rows],
    "success": _success,
    "published": _published,
}
"""By table; of the others numbers are put together with their counts and intervals."""
