"""A table of somebody's results as a spreadsheet saves it: delimiter, header, names, answers.

Nothing is guessed that changes a number: a column is read when its name is one of ours, apart from
case, blanks and signs, or when ``map`` says so; ``TableText.understood`` says what was read how.
"""

import csv
import difflib
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import date, datetime, time
from pathlib import Path
from typing import Annotated, Any

from bridge.errors import BridgeError, PathNotFoundError, UsageError
from bridge.terminal import RARE

YES = (
    *("success", "succeeded", "true", "yes", "y", "1", "pass", "passed", "accepted", "ok"),
    *("ja", "oui", "si", "sí", "erfolg", "succès", "✓", "✔", "✅"),
)
NO = (
    *("failure", "false", "no", "n", "0", "fail", "failed", "refused", "rejected", "nok"),
    *("not ok", "nein", "non", "fehlschlag", "échec", "✗", "✘", "❌"),
)
UNKNOWN = (
    "",
    "not evaluated",
    *["unknown", "undecided", "none", "na", "n/a", "nan", "null", "-", "–", "—", "?", "未评"],
)
ENDED = (
    *("aborted", "abort", "interrupted", "void", "crashed", "protective stop", "protective_stop"),
    *("estop", "e-stop", "emergency stop"),
)
"""How a trial ended that has no outcome: which of these are void, a protocol says."""
MOST = 10**12
"""Counted in one field; beyond it a count is a slip, and soon no number that a float holds."""
ALIASES = {"outcome": "recorded", "sim": "sim_planned"}
"""Words that ``map`` takes for our columns."""
OUTCOME_LIKE = ("outcome", "result", "results", "success", "succeeded", "label", "real")
"""Columns that are read as the outcome where there is one of them and no ``recorded``."""
MEASURED = {
    "progress": ("progress", "partial", "partial_credit", "score", "completion"),
    "time_s": ("time_s", "duration_s", "time_to_success_s", "time_to_success", "completion_time_s"),
}
"""Columns beside the outcome that are compared, too, and other people's names of them."""
WORKBOOKS = (".xlsx", ".xlsm")
FIRST_LINES, MOST_TOP = 5, 200
"""Lines in which names of columns are looked for, among so many with blanks and comments."""
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
    yes: bool = False
    """Take a table as it was understood, where another reading is possible, too."""

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

    def text(self, name: str) -> str:
        """Return a field without the blanks around it; empty when the column is not there."""
        return (self.values.get(name) or "").strip()

    def refuse(self, found: str, hint: str, kind: type[TableError] = TableError) -> TableError:
        """Build the error that names this row."""
        return kind(path=self.path, row=self.row, found=found, hint=hint)

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
        """Read a number in 0..1, or percent with their sign."""
        number = self._number(name)
        if number is not None and self.text(name).endswith("%"):
            number /= 100
        if number is not None and not 0 <= number <= 1:
            hint = f"{name} is a fraction from 0 to 1, or percent with a sign"
            raise self.refuse(f"{name} is {self.text(name)!r}", hint)
        return number

    def seconds(self, name: str) -> float | None:
        """Read a duration [s]."""
        number = self._number(name)
        if number is not None and not 0 < number <= MOST:
            raise self.refuse(f"{name} is {self.text(name)!r}", f"{name} is a duration in seconds")
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
            return float(text.removesuffix("%")) if text else None
        except ValueError:
            return -1.0

    def answer(self, name: str) -> bool | None:
        """Read yes, no or unknown."""
        text = self.text(name)
        if text.lower() in (*UNKNOWN, *ENDED):
            return None
        found = answer_of(text)
        if found is not None:
            return found
        hint = "Write success, failure or unknown (true/false, yes/no, pass/fail, 1/0 are read too)"
        raise self.refuse(f"{name} is {text.lower()!r}", hint)


def answer_of(text: str) -> bool | None:
    """Return what a yes or a no means; None for any other text."""
    text = text.strip().lower()
    for ending in (".0", ",0"):
        text = text.removesuffix(ending) if text in (f"0{ending}", f"1{ending}") else text
    return True if text in YES else False if text in NO else None


def plain_name(name: str) -> str:
    """Return the name of a column without what people write in many ways."""
    return re.sub(r"[\W_]+", "_", name.strip().casefold().replace("%", " percent ")).strip("_")


