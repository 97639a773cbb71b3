"""Two runs of the same recorded trials: what differs, as the evaluator says."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from dashboards import wording
from dashboards.comparison import WAITED_FOR, Judgement
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare.against import against_tables
from evaluator.compare.run import ReadRun, read_run
from evaluator.report.page import grid
from evaluator.report.wording import cell_text
from evaluator.result import Measurement, Table
from evaluator.review_index import state_of

DIFFERENCES = "against"
"""The table of paired differences; it is drawn, too."""
MOST_ROWS = 200
MOST_NUMBERS = 40
NUMBERS = ("agreement.", "rate.", "gain.pp.", "views.")
"""Numbers of two runs that are laid side by side where the trials are not the same."""


@dataclass(frozen=True, kw_only=True)
class Bar:
    """One paired difference with its interval, for a drawing from -1 to 1."""

    name: str
    value: float
    low: float | None
    high: float | None
    text: str


@dataclass(frozen=True, kw_only=True)
class ShownTable:
    """One table of the evaluator as it is printed."""

    id: str
    title: str
    note: str
    heads: tuple[tuple[str, bool], ...]
    rows: tuple[tuple[str, ...], ...]
    num_rows: int


@dataclass(frozen=True, kw_only=True)
class NumberPair:
    """One number of both runs."""

    id: str
    definition: str
    mine: Measurement | None
    theirs: Measurement | None


@dataclass(frozen=True, kw_only=True)
class ComparePage:
    """Everything the template needs."""

    others: tuple[str, ...]
    """Runs to hold this one against."""
    names: tuple[str, str] | None
    """What is compared; None while nothing is chosen."""
    sentences: tuple[str, ...]
    bars: tuple[Bar, ...]
    tables: tuple[ShownTable, ...]
    numbers: tuple[NumberPair, ...]
    """Where two runs share no trial: the numbers that differ."""
    num_numbers: int
    why_not: str
    """Why there are no paired differences; empty where there are."""
    command: str
    """Does the same without these pages."""
    has_replays: bool
    """Whether settings of replays could differ at all."""
    linked: frozenset[str]
    """Trials that have a page of their own."""


def build_compare(
    run: RunFolder,
    judgement: Judgement,
    others: Mapping[str, Judgement | None],
    query: Mapping[str, str],
) -> ComparePage:
    """Gather the comparison that an address asks for.

    Args:
        others: Runs that it can be held against, by name; None but for the chosen one.
        query: ``with`` names another run.
    """
    is_small = judgement.index is not None and state_of(run).num_files <= WAITED_FOR
    rows = judgement.rows if is_small else ()
    shared: dict[str, Any] = {
        "others": tuple(others),
        "has_replays": any(row.planned_replay for row in rows),
        "linked": frozenset(row.episode for row in rows if row.file),
    }
    theirs = others.get(query.get("with", ""))
    if theirs is None:
        return _page(shared, None, _stored(judgement))
    name = query["with"]
    try:
        return _of_runs(run, judgement, name, theirs, shared)
    except GstError as error:
        return _page(shared, (run.path.resolve().name, name), (), why_not=str(error))


def _stored(judgement: Judgement) -> list[Table]:
    """What ``evaluate --against`` left in the results."""
    try:
        results = judgement.results
    except GstError:  # they went away since
        results = None
    tables = () if results is None else results.tables
    return [table for table in tables if table.id in ("against", "against_settings")]


def _state(judgement: Judgement) -> str:
    return str(judgement.about.get("state", ""))


@lru_cache(maxsize=4)
def _read(run: RunFolder, _state: str) -> ReadRun:
    with SummaryCache(run.results_dir / FOLDER) as cache:
        return read_run(run, cache)


def _of_runs(
    run: RunFolder,
    judgement: Judgement,
    name: str,
    theirs: Judgement,
    shared: Mapping[str, Any],
) -> ComparePage:
    names = (run.path.resolve().name, name)
    paths = [shlex.quote(str(each)) for each in (run.path, theirs.run.path)]
    command = f"robot-gst evaluate {paths[0]} --against {paths[1]}"
    known: dict[str, Any] = {"command": command}
    if max(state_of(each).num_files for each in (run, theirs.run)) > WAITED_FOR:
        why = "These runs are too large to be compared while a page waits; the command does it."
        return _page(shared, names, (), why_not=why, **known)
    try:
        tables = _against(run, theirs.run, names, (_state(judgement), _state(theirs)))
    except GstError as error:
        pairs = _numbers(judgement.measurements, theirs.measurements)
        return _page(shared, names, (), why_not=str(error), numbers=pairs, **known)
    return _page(shared, names, tables, **known)


@lru_cache(maxsize=16)
def _against(
    run: RunFolder, other: RunFolder, names: tuple[str, str], states: tuple[str, str]
) -> tuple[Table, ...]:
    mine, theirs = _read(run, states[0]), _read(other, states[1])
    return against_tables(mine.rows, theirs.rows, names=names, trials=(mine.trials, theirs.trials))


def _numbers(mine: Sequence[Measurement], theirs: Sequence[Measurement]) -> list[NumberPair]:
    """Lay numbers of the same id side by side; those that are alike are left out."""
    sides = [{m.id: m for m in side if m.id.startswith(NUMBERS)} for side in (mine, theirs)]
    found = []
    for name in dict.fromkeys((*sides[0], *sides[1])):
        first, second = (side.get(name) for side in sides)
        known = [each for each in (first, second) if each is not None and each.value is not None]
        same = first is not None and second is not None and first.value == second.value
        if known and not (same and first and second and first.interval == second.interval):
            definition = known[0].definition
            found.append(NumberPair(id=name, definition=definition, mine=first, theirs=second))
    return found


def _page(
    shared: Mapping[str, Any],
    names: tuple[str, str] | None,
    tables: Sequence[Table],
    *,
    why_not: str = "",
    numbers: Sequence[NumberPair] = (),
    command: str = "",
) -> ComparePage:
    bars = tuple(bar for table in tables if table.id == DIFFERENCES for bar in _bars(table))
    return ComparePage(
        **shared,
        names=names,
        sentences=() if names is None else tuple(_sentence(bar, names) for bar in bars),
        bars=bars,
        tables=tuple(map(_shown, tables)),
        numbers=tuple(numbers[:MOST_NUMBERS]),
        num_numbers=len(numbers),
        why_not=why_not,
        command=command,
    )


def _bars(table: Table) -> list[Bar]:
    found = []
    for row in table.rows:
        cells = dict(zip(table.columns, row, strict=True))
        value, low, high = (
            float(cell) if isinstance(cell := cells.get(name), int | float) else None
            for name in ("difference", "low", "high")
        )
        if value is not None:
            text = f"{value:+.3f}" + ("" if low is None else f" ({low:+.3f} to {high:+.3f})")
            found.append(
                Bar(
                    name=str(cells["number"]),
                    value=value,
                    low=low,
                    high=high,
                    text=text.replace("-", "−"),
                )
            )
    return found


def _sentence(bar: Bar, names: tuple[str, str]) -> str:
    """Say what an interval of a difference means."""
    if bar.low is None or bar.high is None:
        return f"{bar.name}: {'no interval' if bar.value else 'the same in both'}."
    if bar.low <= 0 <= bar.high:
        return f"{bar.name}: no difference is shown."
    return f"{bar.name}: {'higher' if bar.low > 0 else 'lower'} with {names[0]}."


def _shown(table: Table) -> ShownTable:
    heads, rows = grid(table)
    return ShownTable(
        id=table.id,
        title=table.title,
        note=table.note,
        heads=tuple(heads),
        rows=tuple(tuple(_text(cell) for cell in row) for row in rows[:MOST_ROWS]),
        num_rows=len(table.rows),
    )


def _text(cell: Any) -> str:
    if isinstance(cell, float):
        return wording.number(cell, "1")
    return cell_text(cell)
