"""A table that is not written with our names: wide or long, trials or rates, with its doubts.

What is read stands in one line. Where another reading is possible the first one waits for a yes;
a cell that fits no reading is refused by its row.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bridge.errors import UsageError
from bridge.exchange.table_text import MEASURED, UNKNOWN, SourceRow, TableOptions, plain_name
from bridge.exchange.trials_csv import trials_of
from bridge.exchange.trials_rates import rates_of
from evaluator.compare import table_words
from evaluator.compare.found_rates import rate_rows
from evaluator.compare.found_sheet import NAMED, Found, Line, Sheet, Value, key_of, two_of
from evaluator.compare.table_words import CellError, Column, DoubtfulTableError, Figure, folded

HEADERS = 3
"""Rows of names at the most."""


def read_found(path: Path, grid: Sequence[Line], options: TableOptions) -> Found:
    """Understand a table by its words and by what its cells can be.

    Raises:
        DoubtfulTableError: When another reading is possible, and nobody said yes.
        TableError: For a cell or a row that fits no reading.
        UsageError: When there is nothing that could be read.
    """
    if len(grid) == 1:
        raise UsageError(f"{path} has a header and no row below it.")
    sheet = _sheet(path, grid, options)
    found = sheet.found
    if options.mapped:
        found.notes += [f"{theirs!r} read as {ours}" for ours, theirs in options.mapped.items()]
    _settle_sides(sheet)
    _settle_sections(sheet)
    values = _values(sheet)
    if not values:
        raise UsageError(_nothing(sheet))
    if _are_trials(sheet, values):
        found.trials = tuple(trials_of(_trial_rows(sheet, values)))
    else:
        found.rates = tuple(rates_of(rate_rows(sheet, values)))
    unread = [c.name for c in sheet.columns if c.name and c.place not in sheet.read]
    found.notes += [f"not read: {', '.join(map(repr, unread))}"] if unread else []
    if found.doubts and not options.yes:
        raise DoubtfulTableError(
            f"{path.name} can be read in more than one way: {'; '.join(found.doubts)}. "
            "If that is right say --yes; else name the columns (--map) or write the cells plainly "
            "(7/10, 70 %)."
        )
    return found


def _nothing(sheet: Sheet) -> str:
    names = ", ".join(column.name for column in sheet.columns if column.name) or "none"
    return (
        f"{sheet.path} is neither a table of trials (no column with an outcome, such as outcome "
        "or success) nor one of rates (no columns real and sim, and no column side); its columns "
        f'are: {names}. Say which is which: --map "outcome=...,policy=..."'
    )


# From lines to columns and rows.


def _sheet(path: Path, grid: Sequence[Line], options: TableOptions) -> Sheet:
    width = max((len(cells) for _, cells in grid), default=0)
    lines = [(n, [_plain(c) for c in cells] + [""] * (width - len(cells))) for n, cells in grid]
    lines = [line for line in lines if not all(set(cell) <= set(":-") for cell in line[1])]
    bars = lines and all(not cells[0] and not cells[-1] for _, cells in lines) and width > 2
    lines = [(n, cells[1:-1] if bars else cells) for n, cells in lines]
    found = Found()
    top, last = _header(lines)
    found.notes += [f"row {n} is a title" for n, _ in lines[:top]]
    title = lines[top - 1][1][0] if top else ""
    levels = [list(cells) for _, cells in lines[top : last + 1]]
    for level in levels[:-1]:
        _spread(level, levels[-1])
    theirs = {plain_name(name): ours for ours, name in options.mapped.items()}
    columns = []
    for place, names in enumerate(zip(*levels, strict=True) if levels else ()):
        mapped = next((theirs[plain_name(n)] for n in names if plain_name(n) in theirs), "")
        columns.append(table_words.read_name(place, [mapped] if mapped else names))
    if any(folded(column.name) == "policy" for column in columns):  # a checkpoint is another thing
        columns = [
            c if c.label != "policy" or folded(c.name) == "policy" else Column(c.place, c.name)
            for c in columns
        ]
    sheet = Sheet(path=path, columns=columns, lines=[], found=found)
    _refuse_unnamed(sheet, lines[last + 1 :])
    sheet.lines = _body(sheet, lines[last + 1 :], levels, title)
    return sheet


def _refuse_unnamed(sheet: Sheet, lines: Sequence[Line]) -> None:
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
    while top < len(lines) - 1 and lines[top][1][0] and not any(lines[top][1][1:]):
        top += 1  # a title
    for last in range(top, min(top + HEADERS, len(lines))):
        words = sum(map(_is_word, lines[last][1]))
        if not words or (words == 1 and any(c and _is_figure(c) for c in lines[last][1])):
            continue
        while last + 1 < min(top + HEADERS, len(lines)) and _names_too(lines[last + 1][1]):
            last += 1  # noqa: PLW2901
        return top, last
    return (top, top) if lines else (0, -1)


def _is_word(cell: str) -> bool:
    if _is_figure(cell):
        return False
    column = table_words.read_name(0, [cell])
    return bool(column.label or column.side or column.figure)


def _names_too(cells: Sequence[str]) -> bool:
    """Whether a row below names is one of names, too: no figure, and no label of a row."""
    filled = [cell for cell in cells if cell]
    if len(filled) < 2 or any(_is_figure(cell) for cell in filled):
        return False
    return not cells[0] or all(_is_word(cell) for cell in filled)


def _figure(cell: str) -> Figure | None:
    try:
        return table_words.read_cell(0, cell)
    except CellError:
        return None


def _is_figure(cell: str) -> bool:
    return cell.strip().lower() in UNKNOWN or _figure(cell) is not None


def _spread(level: list[str], lowest: Sequence[str]) -> None:
    """Let a merged name stand above all its columns."""
    for place in range(1, len(level)):
        above = level[place - 1]
        is_label = bool(above and table_words.read_name(0, [above]).label)
        if not level[place] and lowest[place] and above and not is_label:
            level[place] = above


def _body(
    sheet: Sheet, lines: Sequence[Line], levels: Sequence[list[str]], title: str
) -> list[Line]:
    """Leave out summaries, notes and repeated names; let side and title stand in their rows."""
    named = [column.place for column in sheet.columns if column.label in NAMED] or [0]
    body: list[Line] = []
    section = note = ""
    before: list[str] = []
    for number, cells in lines:
        filled = [cell for cell in cells if cell]
        if len(filled) == 1 and table_words.side_of(filled[0]):
            section = table_words.side_of(filled[0])
        elif cells in levels:
            title, note, before = note or title, "", []  # a further table with a title of its own
        elif any(table_words.is_summary(cells[place]) for place in named):
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
            body.append((number, [*whole, section, title]))
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


def _settle_sides(sheet: Sheet) -> None:
    """Find the column that says real or sim: by its name, its cells, a section, or inside names."""
    width = len(sheet.columns)
    if any(cells[width] for _, cells in sheet.lines):
        sheet.columns.append(Column(place=width, name="", label="side"))
        return
    for place, column in enumerate(sheet.columns):
        texts = [cell for cell in sheet.cells(column) if cell]
        all_sides = bool(texts) and all(map(table_words.side_of, texts))
        if all_sides and not column.side:
            sheet.columns[place] = Column(place=place, name=column.name, label="side")
        elif column.label == "side" and folded(column.name) != "side" and not all_sides:
            label = "task" if folded(column.name) == "environment" else ""
            sheet.columns[place] = Column(place=place, name=column.name, label=label)
    if any(column.label == "side" for column in sheet.columns):
        own = [replace(c, side="") if folded(c.name) == "recorded" else c for c in sheet.columns]
        sheet.columns[:] = own  # the outcome of a side, whatever it is
        return
    if any(column.side for column in sheet.columns):
        return
    for column in [c for c in sheet.columns if c.label in NAMED]:
        split = [table_words.side_within(cell) for cell in sheet.cells(column)]
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


def _settle_sections(sheet: Sheet) -> None:
    """Tables of one header below each other: their titles are tasks, or policies."""
    place = len(sheet.lines[0][1]) - 1 if sheet.lines else 0
    if len({cells[place] for _, cells in sheet.lines}) > 1:
        taken = [column.label for column in sheet.columns]
        label = next((name for name in ("task", "policy", "condition") if name not in taken), "")
        sheet.columns.append(Column(place=place, name="", label=label))
        sheet.found.notes.append(f"titles read as {label}")


# Figures with whom they are about.


def _values(sheet: Sheet) -> list[Value]:
    labels = {
        label: sheet.labelled(label) for label in (*NAMED, "trial", "start_id", "unit", "side")
    } | {label: _measured(sheet, label) for label in MEASURED}
    sheet.labels |= {label for label, column in labels.items() if column}
    first = next((c for c in sheet.columns if not c.label and not c.side and not c.figure), None)
    if first is not None and not labels["policy"] and not labels["task"]:
        of_rates = first.place == 0 and _holds_rates(sheet)
        if _is_text(sheet, first) and (of_rates or not first.name):
            _label(sheet, labels, "policy", first)
    columns, rest_is = _value_columns(sheet, labels)
    sheet.read |= {column.place for column in columns}
    has_policy = labels["policy"] is not None and labels["policy"].label == "policy"
    are_rows = _holds_rates(sheet) and not _tells_rows(sheet, labels) and not has_policy
    if are_rows:
        sheet.found.doubts.append("rows of one name are read as different policies")
    values = []
    for number, cells in sheet.lines:
        about = {label: cells[c.place] if c else "" for label, c in labels.items()}
        about["policy"] += f" row {number}" if are_rows else ""
        for column in columns:
            values.append(_value(sheet, number, cells, column, about, rest_is))
    return values


def _measured(sheet: Sheet, label: str) -> Column | None:
    """Return the one column of progress or of time, where its cells are that."""
    these = [column for column in sheet.columns if column.label == label]
    is_ours = table_words.is_share if label == "progress" else table_words.is_number
    fits = [c for c in these if all(is_ours(t) or t in UNKNOWN for t in sheet.cells(c))]
    return fits[0] if len(these) == 1 and fits else None


def _label(sheet: Sheet, labels: dict[str, Column | None], label: str, column: Column) -> None:
    which = "first column" if column.place == 0 else repr(column.name)
    labels[label] = column
    sheet.read.add(column.place)
    sheet.found.notes.append(f"{which} read as {label}")


def _holds_rates(sheet: Sheet) -> bool:
    """Whether each row has both sides, and rates of several trials."""
    sided = [column for column in sheet.columns if column.side and not column.label]
    figures = [_figure(text) for column in sided for text in sheet.cells(column)]
    several = any(f and (f.n or f.percent or (f.number and f.answer is None)) for f in figures)
    return several and len({column.side for column in sided}) > 1


def _tells_rows(sheet: Sheet, labels: dict[str, Column | None]) -> bool:
    """Whether names tell all rows apart, if need be with those of a further column."""
    named = [labels[name] for name in NAMED if labels[name]]
    free = [c for c in sheet.columns if c.name and not c.label and c.place not in sheet.read]
    for more in (None, *(c for c in free if _is_text(sheet, c) and not labels["condition"])):
        keys = [tuple(cells[c.place] for c in (*named, more) if c) for _, cells in sheet.lines]
        if len(set(keys)) == len(keys):
            if more is not None:
                _label(sheet, labels, "condition", more)
            return True
    return False


def _is_text(sheet: Sheet, column: Column) -> bool:
    texts = [text for text in sheet.cells(column) if text]
    return bool(texts) and not any(_is_figure(text) for text in texts)


def _value(
    sheet: Sheet, row: int, cells: list[str], column: Column, about: dict[str, str], rest_is: str
) -> Value:
    labels = dict(about)
    word = labels.pop("side")
    side = column.side or (table_words.side_of(word) if word else "")
    if "side" in sheet.labels and not side and cells[column.place]:
        raise sheet.refuse(row, f"side is {word!r}", "Sides: sim, real, stand-in")
    if column.rest and rest_is:
        labels[rest_is] = column.rest
    try:
        figure = table_words.read_cell(row, cells[column.place])
    except CellError as error:
        text = cells[column.place]
        raise sheet.refuse(row, f"{column.name} is {text!r}, which {error}", "Correct it") from None
    return Value(row=row, labels=labels, side=side, column=column, figure=figure)


def _value_columns(sheet: Sheet, labels: dict[str, Column | None]) -> tuple[list[Column], str]:
    """Return the columns of figures, and what the rest of their names says: a task or a policy."""
    free = [c for c in sheet.columns if not c.label and c.place not in sheet.read and c.name]
    free = [c for c in free if not table_words.is_summary(c.rest) and not c.is_beside]
    rest_is = "policy" if not labels["policy"] else "" if labels["task"] else "task"
    sided = [c for c in free if c.side]
    plain = [c for c in free if c.figure and not c.side and not c.rest]
    outcomes = [c for c in plain if c.figure == "outcome"]
    if len(outcomes) == 1 and {c.side for c in sided} == {"sim"}:
        sided.append(replace(outcomes[0], side="real"))  # what is said of no side was recorded
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
    sheet: Sheet,
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


def _refuse_doubled(sheet: Sheet, columns: Sequence[Column]) -> None:
    """Refuse two columns that say the same of one side of one task or policy."""
    seen: dict[tuple[str, ...], Column] = {}
    for column in columns:
        kind = column.figure if column.figure in ("k", "n") else "outcome"
        first = seen.setdefault((column.side, column.rest, kind), column)
        if first is not column:
            hint = f'Leave one out, or say which: --map "{kind}={first.name}"'
            raise sheet.refuse(None, two_of([first, column], f"{column.side} {kind}".strip()), hint)


def _unnamed(
    sheet: Sheet, others: list[Column], plain: list[Column], rest_is: str
) -> tuple[list[Column], str]:
    """Columns of figures under names that we do not know: trials by number, or tasks."""
    numbered = [c for c in others if c.name.split()[-1].isdigit() and not c.figure]
    told = [table_words.read_cell(0, text) for c in numbered for text in sheet.cells(c)]
    if numbered and all(each is None or each.answer is not None for each in told):
        return numbered, ""
    named = [c for c in others if c.rest and not c.figure]
    figures = [table_words.read_cell(0, text) for c in named for text in sheet.cells(c)]
    repeats = any(c.name.split()[-1].isdigit() and folded(c.name)[:4] != "task" for c in named)
    if repeats or not all(each is None or each.is_certain for each in figures):
        names = ", ".join(repr(c.name) for c in named)
        sheet.found.doubts.append(
            f"{names} are read as success rates of a {rest_is or 'task'} each"
        )
    return [*named, *(c for c in plain if c.figure == "n")], rest_is


# Trials.


def _are_trials(sheet: Sheet, values: Sequence[Value]) -> bool:
    """Whether each cell is how one trial ended: yes or no, of one trial and no rate of several."""
    told = [v for v in values if v.column.figure != "n"]
    known = [v.figure for v in told if v.figure is not None and not v.figure.ended]
    words = any(f.answer is not None and not f.number for f in known)
    if any(v.column.figure in ("k", "n", "rate", "percent") for v in values) and not words:
        return False
    if not known or not all(f.answer is not None for f in known):
        bad = next((f for f in known if f.answer is None), None)
        if bad is not None and words:
            hint = "Write success, failure or unknown in every row"
            raise sheet.refuse(bad.row, f"{bad.text!r} stands among yes and no", hint)
        return False
    keys = Counter((*key_of(v), v.column.place) for v in told)
    of_outcomes = all(v.column.figure == "outcome" or not v.column.side for v in told)
    has_trials = any(column.label in ("trial", "start_id") for column in sheet.columns)
    return words or of_outcomes or has_trials or max(keys.values()) > 1


def _trial_rows(sheet: Sheet, values: Sequence[Value]) -> list[SourceRow]:
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
        if not name:  # of several trials in one row nobody knows whose it is
            texts |= {label: value.labels[label] for label in MEASURED}
            sheet.read |= {c.place for c in sheet.columns if value.labels.get(c.label)}
        texts["task"] = texts["task"] or sheet.path.stem
        trial = value.labels["trial"]
        if trial or name:
            texts["trial_id"] = "_".join(filter(None, (trial or f"row_{value.row}", name)))
        side = "sim_planned" if value.side == "sim" else "recorded"
        answer = None if value.figure is None else value.figure.answer
        texts[side] = "" if answer is None else "yes" if answer else "no"
        if value.figure is not None and value.figure.ended:
            texts[side] = value.figure.text
    sheet.found.notes.insert(0, f"{len(rows):,} trials")
    return [SourceRow(path=sheet.path, row=row, values=texts) for (row, _), texts in rows.items()]
