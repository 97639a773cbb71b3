"""A table that is not written with our names: wide or long, trials or rates, with its doubts.

What is read stands in one line. Where another reading is possible the first one waits for a yes;
a cell that fits no reading is refused by its row.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

from bridge.errors import UsageError
from bridge.exchange.table_text import SourceRow, TableError, TableOptions, plain_name
from bridge.exchange.trials_csv import TrialRecord, trials_of
from bridge.exchange.trials_rates import RateRecord, rates_of
from evaluator.compare.table_words import (
    CellError,
    Column,
    DoubtfulTableError,
    Figure,
    folded,
    is_summary,
    read_cell,
    read_name,
    side_of,
    side_within,
)

Line = tuple[int, list[str]]
HEADERS = 3
"""Rows of names at the most."""
NAMED = ("task", "policy", "condition")
SMALL = 50
"""Whole numbers without n up to here may as well be counts."""


@dataclass(kw_only=True)
class Found:
    """What a table was read as."""

    trials: tuple[TrialRecord, ...] = ()
    rates: tuple[RateRecord, ...] = ()
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    """Readings that are likely, and not the only ones."""


@dataclass(frozen=True, kw_only=True)
class _Value:
    """One figure with whom it is about."""

    row: int
    labels: dict[str, str]
    side: str
    column: Column
    figure: Figure | None


@dataclass(kw_only=True)
class _Sheet:
    """A table cut into names of columns and rows below."""

    path: Path
    columns: list[Column]
    lines: list[Line]
    found: Found
    read: set[int] = field(default_factory=set)
    """Columns that were used."""
    labels: set[str] = field(default_factory=set)
    """Labels that have a column."""

    def labelled(self, label: str) -> Column | None:
        """Return the column of one label.

        Raises:
            TableError: When there are two of them.
        """
        these = [column for column in self.columns if column.label == label]
        if len(these) > 1:
            raise self.refuse(None, _two(these, label), f'Say which: --map "{label}=..."')
        self.read |= {column.place for column in these}
        return these[0] if these else None

    def refuse(self, row: int | None, found: str, hint: str) -> TableError:
        """Build the error that names a place."""
        return TableError(path=self.path, row=row, found=found, hint=hint)

    def cells(self, column: Column) -> list[str]:
        """Return what a column holds."""
        return [cells[column.place] for _, cells in self.lines]


def read_found(path: Path, grid: Sequence[Line], options: TableOptions) -> Found:
    """Understand a table by its words and by what its cells can be.

    Raises:
        DoubtfulTableError: When another reading is possible, and nobody said yes.
        TableError: For a cell or a row that fits no reading.
        UsageError: When there is nothing that could be read.
    """
    sheet = _sheet(path, grid, options)
    found = sheet.found
    if options.mapped:
        found.notes += [f"{theirs!r} read as {ours}" for ours, theirs in options.mapped.items()]
    _settle_sides(sheet)
    values = _values(sheet)
    if not values:
        raise UsageError(_nothing(sheet))
    if _are_trials(sheet, values):
        found.trials = tuple(trials_of(_trial_rows(sheet, values)))
    else:
        found.rates = tuple(rates_of(_rate_rows(sheet, values)))
    unread = [c.name for c in sheet.columns if c.name and c.place not in sheet.read]
    found.notes += [f"not read: {', '.join(map(repr, unread))}"] if unread else []
    if found.doubts and not options.yes:
        raise DoubtfulTableError(
            f"{path.name} can be read in more than one way: {'; '.join(found.doubts)}. "
            "If that is right say --yes; else name the columns (--map) or write the cells plainly "
            "(7/10, 70 %)."
        )
    return found


def _two(columns: Sequence[Column], what: str) -> str:
    return f"{' and '.join(repr(column.name) for column in columns)} may both be the {what}"


def _nothing(sheet: _Sheet) -> str:
    names = ", ".join(column.name for column in sheet.columns if column.name) or "none"
    return (
        f"{sheet.path} is neither a table of trials (no column with an outcome, such as outcome "
        "or success) nor one of rates (no columns real and sim, and no column side); its columns "
        f'are: {names}. Say which is which: --map "outcome=...,policy=..."'
    )


# From lines to columns and rows.


def _sheet(path: Path, grid: Sequence[Line], options: TableOptions) -> _Sheet:
    width = max((len(cells) for _, cells in grid), default=0)
    lines = [(n, [_plain(c) for c in cells] + [""] * (width - len(cells))) for n, cells in grid]
    lines = [line for line in lines if not all(set(cell) <= set(":-") for cell in line[1])]
    bars = lines and all(not cells[0] and not cells[-1] for _, cells in lines) and width > 2
    lines = [(n, cells[1:-1] if bars else cells) for n, cells in lines]
    found = Found()
    top, last = _header(lines)
    found.notes += [f"row {n} is a title" for n, _ in lines[:top]]
    levels = [list(cells) for _, cells in lines[top : last + 1]]
    for level in levels[:-1]:
        _spread(level, levels[-1])
    theirs = {plain_name(name): ours for ours, name in options.mapped.items()}
    columns = []
    for place, names in enumerate(zip(*levels, strict=True) if levels else ()):
        mapped = next((theirs[plain_name(n)] for n in names if plain_name(n) in theirs), "")
        columns.append(read_name(place, [mapped] if mapped else names))
    sheet = _Sheet(path=path, columns=columns, lines=[], found=found)
    _refuse_unnamed(sheet, lines[last + 1 :])
    sheet.lines = _body(sheet, lines[last + 1 :], levels)
    return sheet


def _refuse_unnamed(sheet: _Sheet, lines: Sequence[Line]) -> None:
    """Refuse figures in a column without a name: behind the last one a cell was cut in two."""
    unnamed = [column.place for column in sheet.columns[1:] if not column.name]
    for number, cells in lines:
        if any(cells[place] for place in unnamed):
            names = sum(bool(column.name) for column in sheet.columns)
            found = f"{sum(map(bool, cells))} fields where {names} columns have a name"
            hint = "Name every column, and quote cells with a decimal comma"
            raise sheet.refuse(number, found, hint)


def _plain(cell: str) -> str:
    """Drop what sets a cell in bold."""
    text = cell.strip().strip("*").strip()
    return text.removeprefix("\\textbf{").removesuffix("}") if text.startswith("\\text") else text


def _header(lines: Sequence[Line]) -> tuple[int, int]:
    """Return the first and the last row of names; (0, -1) where there is none."""
    top = 0
    while top < len(lines) - 1 and _only_first(lines[top][1]):
        top += 1
    for last in range(top, min(top + HEADERS, len(lines))):
        words = sum(map(_is_word, lines[last][1]))
        if not words or (words == 1 and any(c and _is_figure(c) for c in lines[last][1])):
            continue
        while last + 1 < min(top + HEADERS, len(lines)) and _names_too(lines[last + 1][1]):
            last += 1  # noqa: PLW2901
        return top, last
    return (top, top) if lines else (0, -1)


def _only_first(cells: Sequence[str]) -> bool:
    return bool(cells[0]) and not any(cells[1:])


def _is_word(cell: str) -> bool:
    if _is_figure(cell):
        return False
    column = read_name(0, [cell])
    return bool(column.label or column.side or column.figure)


def _names_too(cells: Sequence[str]) -> bool:
    """Whether a row below names is one of names, too: no figure, and no label of a row."""
    filled = [cell for cell in cells if cell]
    if len(filled) < 2 or any(_is_figure(cell) for cell in filled):
        return False
    return not cells[0] or all(_is_word(cell) for cell in filled)


def _is_figure(cell: str) -> bool:
    try:
        read_cell(0, cell)
    except CellError:
        return False
    return True


def _spread(level: list[str], lowest: Sequence[str]) -> None:
    """Let a merged name stand above all its columns."""
    for place in range(1, len(level)):
        above = level[place - 1]
        is_label = bool(above and read_name(0, [above]).label)
        if not level[place] and lowest[place] and above and not is_label:
            level[place] = above


def _body(sheet: _Sheet, lines: Sequence[Line], levels: Sequence[list[str]]) -> list[Line]:
    """Leave out summaries, notes and repeated names; let a section's side stand in its rows."""
    named = [column.place for column in sheet.columns if column.label in NAMED] or [0]
    body: list[Line] = []
    section = note = ""
    before: list[str] = []
    for number, cells in lines:
        filled = [cell for cell in cells if cell]
        if len(filled) == 1 and side_of(filled[0]):
            section = side_of(filled[0])
        elif cells in levels:
            continue
        elif any(is_summary(cells[place]) for place in named):
            sheet.found.notes.append(f"row {number} sums up others")
        elif len(filled) == 1 and len(cells) > 1 and cells[0]:
            note = cells[0]
            sheet.found.notes.append(f"row {number} is a note")
        elif note:
            found = f"a row above holds nothing but {note!r}"
            raise sheet.refuse(number, found, "Write what it says into a column of its own")
        else:
            whole = _continued(cells, before, named)
            if whole != cells and "blank names continue those above" not in sheet.found.notes:
                sheet.found.notes.append("blank names continue those above")
            body.append((number, [*whole, section]))
            before = whole
    return body