@dataclass(frozen=True, kw_only=True)
class TableText:
    """A table whose header is understood."""

    path: Path
    delimiter: str
    header: tuple[str, ...]
    """Names of the columns: ours where they are read, else as they stand."""
    header_row: int
    """0 where the file has no line at all."""
    renamed: tuple[tuple[str, str], ...] = ()
    """Theirs and ours, where ``map`` said so."""
    left: tuple[str, ...] = ()
    grid: Sequence[tuple[int, list[str]]] = ()
    """All lines that are not blank, with their numbers."""

    def lines(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the rows below the header with their numbers; blank ones are left out."""
        width = len(self.header)
        for number, cells in self.grid:
            if number <= self.header_row:
                continue
            yield number, (cells if len(cells) == width else self._fitted(number, cells))

    def _fitted(self, number: int, cells: list[str]) -> list[str]:
        """Drop empty fields that a spreadsheet writes behind the last column."""
        width = len(self.header)
        if len(cells) > width and not any(cells[width:]):
            return cells[:width]
        hint = f"Quote fields that contain {DELIMITERS.get(self.delimiter, 'the delimiter')}"
        raise self.refuse(f"{len(cells)} fields where the header has {width}", hint, row=number)

    def refuse(self, found: str, hint: str, *, row: int | None = None) -> TableError:
        """Build the error that names a row, else that of the header."""
        return TableError(path=self.path, row=row or self.header_row, found=found, hint=hint)

    def row(self, number: int, cells: Sequence[str]) -> SourceRow:
        """Name the fields of one row."""
        values = dict(zip(self.header, cells, strict=True))
        return SourceRow(path=self.path, row=number, values=values)

    def understood(self, kind: str, num_rows: int) -> str:
        """Say in one line what the table was read as."""
        parts = [f"{kind}, {num_rows:,} row{'' if num_rows == 1 else 's'}"]
        if self.delimiter != ",":
            name = DELIMITERS.get(self.delimiter, repr(self.delimiter))
            parts.append(f"separated by {name}")
        parts += [f"{theirs!r} read as {ours}" for theirs, ours in self.renamed]
        if self.left:
            parts.append(f"not read: {', '.join(map(repr, self.left))}")
        return f"{self.path.name}: {'; '.join(parts)}"


def open_table(
    path: Path,
    known: Sequence[str],
    options: TableOptions = AS_SAVED,
    *,
    near: bool = True,
    words: Sequence[str] = (),
) -> TableText:
    """Find out how a table is written, by ``known`` and ``words``, and which columns are ours.

    ``near``: names that are almost ours, and names that stand twice, are refused.
    """
    delimiter, grid = load_grid(path, (*known, *words))
    row, names = (grid[0][0], [name.strip() for name in grid[0][1]]) if grid else (0, [])
    mapped = options.mapped
    theirs = {plain_name(name): ours for ours, name in mapped.items()}
    absent = [name for name in mapped.values() if plain_name(name) not in map(plain_name, names)]
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
            left += [name] if name else []
    table = TableText(
        path=path,
        delimiter=delimiter,
        header=tuple(header),
        header_row=row,
        renamed=tuple(renamed),
        left=tuple(left),
        grid=grid,
    )
    if absent:
        raise table.refuse(f"no column {absent[0]!r}", f"Columns: {', '.join(names)}")
    if near:
        _refuse_doubled(table)
        _refuse_slips(table, known)
    return table


def load_grid(path: Path, known: Sequence[str]) -> tuple[str, list[tuple[int, list[str]]]]:
    """Read the cells of a text table or of the first sheet of a workbook, and its delimiter.

    Of the delimiters the one is taken that makes most columns, of names in ``known`` above all;
    blank lines and comments are left out.
    """
    if not path.is_file():
        hint = "Give a run folder, or a table."
        raise PathNotFoundError(path=path, what="run folder or table", hint=hint)
    if path.suffix.lower() in WORKBOOKS:
        return "", _workbook_cells(path)
    text = _decoded(path)
    said = _SEP.match(text.split("\n", 1)[0])
    top = "\n".join(text.split("\n", MOST_TOP)[:MOST_TOP])
    best, most = ",", -1
    for delimiter in (said[1],) if said else DELIMITERS:
        tops = [cells for _, cells in _lines(path, top, delimiter)[:FIRST_LINES]]
        score = max((_score(cells, known) for cells in tops), default=-1)
        if score > most:
            most, best = score, delimiter
    return best, _lines(path, text, best)


def _workbook_cells(path: Path) -> list[tuple[int, list[str]]]:
    """Return the rows of the only sheet that holds any; merged cells all hold what one holds."""
    import openpyxl  # noqa: PLC0415  # only a workbook needs it

    try:
        book = openpyxl.load_workbook(path, data_only=True)
    except Exception as error:  # whatever a damaged archive raises
        found = f"not a workbook ({error})"
        raise TableError(path=path, row=None, found=found, hint="Save it as .xlsx") from error
    sheets = [sheet for sheet in book.worksheets if sheet.max_row > 1]
    if len(sheets) > 1:
        names = ", ".join(repr(sheet.title) for sheet in sheets)
        raise UsageError(
            f"{path} has several sheets with tables ({names}), and they may be different sides "
            "of one study. Save each as a file of its own, or all in one sheet with a column side."
        )
    if not sheets:
        return []
    sheet = sheets[0]
    rows = [[_cell_text(cell) for cell in row] for row in sheet.iter_rows()]
    for area in sheet.merged_cells.ranges:
        for row in range(area.min_row - 1, area.max_row):
            for column in range(area.min_col - 1, area.max_col):
                rows[row][column] = rows[area.min_row - 1][area.min_col - 1]
    return [(number, cells) for number, cells in enumerate(rows, start=1) if any(cells)]


def _cell_text(cell: Any) -> str:
    value = cell.value
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, datetime | date | time):
        return value.isoformat()
    if isinstance(value, int | float):
        percent = "%" in str(cell.number_format)
        text = f"{100 * value:.12g}" if percent else f"{value:.17g}"
        plain = repr(value) if not percent and float(text) == value else text
        return f"{plain.removesuffix('.0')}{'%' if percent else ''}"
    return str(value).strip()


def _score(cells: Sequence[str], known: Sequence[str]) -> int:
    return 1000 * sum(plain_name(name) in known for name in cells) + len(cells)


def _decoded(path: Path) -> str:
    data = path.read_bytes()
    utf_16 = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    if b"\0" in data and not utf_16:
        hint = "It is damaged, or saved as UTF-16: save it as UTF-8 CSV"
        raise TableError(path=path, row=None, found="not a CSV file (a NUL)", hint=hint)
    try:
        return data.decode("utf-16" if utf_16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        with suppress(UnicodeDecodeError):
            return data.decode("cp1252")  # as Excel saves CSV in Western Europe
        raise _no_text(path, error) from error


def _lines(path: Path, text: str, delimiter: str) -> list[tuple[int, list[str]]]:
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    try:
        return [
            (number, cells)
            for number, cells in enumerate(reader, start=1)
            if any(cells) and not _is_remark(number, cells)
        ]
    except csv.Error as error:
        raise _no_text(path, error) from error


def _is_remark(number: int, cells: Sequence[str]) -> bool:
    if number == 1 and len(cells) <= 2 and cells[0].lower().startswith("sep="):
        return True
    return cells[0].startswith("#") and not (cells[0].strip() == "#" and any(cells[1:]))


def _no_text(path: Path, error: Exception) -> TableError:
    found = f"not a CSV file ({error})"
    return TableError(path=path, row=None, found=found, hint="Save it as UTF-8 CSV")


def _refuse_doubled(table: TableText) -> None:
    doubled = sorted({name for name in table.header if name and table.header.count(name) > 1})
    if doubled:
        listed = ", ".join(map(repr, doubled))
        raise table.refuse(f"two of {listed}", "Rename one of them, or say which with --map")


def _refuse_slips(table: TableText, known: Sequence[str]) -> None:
    """Refuse a column that is almost one of ours: it would be left out unseen."""
    free = [name for name in known if name not in (*table.header, "time_s")]  # "time": of the day
    for name in table.left:
        likely = difflib.get_close_matches(plain_name(name), free, n=1, cutoff=NEAR)
        if likely:
            hint = f'Is it {likely[0]!r}? Rename it, or say --map "{likely[0]}={name}"'
            raise table.refuse(f"unknown column {name!r}", hint)


def require(table: TableText, required: Sequence[str], known: Sequence[str]) -> TableText:
    """Refuse a table that lacks a column."""
    if not table.header:
        hint = f"Columns: {', '.join(known)}"
        raise TableError(path=table.path, row=None, found="empty", hint=hint)
    absent = [name for name in required if name not in table.header]
    if absent:
        hint = (
            f"Columns: {', '.join(known)}; needed: {', '.join(required)}. There are: "
            f'{", ".join(filter(None, table.header))}; --map "{absent[0]}=THEIRS" names one'
        )
        raise table.refuse(f"no column {', '.join(map(repr, absent))}", hint)
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
