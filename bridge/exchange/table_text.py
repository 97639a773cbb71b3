"""A table of somebody's results as a spreadsheet saves it: delimiter, header, names, answers.

Nothing is guessed that changes a number: a column is read when its name is one of ours, apart from
case, blanks and signs, or when ``map`` says so; ``TableText.understood`` says what was read how.
"""

import csv
import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from bridge.errors import BridgeError, PathNotFoundError, UsageError
from bridge.terminal import RARE

YES = ("success", "true", "yes", "y", "1", "pass", "passed", "accepted")
NO = ("failure", "false", "no", "n", "0", "fail", "failed", "refused", "rejected")
UNKNOWN = ("", "unknown", "undecided", "none", "na", "n/a", "nan", "null", "-", "?")
MOST = 10**12
"""Counted in one field; beyond it a count is a slip, and soon no number that a float holds."""
ALIASES = {"outcome": "recorded", "sim": "sim_planned"}
"""Words that ``map`` takes for our columns."""
OUTCOME_LIKE = ("outcome", "result", "results", "success", "succeeded", "label", "real")
"""Columns that may be the outcome; nobody but the user can say so."""
DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars"}
NEAR = 0.8
"""How like a column of ours a name must be to be taken for a slip."""
_SEP = re.compile(r"^\ufeff?\"?sep=(.)\"?\s*$", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+%?")


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """How tables of results are read."""

    map: Annotated[str, RARE] = ""
    """Which column is which, where the names differ: "outcome=Result,task=Scenario"."""
    axes: str = ""
    """Further columns to compare sim and outcome along, with commas: "Lighting,Start region"."""
    names: Literal["ask", "merge", "apart"] = "ask"
    """Tasks, conditions or policies whose names differ only by case or blanks: ask refuses and
    lists them, merge counts them as one, apart as several."""

    @property
    def mapped(self) -> dict[str, str]:
        """Their column by ours.

        Raises:
            UsageError: For a part that is not ours=theirs, or names a column twice.
        """
        found: dict[str, str] = {}
        for part in filter(None, map(str.strip, self.map.split(","))):
            ours, equals, theirs = (text.strip() for text in part.partition("="))
            name = ALIASES.get(plain_name(ours), plain_name(ours))
            if not (equals and theirs and name) or name in found:
                message = f'--map {part!r} is not COLUMN=THEIRS, for example "outcome=Result".'
                raise UsageError(message)
            found[name] = theirs
        return found

    @property
    def axis_columns(self) -> tuple[str, ...]:
        """Columns that hold the values of an axis."""
        return tuple(filter(None, map(str.strip, self.axes.split(","))))


AS_SAVED = TableOptions()


class TableError(BridgeError):
    """A row of a table from elsewhere cannot be believed."""

    def __init__(self, *, path: Path, row: int | None, found: str, hint: str) -> None:
        """Remember the file and the row as a spreadsheet numbers it (the header is row 1)."""
        self.path = path
        self.row = row
        self.found = found
        where = str(path) if row is None else f"{path} row {row}"
        super().__init__(f"{where}: {found}. {hint}")


@dataclass(frozen=True, kw_only=True)
class SourceRow:
    """One line of a table with its row number, for messages."""

    path: Path
    row: int
    values: Mapping[str, str]
    axes: Mapping[str, int | str] = field(default_factory=dict)
    """By axis: the column that holds its value."""

    def text(self, name: str) -> str:
        """Return a field without the blanks around it; empty when the column is not there."""
        return (self.values.get(name) or "").strip()

    def refuse(self, found: str, hint: str) -> TableError:
        """Build the error that names this row."""
        return TableError(path=self.path, row=self.row, found=found, hint=hint)

    def whole(self, name: str) -> int | None:
        """Read a whole number from 0 to ``MOST``."""
        number = self._number(name)
        if number is None:
            return None
        if not (0 <= number <= MOST and number.is_integer()):
            hint = f"{name} counts something: a whole number from 0 to {MOST:,}"
            raise self.refuse(f"{name} is {self.text(name)!r}", hint)
        return int(number)

    def fraction(self, name: str) -> float | None:
        """Read a number in 0..1."""
        number = self._number(name)
        if number is not None and not 0 <= number <= 1:
            hint = f"{name} is a fraction from 0 to 1"
            raise self.refuse(f"{name} is {self.text(name)!r}", hint)
        return number

    def figure(self, name: str) -> str:
        """Return the text of a number with a point, where a decimal comma can only mean that."""
        text = self.text(name)
        if _DECIMAL_COMMA.fullmatch(text):
            digits = text.removesuffix("%").partition(",")[2]
            if len(digits) == 3 and not text.lstrip("+-").startswith("0,"):
                hint = "It may be a decimal comma or one between thousands: write it with a point"
                raise self.refuse(f"{name} is {text!r}", hint)
            return text.replace(",", ".")
        return "" if text.lower() in UNKNOWN else text

    def _number(self, name: str) -> float | None:
        """Return the number in a field, None when it is empty, -1 when it is not a number."""
        text = self.figure(name)
        try:
            return float(text) if text else None
        except ValueError:
            return -1.0

    def answer(self, name: str) -> bool | None:
        """Read yes, no or unknown."""
        text = self.text(name).lower()
        if text in UNKNOWN:
            return None
        for ending in (".0", ",0"):
            text = text.removesuffix(ending) if text in (f"0{ending}", f"1{ending}") else text
        if text in YES or text in NO:
            return text in YES
        hint = "Write success, failure or unknown (true/false, yes/no, pass/fail, 1/0 are read too)"
        raise self.refuse(f"{name} is {text!r}", hint)


def plain_name(name: str) -> str:
    """Return the name of a column without what people write in many ways."""
    return re.sub(r"[\W_]+", "_", name.strip().casefold().replace("%", " percent ")).strip("_")


@dataclass(frozen=True, kw_only=True)
class TableText:
    """A table whose header is understood; its rows are read from the file at each pass."""

    path: Path
    delimiter: str
    header: tuple[str, ...]
    """Names of the columns: ours where they are read, else as they stand."""
    header_row: int
    """0 where the file has no line at all."""
    renamed: tuple[tuple[str, str], ...] = ()
    """Theirs and ours, where ``map`` said so."""
    left: tuple[str, ...] = ()
    axes: Mapping[str, str] = field(default_factory=dict)
    """By axis: the column that holds its value."""

    def lines(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the rows below the header with their numbers; blank ones are left out."""
        width = len(self.header)
        for number, cells in numbered_lines(self.path, self.delimiter):
            if number <= self.header_row:
                continue
            yield number, (cells if len(cells) == width else self._fitted(number, cells))

    def _fitted(self, number: int, cells: list[str]) -> list[str]:
        """Drop empty fields that a spreadsheet writes behind the last column."""
        width = len(self.header)
        if len(cells) > width and not any(cells[width:]):
            return cells[:width]
        raise TableError(
            path=self.path,
            row=number,
            found=f"{len(cells)} fields where the header has {width}",
            hint=f"Quote fields that contain {DELIMITERS.get(self.delimiter, 'the delimiter')}",
        )

    def row(self, number: int, cells: Sequence[str]) -> SourceRow:
        """Name the fields of one row."""
        values = dict(zip(self.header, cells, strict=True))
        return SourceRow(path=self.path, row=number, values=values, axes=self.axes)

    def understood(self, kind: str, num_rows: int) -> str:
        """Say in one line what the table was read as."""
        parts = [f"{kind}, {num_rows:,} row{'' if num_rows == 1 else 's'}"]
        if self.delimiter != ",":
            name = DELIMITERS.get(self.delimiter, repr(self.delimiter))
            parts.append(f"separated by {name}")
        parts += [f"{theirs!r} read as {ours}" for theirs, ours in self.renamed]
        if self.axes:
            parts.append(f"axes: {', '.join(self.axes)}")
        if self.left:
            parts.append(f"not read: {', '.join(map(repr, self.left))}")
        hints = [name for name in self.left if plain_name(name) in OUTCOME_LIKE]
        if hints and "recorded" not in self.header and "side" not in self.header:
            parts.append(f'if {hints[0]!r} is the outcome, say --map "outcome={hints[0]}"')
        return f"{self.path.name}: {'; '.join(parts)}"


def open_table(
    path: Path, known: Sequence[str], options: TableOptions = AS_SAVED, *, near: bool = True
) -> TableText:
    """Find out how a table is written and which of its columns are ours."""
    if not path.is_file():
        hint = "Give a run folder, or a CSV file."
        raise PathNotFoundError(path=path, what="run folder or table", hint=hint)
    _refuse_nul(path)
    delimiter, names, row = _header(path, known)
    mapped = options.mapped
    theirs = {plain_name(name): ours for ours, name in mapped.items()}
    absent = [name for name in mapped.values() if plain_name(name) not in map(plain_name, names)]
    if absent:
        raise TableError(
            path=path,
            row=row,
            found=f"no column {absent[0]!r}",
            hint=f"Columns: {', '.join(names)}",
        )
    axes = {
        name: name for name in names if plain_name(name) in map(plain_name, options.axis_columns)
    }
    header: list[str] = []
    renamed, left = [], []
    for name in names:
        plain = plain_name(name)
        if plain in theirs:
            header.append(theirs[plain])
            renamed.append((name, theirs[plain]))
        elif plain in known and plain not in mapped:
            header.append(plain)
        else:
            header.append(name)
            left += [] if name in axes or not name else [name]
    table = TableText(
        path=path,
        delimiter=delimiter,
        header=tuple(header),
        header_row=row,
        renamed=tuple(renamed),
        left=tuple(left),
        axes={plain_name(name): name for name in axes},
    )
    _refuse_doubled(table)
    if near:
        _refuse_slips(table, known)
    return table


def _refuse_nul(path: Path) -> None:
    with path.open("rb") as stream:
        while block := stream.read(2**20):
            if b"\0" in block:
                hint = "It is damaged, or saved as UTF-16: save it as UTF-8 CSV"
                raise TableError(path=path, row=None, found="not a CSV file (a NUL)", hint=hint)


def _header(path: Path, known: Sequence[str]) -> tuple[str, list[str], int]:
    """Return the delimiter, the names of the columns and their row; no names without a line."""
    try:
        with path.open(encoding="utf-8-sig") as stream:
            said = _SEP.match(stream.readline())
    except UnicodeDecodeError as error:
        raise _no_text(path, error) from error
    found: tuple[str, list[str], int] = (",", [], 0)
    most = -1
    for delimiter in (said[1],) if said else DELIMITERS:
        first = next(numbered_lines(path, delimiter), None)
        names = [] if first is None else [name.strip() for name in first[1]]
        ours = sum(plain_name(name) in known for name in names)
        if first is not None and 1000 * ours + len(names) > most:
            most, found = 1000 * ours + len(names), (delimiter, names, first[0])
    return found


def numbered_lines(path: Path, delimiter: str = ",") -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of a table with their numbers; blank ones and comments are left out."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            for number, cells in enumerate(csv.reader(stream, delimiter=delimiter), start=1):
                if any(cells) and not cells[0].startswith("#"):
                    if number == 1 and len(cells) <= 2 and cells[0].lower().startswith("sep="):
                        continue
                    yield number, cells
    except (UnicodeDecodeError, csv.Error) as error:
        raise _no_text(path, error) from error


def _no_text(path: Path, error: Exception) -> TableError:
    found = f"not a CSV file ({error})"
    return TableError(path=path, row=None, found=found, hint="Save it as UTF-8 CSV")


def _refuse_doubled(table: TableText) -> None:
    doubled = sorted({name for name in table.header if name and table.header.count(name) > 1})
    if doubled:
        listed = ", ".join(map(repr, doubled))
        hint = "Rename one of them, or say which with --map"
        raise TableError(path=table.path, row=table.header_row, found=f"two of {listed}", hint=hint)


def _refuse_slips(table: TableText, known: Sequence[str]) -> None:
    """Refuse a column that is almost one of ours: it would be left out unseen."""
    free = [name for name in known if name not in table.header]
    for name in table.left:
        likely = difflib.get_close_matches(plain_name(name), free, n=1, cutoff=NEAR)
        if likely:
            raise TableError(
                path=table.path,
                row=table.header_row,
                found=f"unknown column {name!r}",
                hint=f'Is it {likely[0]!r}? Rename it, or say --map "{likely[0]}={name}"',
            )


def require(table: TableText, required: Sequence[str], known: Sequence[str]) -> TableText:
    """Refuse a table that lacks a column."""
    if not table.header:
        hint = f"Columns: {', '.join(known)}"
        raise TableError(path=table.path, row=None, found="empty", hint=hint)
    absent = [name for name in required if name not in table.header]
    if absent:
        raise TableError(
            path=table.path,
            row=table.header_row,
            found=f"no column {', '.join(map(repr, absent))}",
            hint=f"Columns: {', '.join(known)}; needed: {', '.join(required)}. There are: "
            f'{", ".join(filter(None, table.header))}; --map "{absent[0]}=THEIRS" names one',
        )
    return table


def read_rows(
    path: Path, required: Sequence[str], known: Sequence[str], options: TableOptions = AS_SAVED
) -> list[SourceRow]:
    """Read a table with a header."""
    return rows_of(require(open_table(path, known, options), required, known))


def rows_of(table: TableText) -> list[SourceRow]:
    """Read all rows of a table."""
    rows = [table.row(number, cells) for number, cells in table.lines()]
    if not rows:
        found = "a header without rows"
        raise TableError(path=table.path, row=None, found=found, hint="Add at least one row")
    return rows