def _continued(cells: list[str], before: Sequence[str], named: Sequence[int]) -> list[str]:
    """Fill in a name that is written once for several rows; a later name starts anew."""
    if not before:
        return cells
    whole = list(cells)
    for place in named[:-1]:
        if whole[place]:
            break
        whole[place] = before[place]
    return whole


# Which side each figure is about.


def _settle_sides(sheet: _Sheet) -> None:
    """Find the column that says real or sim: by its name, its cells, a section, or inside names."""
    width = len(sheet.columns)
    if any(cells[width] for _, cells in sheet.lines):
        sheet.columns.append(Column(place=width, name="", label="side"))
        return
    for place, column in enumerate(sheet.columns):
        texts = [cell for cell in sheet.cells(column) if cell]
        all_sides = bool(texts) and all(map(side_of, texts))
        if all_sides and not column.side:
            sheet.columns[place] = Column(place=place, name=column.name, label="side")
        elif column.label == "side" and folded(column.name) != "side" and not all_sides:
            label = "task" if folded(column.name) == "environment" else ""
            sheet.columns[place] = Column(place=place, name=column.name, label=label)
    if any(column.side or column.label == "side" for column in sheet.columns):
        return
    for column in [c for c in sheet.columns if c.label in NAMED]:
        split = [side_within(cell) for cell in sheet.cells(column)]
        if split and all(side for side, _ in split):
            for (_, cells), (side, rest) in zip(sheet.lines, split, strict=True):
                cells[column.place], cells[width] = rest, side
            sheet.columns.append(Column(place=width, name="", label="side"))
            sheet.found.notes.append(f"side from {column.name!r}")
            return
        if any(side for side, _ in split):
            name = next(c for c, (s, _) in zip(sheet.cells(column), split, strict=True) if s)
            sheet.found.doubts.append(
                f"{name!r} is read as a name in {column.name!r}, and all rows as of one side"
            )


