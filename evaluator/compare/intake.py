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
    OUTCOME_LIKE,
    UNKNOWN,
    WORKBOOKS,
    SourceRow,
    TableError,
    TableOptions,
    TableText,
    answer_of,
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
from evaluator.compare.found_rates import holds_fractions
from evaluator.compare.found_table import read_found
from evaluator.compare.table_words import KNOWN, DoubtfulTableError

PUBLISHED = "a published table"
LISTS = "Give a list of trials or rates"
FIGURES = ("k", "n", "rate", "rate_percent")
"""A table with a column side and one of these is one of rates."""
READ_ENDINGS = (".csv", ".tsv", ".txt", ".json", ".md", *WORKBOOKS)
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
    known = (*COLUMNS, *RATE_COLUMNS, "statistic", "printed")
    _refuse_unknown(options, known)
    table = open_table(path, known, options, near=False, words=KNOWN)
    header = set(table.header)
    if "statistic" in header:
        return Taken(path=path, kind=PUBLISHED, summary=f"{path.name}: rates with printed figures")
    ours = _with_outcome(table, options)
    is_ours = "task" in header and not {"real", "sim"} & set(map(plain_name, table.left))
    if is_ours and "side" in header and set(FIGURES) & header:
        rows = read_rows(path, ("task", "side"), RATE_COLUMNS, options)
        return _taken_rates(path, rates_of(_surely_percent(rows, options)), options)
    if is_ours and "side" in header and "recorded" in ours.mapped | dict.fromkeys(header):
        trials = read_trials_by_side(path, ours)
        table = open_table(path, known, ours, near=False)
        understood = table.understood("trials of either side, without pairs", len(trials))
        return Taken(path=path, kind="trials", summary=understood, trials=tuple(trials))
    if is_ours and "side" not in header and set(SIDES_OF_TRIAL) & header:
        opened = open_trials(path, ours)
        trials = trials_of(rows_of(opened))
        understood = opened.understood("trials", len(trials))
        return Taken(path=path, kind="trials", summary=understood, trials=tuple(trials))
    return _take_found(table, options)


def _with_outcome(table: TableText, options: TableOptions) -> TableOptions:
    """Map the one column that is called an outcome, and holds nothing but yes and no."""
    named = [name for name in table.left if plain_name(name) in OUTCOME_LIKE]
    if "recorded" in table.header or len(named) != 1:
        return options
    place = table.header.index(named[0])
    texts = [cells[place] for _, cells in table.grid[1:] if place < len(cells)]
    if not all(t.strip().lower() in UNKNOWN or answer_of(t) is not None for t in texts):
        return options
    mapped = ",".join(filter(None, (options.map, f"outcome={named[0]}")))
    return replace(options, map=mapped)


def _surely_percent(rows: Sequence[SourceRow], options: TableOptions) -> Sequence[SourceRow]:
    """Ask where all of ``rate_percent`` lie in 0..1: percent, or shares that were not scaled?"""
    texts = [row.figure("rate_percent") for row in rows]
    try:
        numbers = [float(text) for text in texts if text and not text.endswith("%")]
    except ValueError:
        return rows
    if not holds_fractions(numbers):
        return rows
    if not options.yes:
        raise DoubtfulTableError(
            f"{rows[0].path.name}: all of rate_percent lie in 0..1, so they look like shares of 1. "
            "If they are shares say --yes; if they are percent write the sign: 0.5 %."
        )
    return [
        replace(row, values={**row.values, "rate": text, "rate_percent": ""})
        for row, text in zip(rows, texts, strict=True)
    ]


def _take_found(table: TableText, options: TableOptions) -> Taken:
    """Read a table by its words and what its cells can be."""
    found = read_found(table.path, table.grid, options)
    kind, reach = ("rates", ranges(found.rates)) if found.rates else ("trials", "")
    summary = f"{table.path.name}: {'; '.join(filter(None, (reach, *found.notes)))}"
    return Taken(
        path=table.path, kind=kind, summary=summary, trials=found.trials, rates=found.rates
    )


def ranges(rates: Sequence[RateRecord]) -> str:
    """Say in a few words what rates were understood: groups, and how far each side reaches."""
    groups = len({(r.task, r.condition, r.policy) for r in rates})
    parts = []
    for side in dict.fromkeys(r.side for r in rates):
        shares = [100 * float(r.rate) for r in rates if r.side == side]
        low, high = (f"{end:.3g}" for end in (min(shares), max(shares)))
        parts.append(f"{side} {low} to {high} %" if low != high else f"{side} {low} %")
    without = sum(r.n is None for r in rates)
    lacks = f"; {without} of {len(rates)} rates without n" if without else ""
    return f"{groups} group{'' if groups == 1 else 's'}; {', '.join(parts)}{lacks}"


def _refuse_unknown(options: TableOptions, known: Sequence[str]) -> None:
    """Refuse a mapping onto a column that no table has."""
    for name in options.mapped:
        if name not in known:
            names = ", ".join(dict.fromkeys(("outcome", *known)))
            likely = difflib.get_close_matches(name, ("outcome", *known), n=1)
            hint = f" Did you mean {likely[0]}?" if likely else ""
            raise UsageError(f"--map {name}=...: no such column.{hint} There are: {names}.")


def _taken_rates(path: Path, records: Sequence[RateRecord], options: TableOptions) -> Taken:
    table = open_table(path, RATE_COLUMNS, options)
    understood = f"{table.understood('rates', len(records))}; {ranges(records)}"
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
