"""What a file or a folder of somebody's results holds, as far as its own words tell.

Known are tables of trials and of rates (CSV, or JSON lists of objects with the same names), tables
of printed figures. An outcome is never guessed: a file that does not say it is left, with the
reason.
"""

import difflib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from bridge.errors import BridgeError, PathNotFoundError, UsageError
from bridge.exchange.table_text import (
    AS_SAVED,
    TableError,
    TableOptions,
    TableText,
    open_table,
    plain_name,
    read_rows,
    rows_of,
)
from bridge.exchange.trials_csv import (
    COLUMNS,
    SIDES_OF_TRIAL,
    TrialRecord,
    json_rows,
    open_trials,
    read_trials_by_side,
    read_trials_json,
    trials_of,
)
from bridge.exchange.trials_rates import COLUMNS as RATE_COLUMNS
from bridge.exchange.trials_rates import RateRecord, rates_of

PUBLISHED = "a published table"
LISTS = "Give a list of trials or rates"
FIGURES = ("k", "n", "rate", "rate_percent")
"""A table with a column side and one of these is one of rates."""
READ_ENDINGS = (".csv", ".tsv", ".txt", ".json")
MOST_FILES = 20_000
"""Files of a folder that are looked at."""


@dataclass(frozen=True, kw_only=True)
class Taken:
    """What one file was taken for."""

    path: Path
    kind: str
    summary: str
    trials: tuple[TrialRecord, ...] = ()
    rates: tuple[RateRecord, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Left:
    """A file of a folder that was not read, and why."""

    path: Path
    reason: str


def take(path: Path, options: TableOptions = AS_SAVED) -> Taken:
    """Read a file; its content tells what it is."""
    if path.suffix.lower() == ".json":
        return _take_json(path)
    # A slip in a name is told by the reader of the table, once it is known which one it is.
    known = (*COLUMNS, *RATE_COLUMNS, "statistic", "printed")
    _refuse_unknown(options, known)
    table = open_table(path, known, options, near=False)
    header = table.header
    if "statistic" in header:
        return Taken(path=path, kind=PUBLISHED, summary=f"{path.name}: rates with printed figures")
    if "side" in header and not set(FIGURES) & set(header):
        named = [name for name in table.left if plain_name(name) == "outcome"]
        if named and "recorded" not in header:  # it says itself that it is the outcome
            mapped = ",".join(filter(None, (options.map, f"outcome={named[0]}")))
            options = replace(options, map=mapped)
            table = open_table(path, known, options, near=False)
        trials = read_trials_by_side(path, options)
        understood = table.understood("trials of either side, without pairs", len(trials))
        return Taken(path=path, kind="trials", summary=understood, trials=tuple(trials))
    if "side" in header:
        rows = read_rows(path, ("task", "side"), RATE_COLUMNS, options)
        return _taken_rates(path, rates_of(rows), options)
    if "trial_id" in header or ("task" in header and set(SIDES_OF_TRIAL) & set(header)):
        opened = open_trials(path, options)
        trials = trials_of(rows_of(opened))
        understood = opened.understood("trials", len(trials))
        return Taken(path=path, kind="trials", summary=understood, trials=tuple(trials))
    raise UsageError(_unknown_table(table))


def _refuse_unknown(options: TableOptions, known: Sequence[str]) -> None:
    """Refuse a mapping onto a column that no table has."""
    for name in options.mapped:
        if name not in known:
            names = ", ".join(dict.fromkeys(("outcome", *known)))
            likely = difflib.get_close_matches(name, ("outcome", *known), n=1)
            hint = f" Did you mean {likely[0]}?" if likely else ""
            raise UsageError(f"--map {name}=...: no such column.{hint} There are: {names}.")


def _unknown_table(table: TableText) -> str:
    return (
        f"{table.path} is neither a trials CSV (no column trial_id, nor task with recorded or "
        "sim_planned) nor a rates CSV (no column side); its columns are: "
        f"{', '.join(table.header) or 'none'}. "
        'Say which is which: --map "task=...,recorded=...,sim_planned=..."'
    )


def _taken_rates(path: Path, records: Sequence[RateRecord], options: TableOptions) -> Taken:
    table = open_table(path, RATE_COLUMNS, options)
    understood = table.understood("rates", len(records))
    return Taken(path=path, kind="rates", summary=understood, rates=tuple(records))


def _take_json(path: Path) -> Taken:
    """Read a list of trials or of rates."""
    if not path.is_file():
        hint = "Give a file of results."
        raise PathNotFoundError(path=path, what="results file", hint=hint)
    items = _listed(path)
    if items is None:
        raise TableError(path=path, row=None, found="no list of objects", hint=LISTS)
    if all("side" in item and "task" in item for item in items):
        records = rates_of(json_rows(path, items, RATE_COLUMNS))
        understood = f"{path.name}: rates, {len(records)} objects"
        return Taken(path=path, kind="rates", summary=understood, rates=tuple(records))
    if all("task" in item and set(SIDES_OF_TRIAL) & set(item) for item in items):
        trials = read_trials_json(path, items)
        understood = f"{path.name}: trials, {len(trials)} objects"
        return Taken(path=path, kind="trials", summary=understood, trials=tuple(trials))
    raise UsageError(
        f"{path} lists objects that are neither trials (task with recorded or sim_planned) nor "
        "rates (task, side, rate)."
    )


def _listed(path: Path) -> list[dict[str, Any]] | None:
    """Return the objects that a JSON file lists, alone or as trials or rates; None otherwise."""
    try:
        record = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        found = f"no JSON ({error})"
        raise TableError(path=path, row=None, found=found, hint=LISTS) from error
    if isinstance(record, dict):
        record = next((record[n] for n in ("trials", "rates") if n in record), None)
    is_list = isinstance(record, list) and record
    return record if is_list and all(isinstance(item, dict) for item in record) else None


def look_through(folder: Path, options: TableOptions = AS_SAVED) -> tuple[list[Taken], list[Left]]:
    """Find what can be read in a folder of results, and say what was left and why."""
    if not folder.is_dir():
        raise PathNotFoundError(path=folder, what="folder of results", hint="Give a folder.")
    files = sorted(path for path in folder.rglob("*") if path.is_file())[:MOST_FILES]
    taken: list[Taken] = []
    left: list[Left] = []
    for path in files:
        if path.suffix.lower() not in READ_ENDINGS:
            left.append(Left(path=path, reason="no table and no JSON"))
        else:
            _try(path, partial(take, path, options), taken, left)
    return taken, left


def _try(path: Path, read: Callable[[], Taken], taken: list[Taken], left: list[Left]) -> None:
    try:
        taken.append(read())
    except (BridgeError, UsageError) as error:
        reason = str(error).replace(f"{path} ", "").replace(f"{path}: ", "")
        left.append(Left(path=path, reason=reason))