# Figures with whom they are about.


def _values(sheet: _Sheet) -> list[_Value]:
    labels = {label: sheet.labelled(label) for label in (*NAMED, "trial", "start_id", "side")}
    sheet.labels |= {label for label, column in labels.items() if column}
    blank = next((c for c in sheet.columns if not c.name and not c.label), None)
    if not labels["task"] and not labels["policy"] and blank and _is_text(sheet, blank):
        labels["policy"] = blank
        sheet.read.add(blank.place)
        sheet.found.notes.append("first column read as policy")
    columns, rest_is = _value_columns(sheet, labels)
    sheet.read |= {column.place for column in columns}
    values = []
    for number, cells in sheet.lines:
        about = {label: cells[c.place] if c else "" for label, c in labels.items()}
        for column in columns:
            values.append(_value(sheet, number, cells, column, about, rest_is))
    return values


def _is_text(sheet: _Sheet, column: Column) -> bool:
    texts = [text for text in sheet.cells(column) if text]
    return bool(texts) and not any(_is_figure(text) for text in texts)


def _value(
    sheet: _Sheet, row: int, cells: list[str], column: Column, about: dict[str, str], rest_is: str
) -> _Value:
    labels = dict(about)
    word = labels.pop("side")
    side = column.side or (side_of(word) if word else "")
    if "side" in sheet.labels and not side and cells[column.place]:
        raise sheet.refuse(row, f"side is {word!r}", "Sides: sim, real, stand-in")
    if column.rest and rest_is:
        labels[rest_is] = column.rest
    try:
        figure = read_cell(row, cells[column.place])
    except CellError as error:
        text = cells[column.place]
        raise sheet.refuse(row, f"{column.name} is {text!r}, which {error}", "Correct it") from None
    return _Value(row=row, labels=labels, side=side, column=column, figure=figure)


