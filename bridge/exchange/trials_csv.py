"""Trials CSV in and out: one row per trial, as people keep them in a spreadsheet.

Columns: trial_id, task, condition, policy, start_id, unit, k, n, recorded, sim_planned,
sim_executed, verdict, p_success, cell, stand_in. Only trial_id and task must be there; an empty
field means unknown and stays unknown.
"""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from bridge.episode.run_folder import RunFolder
from bridge.errors import BridgeError, PathNotFoundError, UsageError
from bridge.whole_file import write_whole

UNITS = ("trial", "object", "subtask")
YES = ("success", "true", "yes", "1", "accepted")
NO = ("failure", "false", "no", "0", "refused", "rejected")
UNKNOWN = ("", "unknown", "undecided", "none")
MOST = 10**12
"""Counted in one field; beyond it a count is a slip, and soon no number that a float holds."""
MOST_IN_TRIAL = 10_000
"""Objects or sub-tasks of one trial."""


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
class TrialRecord:
    """One row. None is unknown."""

    trial_id: str
    task: str
    condition: str = ""
    policy: str = ""
    start_id: str | None = None
    unit: str = "trial"
    k: int | None = None
    n: int | None = None
    recorded: bool | None = None
    sim_planned: bool | None = None
    sim_executed: bool | None = None
    verdict: bool | None = None
    p_success: float | None = None
    cell: str = ""
    stand_in: bool | None = None


COLUMNS = tuple(field.name for field in fields(TrialRecord))


@dataclass(frozen=True, kw_only=True)
class SourceRow:
    """One line of a CSV file with its row number, for messages."""

    path: Path
    row: int
    values: Mapping[str, str]

    def text(self, name: str) -> str:
        """Return a field without the blanks around it; empty when the column is not there."""
        return (self.values.get(name) or "").strip()

    def refuse(self, found: str, hint: str) -> TableError:
        """Build the error that names this row.

        Args:
            found: What is wrong, such as ``unit 'trial' in task 'a'``.
            hint: What to do about it.
        """
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

    def _number(self, name: str) -> float | None:
        """Return the number in a field, None when it is empty, -1 when it is not a number."""
        text = self.text(name)
        try:
            return float(text) if text else None
        except ValueError:
            return -1.0

    def answer(self, name: str) -> bool | None:
        """Read yes, no or unknown."""
        text = self.text(name).lower()
        if text in UNKNOWN:
            return None
        if text in YES or text in NO:
            return text in YES
        hint = "Write success, failure or unknown (true/false and 1/0 are read too)"
        raise self.refuse(f"{name} is {text!r}", hint)


def read_rows(path: Path, required: Sequence[str], known: Sequence[str]) -> list[SourceRow]:
    """Read a CSV file with a header.

    Args:
        path: The file, in UTF-8.
        required: Columns that must be there.
        known: All columns that may be there.

    Raises:
        PathNotFoundError: When the file is not there.
        TableError: When it is no text, a column is missing, unknown or doubled, or a row is ragged.
    """
    if not path.is_file():
        raise PathNotFoundError(path=path, what="table", hint="Give a CSV file.")
    lines = list(numbered_lines(path))
    if not lines:
        raise TableError(path=path, row=None, found="empty", hint=f"Columns: {', '.join(known)}")
    header = [name.strip() for name in lines[0][1]]
    check_header(path, lines[0][0], header, required, known)
    rows = []
    for number, cells in lines[1:]:
        if len(cells) != len(header):
            raise TableError(
                path=path,
                row=number,
                found=f"{len(cells)} fields where the header has {len(header)}",
                hint="Quote fields that contain commas",
            )
        rows.append(SourceRow(path=path, row=number, values=dict(zip(header, cells, strict=True))))
    if not rows:
        raise TableError(
            path=path, row=None, found="a header without rows", hint="Add at least one row"
        )
    return rows


def header_of(path: Path) -> list[str]:
    """Return the column names of a CSV file, to tell which table it is."""
    if not path.is_file():
        hint = "Give a run folder, or a CSV file."
        raise PathNotFoundError(path=path, what="run folder or table", hint=hint)
    return next(([name.strip() for name in cells] for _, cells in numbered_lines(path)), [])


def numbered_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of a CSV file with their numbers; blank ones and comments are left out.

    Raises:
        TableError: When it is no text.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            for number, cells in enumerate(csv.reader(stream), start=1):
                if any(cells) and not cells[0].startswith("#"):
                    yield number, cells
    except (UnicodeDecodeError, csv.Error) as error:
        raise TableError(
            path=path, row=None, found=f"not a CSV file ({error})", hint="Save it as UTF-8 CSV"
        ) from error


def check_header(
    path: Path, row: int, header: list[str], required: Sequence[str], known: Sequence[str]
) -> None:
    """Refuse a header that lacks a column, or has an unknown or doubled one.

    Args:
        path: The file, for the error.
        row: Line number of the header, for the error.
        header: Its column names.
        required: Columns that must be there.
        known: All columns that may be there.

    Raises:
        TableError: Naming the columns.
    """
    columns = f"Columns: {', '.join(known)}; needed: {', '.join(required)}"
    absent = [name for name in required if name not in header]
    strange = [name for name in header if name not in known]
    doubled = sorted({name for name in header if header.count(name) > 1})
    for names, what in ((absent, "no column"), (strange, "unknown column"), (doubled, "two of")):
        if names:
            listed = ", ".join(repr(name) for name in names)
            raise TableError(path=path, row=row, found=f"{what} {listed}", hint=columns)


