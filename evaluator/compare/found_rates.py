"""Rates of a table that is not written with our names: counts, shares of 1, or percent.

A plain number may be any of them. The only reading that all numbers of like names allow is taken;
of several the first one, with a doubt.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from bridge.exchange.table_text import SourceRow
from evaluator.compare.found_sheet import Sheet, Value, key_of
from evaluator.compare.measure import grouped
from evaluator.compare.table_words import Column, Figure

SMALL = 50
"""Whole numbers without n up to here may as well be counts."""


def rate_rows(sheet: Sheet, values: Sequence[Value]) -> list[SourceRow]:
    """Gather count, n and rate of each group and side, and settle what plain numbers are."""
    cells: dict[tuple[str, ...], list[Value]] = {}
    shared: dict[int, str] = {}  # by row: the header may give the cells of one row other names
    for value in values:
        if value.figure is None:
            continue
        if value.column.figure == "n" and not value.column.side:
            shared.setdefault(value.row, value.figure.number)
            sheet.found.notes.append(f"n from {value.column.name!r}")
        else:
            cells.setdefault((*key_of(value), str(value.row)), []).append(value)
    sheet.found.notes[:] = dict.fromkeys(sheet.found.notes)
    groups = [
        _Group.of(key, members, shared.get(members[0].row, "")) for key, members in cells.items()
    ]
    groups = [group for group in groups if group.figure is not None or group.k]
    if groups and all(not group.key[3] for group in groups):
        sheet.found.doubts.append("no word says real or sim, so all rates are read as real")
    _settle_numbers(sheet, groups)
    return [group.row(sheet) for group in groups]


@dataclass(kw_only=True)
class _Group:
    """One rate of one side before it is settled what its number is."""

    key: tuple[str, ...]
    """Task, condition-less names in the order of ``NAMED``, side, row."""
    figure: Figure | None
    column: Column | None
    k: str
    n: str
    counted: str
    """trial, object or subtask, where a column says so."""
    unit: str = ""
    """k, rate or rate_percent, once it is settled."""

    @staticmethod
    def of(key: tuple[str, ...], members: Sequence[Value], n: str) -> "_Group":
        """Join the columns of one group."""
        by_figure = {v.column.figure: v for v in members if v.figure is not None}
        k = by_figure.get("k")
        own_n = by_figure.get("n")
        main = next((v for v in members if v.column.figure not in ("k", "n")), None)
        head = main or k
        inside = str(head.column.n) if head and head.column.n else ""
        return _Group(
            key=key,
            figure=main.figure if main else None,
            column=main.column if main else None,
            k=k.figure.number if k and k.figure else "",
            n=(own_n.figure.number if own_n and own_n.figure else "") or inside or n,
            counted=members[0].labels["unit"],
        )

    @property
    def is_open(self) -> bool:
        """Whether its number may be a count, a share of 1 or percent."""
        return self.figure is not None and not self.figure.is_certain and not self.k

    def may_be(self, unit: str) -> bool:
        """Whether the number is possible as this."""
        if self.figure is None:
            return True
        value = Fraction(self.figure.number)
        n = int(float(self.n)) if self.n else 0
        if unit == "k":
            return bool(n) and value.denominator == 1 and 0 <= value <= n
        rate = value if unit == "rate" else value / 100
        if not 0 <= rate <= 1:
            return False
        digits = len(self.figure.number.partition(".")[2])
        half = Fraction(1, 2 * 10**digits) / (1 if unit == "rate" else 100)
        half += Fraction(1, 10**6) if digits > 6 else 0
        return not n or abs(round(rate * n) - rate * n) <= half * n

    def row(self, sheet: Sheet) -> SourceRow:
        """Write it with our names."""
        task, policy, condition, side, row = self.key
        values = {"task": task or sheet.path.stem, "policy": policy, "condition": condition}
        values |= {"side": side or "real", "unit": self.counted, "n": self.n, "k": self.k}
        figure = self.figure
        if figure is not None and figure.n is not None:
            values |= {"k": str(figure.k), "n": str(figure.n), "rate_percent": figure.number}
        elif figure is not None:
            values["rate_percent" if figure.percent else self.unit or "rate"] = figure.number
        return SourceRow(path=sheet.path, row=int(row), values=values)


def _settle_numbers(sheet: Sheet, groups: Sequence[_Group]) -> None:
    """Settle what plain numbers are, all columns of a like name alike."""
    certain = any(g.figure is not None and g.figure.percent for g in groups)
    open_ = (group for group in groups if group.is_open and group.column is not None)
    kinds = grouped(open_, lambda group: group.column.figure if group.column else "")
    for figure, members in kinds.items():
        if figure == "percent":
            _settle_percent(sheet, members)
        elif certain:
            _settle_beside_signs(sheet, members)
        else:
            _settle_pool(sheet, members, counts=figure != "rate")


def _numbers(groups: Sequence[_Group]) -> list[float]:
    return [group.figure.value for group in groups if group.figure is not None]


def _settle_percent(sheet: Sheet, groups: Sequence[_Group]) -> None:
    others = [number for number in _numbers(groups) if number]
    small = bool(others) and max(others) <= 1
    names = dict.fromkeys(repr(group.column.name) for group in groups if group.column)
    if small:
        sheet.found.doubts.append(f"{', '.join(names)} says percent, and is read as shares of 1")
    for group in groups:
        group.unit = "rate" if small else "rate_percent"


def _settle_beside_signs(sheet: Sheet, groups: Sequence[_Group]) -> None:
    """Plain numbers beside cells with a percent sign."""
    for members in grouped(groups, lambda each: each.column.place if each.column else -1).values():
        if len(members) == len(sheet.lines):  # a column without any sign
            _settle_pool(sheet, members, counts=True)
            continue
        for group in members:
            if group.figure is not None and 0 < group.figure.value <= 1:
                hint = "Write the percent sign in every cell, or in none"
                found = f"{group.figure.text!r} stands among percent"
                raise sheet.refuse(int(group.key[-1]), found, hint)
            group.unit = "rate_percent"


WORDS = {"k": "counts", "rate_percent": "percent", "rate": "shares of 1"}


def _settle_pool(sheet: Sheet, groups: Sequence[_Group], *, counts: bool) -> None:
    """Take the only reading that all numbers allow, the first of several with a doubt."""
    numbers = _numbers(groups)
    for group in groups:
        if group.figure is not None and group.figure.value > 100 and not group.may_be("k"):
            found = f"a rate is {group.figure.text!r}"
            raise sheet.refuse(int(group.key[-1]), found, "Correct it")
    if any(0 < v < 1 for v in numbers) and any(v > 1 for v in numbers):
        _settle_by_side(sheet, groups, counts=counts)
        return
    units = [u for u in WORDS if (u != "k" or counts) and all(g.may_be(u) for g in groups)]
    if any(v > 1 for v in numbers):
        units = [u for u in units if u != "rate"]
    elif any(0 < v < 1 for v in numbers):
        units = ["rate"] if "rate" in units else []
    if not units:
        bad = next((g for g in groups if not any(map(g.may_be, WORDS))), groups[0])
        text = bad.figure.text if bad.figure else ""
        of_n = f" of {bad.n}" if bad.n else ""
        found = f"{text!r} is neither a count{of_n} nor a rate{of_n}"
        raise sheet.refuse(int(bad.key[-1]), found, "Write 7/10, or 70 %")
    _take_first(sheet, groups, units, counts=counts)


def _settle_by_side(sheet: Sheet, groups: Sequence[_Group], *, counts: bool) -> None:
    """Shares of 1 on one side, percent on the other; in one side it is a slip."""
    sides = grouped(groups, lambda group: group.key[3])
    for members in sides.values():
        numbers = _numbers(members)
        if any(0 < v < 1 for v in numbers) and any(v > 1 for v in numbers):
            bad = next(g for g in members if g.figure and 0 < g.figure.value < 1)
            text = bad.figure.text if bad.figure else ""
            hint = "Write 7/10, or 70 %"
            raise sheet.refuse(int(bad.key[-1]), f"{text!r} stands among percent or counts", hint)
    sheet.found.doubts.append("one side is read as shares of 1 and the other one is not")
    for members in sides.values():
        _settle_pool(sheet, members, counts=counts)


def _take_first(
    sheet: Sheet, groups: Sequence[_Group], units: Sequence[str], *, counts: bool
) -> None:
    numbers = set(_numbers(groups))
    unit = units[0]
    differ = {tuple(round(_share(group, each), 9) for group in groups) for each in units}
    may_be_counts = counts and all(v <= SMALL and v.is_integer() for v in numbers)
    may_be_counts &= all(not group.n for group in groups)
    if numbers <= {0.0, 1.0} and 1.0 in numbers:
        unit = "rate" if "rate" in units else unit
        sheet.found.doubts.append(f"0 and 1 are read as {WORDS[unit]}, not as percent or trials")
    elif len(differ) > 1:
        names = " or ".join(WORDS[each] for each in units)
        sheet.found.doubts.append(f"plain numbers may be {names}; they are read as {WORDS[unit]}")
    elif may_be_counts and unit == "rate_percent":
        sheet.found.doubts.append("plain numbers may be counts; they are read as percent")
    for group in groups:
        group.unit = unit


def _share(group: _Group, unit: str) -> float:
    value = group.figure.value if group.figure else 0.0
    return value / float(group.n) if unit == "k" else value / (1 if unit == "rate" else 100)