def _value_columns(sheet: _Sheet, labels: dict[str, Column | None]) -> tuple[list[Column], str]:
    """Return the columns of figures, and what the rest of their names says: a task or a policy."""
    free = [c for c in sheet.columns if not c.label and c.place not in sheet.read and c.name]
    free = [c for c in free if not is_summary(c.rest) and not c.is_beside]
    rest_is = "task" if labels["policy"] else "policy"
    if labels["task"] and labels["policy"]:
        rest_is = ""
    sided = [c for c in free if c.side]
    plain = [c for c in free if c.figure and not c.side and not c.rest]
    if sided:
        return _sided(sheet, sided, [c for c in plain if c.figure == "n"], labels, rest_is)
    if [c for c in plain if c.figure != "n"]:
        _refuse_doubled(sheet, plain)
        return plain, ""
    others = [c for c in free if all(_is_figure(text) for text in sheet.cells(c))]
    if not others or not any(labels[name] for name in ("side", "task", "policy")):
        return [], ""
    if not labels["task"] and not labels["policy"]:
        sheet.found.doubts.append("names in the header are read as policies")
    return _unnamed(sheet, others, plain, rest_is)


def _sided(
    sheet: _Sheet,
    sided: list[Column],
    shared: list[Column],
    labels: dict[str, Column | None],
    rest_is: str,
) -> tuple[list[Column], str]:
    """Columns whose names say real or sim, each once for a task or a policy."""
    bare = [column for column in sided if not column.rest]
    others = [column for column in sided if column.rest]
    doubts = sheet.found.doubts
    if bare and others:
        doubts.append(f"{', '.join(repr(c.name) for c in others)} are not read")
        sided = bare
    elif others and not rest_is:
        names = ", ".join(repr(column.rest) for column in others)
        raise sheet.refuse(None, f"nothing says what {names} are", "Leave one of the columns out")
    elif others and not labels["policy"] and not labels["task"]:
        doubts.append("names in the header are read as policies")
    _refuse_doubled(sheet, sided)
    return [*sided, *shared], rest_is


def _refuse_doubled(sheet: _Sheet, columns: Sequence[Column]) -> None:
    """Refuse two columns that say the same of one side of one task or policy."""
    seen: dict[tuple[str, ...], Column] = {}
    for column in columns:
        kind = column.figure if column.figure in ("k", "n") else "outcome"
        first = seen.setdefault((column.side, column.rest, kind), column)
        if first is not column:
            hint = f'Leave one out, or say which: --map "{kind}={first.name}"'
            raise sheet.refuse(None, _two([first, column], f"{column.side} {kind}".strip()), hint)