def read_trials(path: Path) -> list[TrialRecord]:
    """Read and check a trials CSV.

    Raises:
        TableError: For a doubled trial id, an impossible count, or two units in one task.
    """
    rows = read_rows(path, ("trial_id", "task"), COLUMNS)
    seen: dict[str, int] = {}
    units: dict[str, tuple[str, int]] = {}
    trials = []
    for row in rows:
        trial = read_trial(row)
        if trial.trial_id in seen:
            raise row.refuse(
                f"trial_id {trial.trial_id!r} stands in row {seen[trial.trial_id]} already",
                "Give each trial its own id, or remove the copy",
            )
        seen[trial.trial_id] = row.row
        check_unit(row, trial, units)
        trials.append(trial)
    return trials


def check_unit(row: SourceRow, trial: TrialRecord, units: dict[str, tuple[str, int]]) -> None:
    """Refuse a second unit in one task; ``units`` remembers each task's unit and first row.

    Args:
        row: Where the trial was read, for the error.
        trial: The trial to check.
        units: By task: its unit and the row that gave it first; a new task is added.

    Raises:
        TableError: Naming both rows.
    """
    unit, first = units.setdefault(trial.task, (trial.unit, row.row))
    if unit != trial.unit:
        raise row.refuse(
            f"unit {trial.unit!r} in task {trial.task!r}, but row {first} says {unit!r}",
            "One task is counted in one unit; mixing them changes what a rate means",
        )


def read_trial(row: SourceRow) -> TrialRecord:
    """Read and check one row.

    Raises:
        TableError: For what no trial can be.
    """
    for name in ("trial_id", "task"):
        if not row.text(name):
            raise row.refuse(f"{name} is empty", f"Every trial needs a {name}")
    unit = row.text("unit") or "trial"
    if unit not in UNITS:
        raise row.refuse(f"unit is {unit!r}", f"Units: {', '.join(UNITS)}")
    k, n = row.whole("k"), row.whole("n")
    recorded = row.answer("recorded")
    if (k is None) != (n is None):
        raise row.refuse("k without n, or n without k", "Give both, or neither")
    if k is not None and n is not None:
        if n < 1 or k > n:
            raise row.refuse(f"{k} of {n} is not a possible count", "Check k and n")
        if n > MOST_IN_TRIAL:
            raise row.refuse(f"one trial counts {n} {unit}s", f"At most {MOST_IN_TRIAL:,}")
        if unit == "trial" and n != 1:
            raise row.refuse(
                f"one trial counts {n} trials", "A row is one trial; for ducks use unit object"
            )
        if recorded is not None and unit == "trial" and recorded != (k == 1):
            raise row.refuse(
                f"recorded is {'success' if recorded else 'failure'} but k is {k}",
                "Correct one of them",
            )
        if recorded is None and unit == "trial" and not row.text("recorded"):
            recorded = k == 1
    return TrialRecord(
        trial_id=row.text("trial_id"),
        task=row.text("task"),
        condition=row.text("condition"),
        policy=row.text("policy"),
        start_id=row.text("start_id") or None,
        unit=unit,
        k=k,
        n=n,
        recorded=recorded,
        sim_planned=row.answer("sim_planned"),
        sim_executed=row.answer("sim_executed"),
        verdict=row.answer("verdict"),
        p_success=row.fraction("p_success"),
        cell=row.text("cell"),
        stand_in=row.answer("stand_in"),
    )


def write_trials(path: Path, trials: Iterable[TrialRecord]) -> Path:
    """Write a trials CSV that ``read_trials`` reads back as it was.

    Args:
        path: The file to write; an older one is replaced.
        trials: In the order of the rows.
    """
    path.write_text(trials_text(trials), encoding="utf-8", newline="")
    return path


def trials_text(trials: Iterable[TrialRecord]) -> str:
    """The text of a trials CSV, all columns in order."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream)
    writer.writerow(COLUMNS)
    for trial in trials:
        writer.writerow([_field(name, getattr(trial, name)) for name in COLUMNS])
    return stream.getvalue()


def _field(name: str, value: object) -> str:
    if isinstance(value, bool):
        words = ("true", "false") if name == "stand_in" else ("success", "failure")
        return words[0] if value else words[1]
    return "" if value is None else str(value)


def trials_path(run: RunFolder) -> Path:
    """Where a run keeps its imported trials."""
    return run.notes_dir / "trials.csv"


def import_trials(table: Path, run: RunFolder, *, force: bool) -> list[TrialRecord]:
    """Check a trials CSV and keep it in the run, with all columns and in one spelling.

    Args:
        table: The CSV file.
        run: The run.
        force: Replace trials imported earlier.

    Raises:
        TableError: Naming the row that cannot be believed; nothing is written then.
        UsageError: When the run has imported trials already.
    """
    trials = read_trials(table)
    path = trials_path(run)
    if path.exists() and not force:
        message = f"{path} exists already. Replace it with --force, or use another run."
        raise UsageError(message)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, trials_text(trials).encode())
    return trials
