"""A trials CSV of any length, counted in constant memory.

Rows are counted by everything but their id, start and success probability; each distinct row is
checked once, as ``read_trials`` checks it. Ids are compared through 64-bit hashes sorted on disk,
8 bytes for each trial in the folder for temporary files; what looks doubled is read again.
"""

import tempfile
from array import array
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import numpy as np

from bridge.exchange.table_text import (
    AS_SAVED,
    SourceRow,
    TableError,
    TableOptions,
    TableText,
)
from bridge.exchange.trials_csv import TrialRecord, check_unit, open_trials, read_trial

FLUSH = 2**16
"""Hashes kept in memory before they go to disk."""
PARTS = 256
MAX_PATTERNS = 100_000
"""Distinct rows beyond which a table is not one of tasks, conditions and policies."""
SINGLE = ("trial_id", "start_id", "p_success", "progress", "sim_progress")
"""Columns that belong to one trial and are not counted."""


def count_trials(path: Path, options: TableOptions = AS_SAVED) -> list[tuple[TrialRecord, int]]:
    """Count equal rows of a trials CSV; their ids are empty."""
    table = open_trials(path, options)
    with tempfile.TemporaryDirectory(prefix="robot-gst-ids-") as folder, _Ids(Path(folder)) as ids:
        found = _count(table, ids)
        suspects = ids.doubled()
    if suspects:
        _confirm(table, suspects)
    if not found:
        raise TableError(
            path=path, row=None, found="a header without rows", hint="Add at least one row"
        )
    return found


def _count(table: TableText, ids: "_Ids") -> list[tuple[TrialRecord, int]]:
    counts: dict[tuple[str, ...], int] = {}
    trials: list[TrialRecord] = []
    units: dict[str, tuple[str, int]] = {}
    header = table.header
    id_at = header.index("trial_id") if "trial_id" in header else None
    fractions = [n for n in ("p_success", "progress", "sim_progress") if n in header]
    checked = [(name, header.index(name)) for name in fractions]
    skipped = {*SINGLE, *table.left}
    # One more field, the empty text at the end, so that it is a tuple even for one column.
    counted = itemgetter(*(i for i, name in enumerate(header) if name not in skipped), -1)
    for number, cells in table.lines():
        if id_at is not None:
            trial_id = cells[id_at].strip()
            if not trial_id:
                raise table.row(number, cells).refuse("trial_id is empty", "Every trial needs one")
            ids.add(trial_id)
        for name, at in checked:
            if not _is_fraction(cells[at]):
                table.row(number, cells).fraction(name)
        pattern = counted([*cells, ""])
        known = counts.get(pattern)
        if known is not None:
            counts[pattern] = known + 1
            continue
        row = table.row(number, cells)
        trial = read_trial(row)
        check_unit(row, trial, units)
        if len(counts) == MAX_PATTERNS:
            hint = "Columns other than trial_id, start_id and p_success must repeat"
            raise row.refuse(f"{MAX_PATTERNS} different rows before it", hint)
        counts[pattern] = 1
        alike = replace(trial, trial_id="", start_id=None, p_success=None)
        trials.append(replace(alike, progress=None, sim_progress=None))
    return list(zip(trials, counts.values(), strict=True))


def _is_fraction(text: str) -> bool:
    """Say of most fields without further ado that they hold a number from 0 to 1, or nothing."""
    try:
        return not text or 0 <= float(text) <= 1
    except ValueError:
        return False


class _Ids:
    """Hashes of ids, shared out by their last byte over files that fit in memory one by one."""

    def __init__(self, folder: Path) -> None:
        """Begin with an empty folder."""
        self._waiting = array("q")
        self._files = [(folder / f"{part}.ids").open("w+b") for part in range(PARTS)]

    def __enter__(self) -> "_Ids":
        """Files are open from the start."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the files; the folder goes with its owner."""
        for file in self._files:
            file.close()

    def add(self, trial_id: str) -> None:
        """Take in one id."""
        self._waiting.append(hash(trial_id))
        if len(self._waiting) == FLUSH:
            self._flush()

    def doubled(self) -> set[int]:
        """Return the hashes that came more than once."""
        self._flush()
        found: set[int] = set()
        for file in self._files:
            file.seek(0)
            hashes = np.sort(np.frombuffer(file.read(), dtype=np.int64))
            found.update(hashes[1:][hashes[1:] == hashes[:-1]].tolist())
        return found

    def _flush(self) -> None:
        hashes = np.frombuffer(self._waiting, dtype=np.int64)
        parts = hashes % PARTS
        order = np.argsort(parts, kind="stable")
        edges = np.searchsorted(parts[order], np.arange(PARTS + 1))
        ordered = hashes[order]
        for part, file in enumerate(self._files):
            file.write(ordered[edges[part] : edges[part + 1]].tobytes())
        self._waiting = array("q")


def _confirm(table: TableText, suspects: set[int]) -> None:
    """Refuse the first id that is really there twice; equal hashes alone prove nothing."""
    seen: dict[str, int] = {}
    for number, cells in table.lines():
        row: SourceRow = table.row(number, cells)
        trial_id = row.text("trial_id")
        if hash(trial_id) not in suspects:
            continue
        if trial_id in seen:
            raise row.refuse(
                f"trial_id {trial_id!r} stands in row {seen[trial_id]} already",
                "Give each trial its own id, or remove the copy",
            )
        seen[trial_id] = number