def _unnamed(
    sheet: _Sheet, others: list[Column], plain: list[Column], rest_is: str
) -> tuple[list[Column], str]:
    """Columns of figures under names that we do not know: trials by number, or tasks."""
    numbered = [c for c in others if c.name.split()[-1].isdigit() and not c.figure]
    if numbered and all(_all_answers(sheet.cells(c)) for c in numbered):
        return numbered, ""
    named = [c for c in others if c.rest and not c.figure]
    figures = [read_cell(0, text) for c in named for text in sheet.cells(c)]
    repeats = any(c.name.split()[-1].isdigit() and folded(c.name)[:4] != "task" for c in named)
    if repeats or not all(each is None or each.is_certain for each in figures):
        names = ", ".join(repr(c.name) for c in named)
        sheet.found.doubts.append(
            f"{names} are read as success rates of a {rest_is or 'task'} each"
        )
    return [*named, *(c for c in plain if c.figure == "n")], rest_is


def _all_answers(texts: Iterable[str]) -> bool:
    figures = [read_cell(0, text) for text in texts]
    return all(each is None or each.answer is not None for each in figures)


# Trials.


def _are_trials(sheet: _Sheet, values: Sequence[_Value]) -> bool:
    """Whether each cell is how one trial ended: yes or no, of one trial and no rate of several."""
    told = [v for v in values if v.column.figure != "n"]
    known = [v.figure for v in told if v.figure is not None]
    words = any(f.answer is not None and not f.number for f in known)
    if any(v.column.figure in ("k", "n", "rate", "percent") for v in values) and not words:
        return False
    if not known or not all(f.answer is not None for f in known):
        bad = next((f for f in known if f.answer is None), None)
        if bad is not None and words:
            hint = "Write success, failure or unknown in every row"
            raise sheet.refuse(bad.row, f"{bad.text!r} stands among yes and no", hint)
        return False
    keys = Counter((*_key(v), v.column.place) for v in told)
    of_outcomes = all(v.column.figure == "outcome" or not v.column.side for v in told)
    has_trials = any(column.label in ("trial", "start_id") for column in sheet.columns)
    return words or of_outcomes or has_trials or max(keys.values()) > 1


def _key(value: _Value) -> tuple[str, ...]:
    return (*(value.labels[name] for name in NAMED), value.side)


def _trial_rows(sheet: _Sheet, values: Sequence[_Value]) -> list[SourceRow]:
    """Write each trial with our names; both sides of one row are one trial."""
    told = [value for value in values if value.column.figure != "n"]
    sides = {value.side for value in told}
    columns = {value.column.place for value in told}
    paired = len({value.side for value in told if value.column.side}) > 1
    if sides == {""} and folded(told[0].column.name) != "recorded":
        sheet.found.notes.append(f"{told[0].column.name!r} read as recorded")
    stand_in = "true" if "stand-in" in sides else "false" if "real" in sides else ""
    rows: dict[tuple[int, str], dict[str, str]] = {}
    for value in told:
        name = value.column.name if len(columns) > 1 and not paired else ""
        texts = rows.setdefault((value.row, name), {"stand_in": stand_in})
        texts |= {label: value.labels[label] for label in (*NAMED, "start_id")}
        texts["task"] = texts["task"] or sheet.path.stem
        trial = value.labels["trial"]
        if trial or name:
            texts["trial_id"] = "_".join(filter(None, (trial or f"row_{value.row}", name)))
        side = "sim_planned" if value.side == "sim" else "recorded"
        answer = None if value.figure is None else value.figure.answer
        texts[side] = "" if answer is None else "yes" if answer else "no"
    sheet.found.notes.insert(0, f"{len(rows):,} trials")
    return [SourceRow(path=sheet.path, row=row, values=texts) for (row, _), texts in rows.items()]


# Rates.


