"""Trials CSV in and out: one row per trial, as people keep them in a spreadsheet.

Columns are the fields of ``TrialRecord``. Only task must be there (rows without trial_id are
numbered); an empty field means unknown and stays unknown.
"""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from bridge.episode.run_folder import RunFolder
from bridge.exchange.table_text import (
    AS_SAVED,
    ENDED,
    SourceRow,
    TableOptions,
    TableText,
    open_table,
    require,
    rows_of,
)

UNITS = ("trial", "object", "subtask")
MOST_IN_TRIAL = 10_000
"""Objects or sub-tasks of one trial."""


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
    why_unknown: str = ""
    """What was said of an outcome that is not known: aborted, protective stop ..."""
    checkpoint: str = ""  # which weights acted under the policy's name, where somebody says so
    progress: float | None = None  # part of the task that was done, 0 to 1
    time_s: float | None = None  # how long a success took


COLUMNS = tuple(field.name for field in fields(TrialRecord))
SIDES = ("sim", "real", "stand-in")
"""Where a rollout, or the trials behind a rate, took place."""
SIDES_OF_TRIAL = ("recorded", "sim_planned", "sim_executed", "verdict", "k")
"""A table of tasks with one of these columns is one of trials, numbered where they have no id."""


def open_trials(path: Path, options: TableOptions = AS_SAVED) -> TableText:
    """Open a table of trials."""
    table = open_table(path, COLUMNS, options)
    if any(name in table.header for name in SIDES_OF_TRIAL):
        return require(table, ("task",), COLUMNS)
    return require(table, ("trial_id", "task"), COLUMNS)


def read_trials(path: Path, options: TableOptions = AS_SAVED) -> list[TrialRecord]:
    """Read and check a trials CSV."""
    return trials_of(rows_of(open_trials(path, options)))


def trials_of(rows: Sequence[SourceRow]) -> list[TrialRecord]:
    """Check the rows of a table of trials, each alone and beside the others.

    Numbers that start anew in another group are told apart by its names.
    """
    seen: dict[tuple[str, ...], int] = {}
    units: dict[str, tuple[str, int]] = {}
    trials = [read_trial(row) for row in rows]
    is_told = all(trial.condition for trial in trials)  # one that is missing may be any of them
    keys = [_group_and_id(each if is_told else replace(each, condition="")) for each in trials]
    for row, trial, key in zip(rows, trials, keys, strict=True):
        if key in seen:
            raise row.refuse(
                f"trial_id {trial.trial_id!r} stands in row {seen[key]} already",
                "Give each trial its own id, or remove the copy; real and sim one below the other "
                "need a column side",
            )
        seen[key] = row.row
        check_unit(row, trial, units)
    if len({trial.trial_id for trial in trials}) < len(trials):
        named = ["/".join(filter(None, _group_and_id(trial))) for trial in trials]
        trials = [replace(each, trial_id=name) for each, name in zip(trials, named, strict=True)]
    return trials


def _group_and_id(trial: TrialRecord) -> tuple[str, ...]:
    side = "sim" if trial.recorded is None and trial.sim_planned is not None else ""
    return trial.task, trial.condition, trial.policy, side, trial.trial_id


def check_unit(row: SourceRow, trial: TrialRecord, units: dict[str, tuple[str, int]]) -> None:
    """Refuse a second unit in one task; ``units`` keeps each task's unit and the row it is from."""
    unit, first = units.setdefault(trial.task, (trial.unit, row.row))
    if unit != trial.unit:
        raise row.refuse(
            f"unit {trial.unit!r} in task {trial.task!r}, but row {first} says {unit!r}",
            "One task is counted in one unit; mixing them changes what a rate means",
        )


def read_trial(row: SourceRow) -> TrialRecord:
    """Read and check one row."""
    for name in ("trial_id", "task"):
        if not row.text(name) and (name == "task" or name in row.values):
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
    ended = row.text("recorded").lower()
    ended = ended.replace("_", " ") if ended in ENDED else ""
    return TrialRecord(
        trial_id=row.text("trial_id") or f"row_{row.row}",
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
        why_unknown=row.text("why_unknown") or ended,
        checkpoint=row.text("checkpoint"),
        progress=row.fraction("progress"),
        time_s=row.seconds("time_s"),
    )


def write_trials(path: Path, trials: Iterable[TrialRecord]) -> Path:
    """Write a trials CSV that ``read_trials`` reads back as it was."""
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