def _rate_rows(sheet: _Sheet, values: Sequence[_Value]) -> list[SourceRow]:
    """Gather count, n and rate of each group and side, and settle what plain numbers are."""
    cells: dict[tuple[str, ...], list[_Value]] = {}
    shared: dict[tuple[str, ...], str] = {}
    for value in values:
        alone = value.column.figure == "n" and not value.column.side and value.figure is not None
        if alone and value.figure is not None:
            shared[(*_key(value)[:3], str(value.row))] = value.figure.number
            sheet.found.notes.append(f"n from {value.column.name!r}")
        elif value.figure is not None:
            key = (*_key(value), str(value.row))
            cells.setdefault(key, []).append(value)
    sheet.found.notes[:] = dict.fromkeys(sheet.found.notes)
    groups = [_Group.of(key, members, _shared_n(shared, key)) for key, members in cells.items()]
    groups = [group for group in groups if group.figure is not None or group.k]
    if groups and all(not group.key[3] for group in groups):
        sheet.found.doubts.append("no word says real or sim, so all rates are read as real")
    _settle_numbers(sheet, groups)
    return [group.row(sheet) for group in groups]


def _shared_n(shared: dict[tuple[str, ...], str], key: tuple[str, ...]) -> str:
    """Return n of the same row; the header may have given the row other names."""
    same_row = [n for known, n in shared.items() if known[-1] == key[-1]]
    return same_row[0] if same_row else ""


@dataclass(kw_only=True)
class _Group:
    """One rate of one side before it is settled what its number is."""

    key: tuple[str, ...]
    """Task, condition-less names in the order of ``NAMED``, side, row."""
    figure: Figure | None
    column: Column | None
    k: str
    n: str
    unit: str = ""
    """k, rate or rate_percent, once it is settled."""

    @staticmethod
    def of(key: tuple[str, ...], members: Sequence[_Value], n: str) -> "_Group":
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

    def row(self, sheet: _Sheet) -> SourceRow:
        """Write it with our names."""
        task, policy, condition, side, row = self.key
        values = {
            "task": task or sheet.path.stem,
            "policy": policy,
            "condition": condition,
            "side": side or "real",
            "n": self.n,
            "k": self.k,
        }
        figure = self.figure
        if figure is not None and figure.n is not None:
            values |= {"k": str(figure.k), "n": str(figure.n), "rate_percent": figure.number}
        elif figure is not None:
            unit = "rate_percent" if figure.percent else self.unit or "rate"
            values[unit] = figure.number
        return SourceRow(path=sheet.path, row=int(row), values=values)


def _settle_numbers(sheet: _Sheet, groups: Sequence[_Group]) -> None:
    """Settle what plain numbers are, all columns of a like name alike."""
    certain = any(g.figure is not None and g.figure.percent for g in groups)
    kinds: dict[str, list[_Group]] = {}
    for group in groups:
        if group.is_open and group.column is not None:
            kinds.setdefault(group.column.figure, []).append(group)
    for figure, members in kinds.items():
        if figure == "percent":
            _settle_percent(sheet, members)
        elif certain:
            _settle_beside_signs(sheet, members)
        else:
            _settle_pool(sheet, members, counts=figure != "rate")


def _numbers(groups: Sequence[_Group]) -> list[float]:
    return [group.figure.value for group in groups if group.figure is not None]


def _settle_percent(sheet: _Sheet, groups: Sequence[_Group]) -> None:
    small = holds_fractions(_numbers(groups))
    names = dict.fromkeys(repr(group.column.name) for group in groups if group.column)
    if small:
        sheet.found.doubts.append(f"{', '.join(names)} says percent, and is read as shares of 1")
    for group in groups:
        group.unit = "rate" if small else "rate_percent"


def holds_fractions(numbers: Sequence[float]) -> bool:
    """Whether numbers under a name that says percent look like shares of 1."""
    others = [number for number in numbers if number]
    return bool(others) and all(number <= 1 for number in others)


def _settle_beside_signs(sheet: _Sheet, groups: Sequence[_Group]) -> None:
    """Plain numbers beside cells with a percent sign."""
    by_column: dict[int, list[_Group]] = {}
    for group in groups:
        by_column.setdefault(group.column.place if group.column else -1, []).append(group)
    signed = {id(group) for group in groups}
    for members in by_column.values():
        alone = all(id(group) in signed for group in members) and len(members) == len(sheet.lines)
        for group in members:
            value = group.figure.value if group.figure else 0.0
            if not alone and 0 < value <= 1:
                found = f"{group.figure.text if group.figure else ''!r} stands among percent"
                hint = "Write the percent sign in every cell, or in none"
                raise sheet.refuse(int(group.key[-1]), found, hint)
            group.unit = "rate_percent" if not alone or value > 1 else "rate"
        if alone:
            _settle_pool(sheet, members, counts=True)


UNITS = ("k", "rate_percent", "rate")
WORDS = {"k": "counts", "rate_percent": "percent", "rate": "shares of 1"}


def _settle_pool(sheet: _Sheet, groups: Sequence[_Group], *, counts: bool) -> None:
    """Take the only reading that all numbers allow, the first of several with a doubt."""
    numbers = _numbers(groups)
    beyond = next((g for g in groups if g.figure and g.figure.value > 100 and not g.may_be("k")), 0)
    if isinstance(beyond, _Group) and beyond.figure is not None:
        raise sheet.refuse(int(beyond.key[-1]), f"a rate is {beyond.figure.text!r}", "Correct it")
    if any(0 < v < 1 for v in numbers) and any(v > 1 for v in numbers):
        _settle_by_side(sheet, groups, counts=counts)
        return
    units = [u for u in UNITS if (u != "k" or counts) and all(g.may_be(u) for g in groups)]
    if any(v > 1 for v in numbers):
        units = [u for u in units if u != "rate"]
    elif any(0 < v < 1 for v in numbers):
        units = ["rate"] if "rate" in units else []
    if not units:
        bad = (
            next(g for g in groups if not any(g.may_be(u) for u in UNITS))
            if all(not any(g.may_be(u) for u in UNITS) for g in groups[:1])
            else groups[0]
        )
        text = bad.figure.text if bad.figure else ""
        of_n = f" of {bad.n}" if bad.n else ""
        found = f"{text!r} is neither a count{of_n} nor a rate{of_n}"
        raise sheet.refuse(int(bad.key[-1]), found, "Write 7/10, or 70 %")
    _take_first(sheet, groups, units, counts=counts)


def _settle_by_side(sheet: _Sheet, groups: Sequence[_Group], *, counts: bool) -> None:
    """Shares of 1 on one side, percent on the other; in one side it is a slip."""
    sides: dict[str, list[_Group]] = {}
    for group in groups:
        sides.setdefault(group.key[3], []).append(group)
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
    sheet: _Sheet, groups: Sequence[_Group], units: Sequence[str], *, counts: bool
) -> None:
    numbers = set(_numbers(groups))
    unit = units[0]
    differ = {tuple(round(_share(group, each), 9) for group in groups) for each in units}
    without_n = all(not group.n for group in groups)
    if numbers <= {0.0, 1.0} and 1.0 in numbers:
        unit = "rate" if "rate" in units else unit
        sheet.found.doubts.append(f"0 and 1 are read as {WORDS[unit]}, not as percent or trials")
    elif len(differ) > 1:
        names = " or ".join(WORDS[each] for each in units)
        sheet.found.doubts.append(f"plain numbers may be {names}; they are read as {WORDS[unit]}")
    elif without_n and counts and unit == "rate_percent" and _are_small_counts(numbers):
        sheet.found.doubts.append("plain numbers may be counts; they are read as percent")
    for group in groups:
        group.unit = unit


def _are_small_counts(numbers: Iterable[float]) -> bool:
    return all(number <= SMALL and number.is_integer() for number in numbers)


def _share(group: _Group, unit: str) -> float:
    value = group.figure.value if group.figure else 0.0
    return value / float(group.n) if unit == "k" else value / (1 if unit == "rate" else 100)
