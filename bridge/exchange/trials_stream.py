"""A trials CSV of any length, counted in constant memory.

Rows are counted by everything but their id, start and success probability; each distinct row is
checked once, as ``read_trials`` checks it. Ids are compared through 64-bit hashes sorted on disk,
8 bytes for each trial in the folder for temporary files; what looks doubled is read again.
"""

import tempfile
from array import array
from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import numpy as np

from bridge.errors import PathNotFoundError
from bridge.exchange.trials_csv import (
    COLUMNS,
    SourceRow,
    TableError,
    TrialRecord,
    check_header,
    check_unit,
    numbered_lines,
    read_trial,
)

FLUSH = 2**16
"""Hashes kept in memory before they go to disk."""
PARTS = 256
MAX_PATTERNS = 100_000
"""Distinct rows beyond which a table is not one of tasks, conditions and policies."""
SINGLE = ("trial_id", "start_id", "p_success")
"""Columns that belong to one trial and are not counted."""


class _Layout:
    """Where the columns are."""

    def __init__(self, path: Path, header: list[str]) -> None:
        """Find the columns that every row is asked for."""
        self.path = path
        self.header = header
        self.id_at = header.index("trial_id")
        self.p_at = header.index("p_success") if "p_success" in header else None
        self.counted = itemgetter(*(i for i, n in enumerate(header) if n not in SINGLE), -1)

    def row(self, number: int, cells: list[str]) -> SourceRow:
        """Name the fields of one row."""
        values = dict(zip(self.header, cells, strict=True))
        return SourceRow(path=self.path, row=number, values=values)


def count_trials(path: Path) -> list[tuple[TrialRecord, int]]:
    """Count equal rows of a trials CSV; their ids are empty.

    Raises:
        PathNotFoundError: When the file is not there.
        TableError: Naming the row that cannot be believed, or that is there twice.
    """
    if not path.is_file():
        raise PathNotFoundError(path=path, what="table", hint="Give a CSV file.")
    with tempfile.TemporaryDirectory(prefix="robot-gst-ids-") as folder, _Ids(Path(folder)) as ids:
        found = _count(path, ids)
        suspects = ids.doubled()
    if suspects:
        _confirm(path, suspects)
    if not found:
        raise TableError(
            path=path, row=None, found="a header without rows", hint="Add at least one row"
        )
    return found


def _count(path: Path, ids: "_Ids") -> list[tuple[TrialRecord, int]]:
    counts: dict[tuple[str, ...], int] = {}
    trials: list[TrialRecord] = []
    units: dict[str, tuple[str, int]] = {}
    for layout, number, cells in _rows(path):
        trial_id = cells[layout.id_at].strip()
        if not trial_id:
            raise layout.row(number, cells).refuse("trial_id is empty", "Every trial needs one")
        ids.add(trial_id)
        if layout.p_at is not None and cells[layout.p_at]:
            layout.row(number, cells).fraction("p_success")
        pattern = layout.counted(
            [*cells, ""]
        )  # one more, so that it is a tuple even for one column
        known = counts.get(pattern)
        if known is not None:
            counts[pattern] = known + 1
            continue
        row = layout.row(number, cells)
        trial = read_trial(row)
        check_unit(row, trial, units)
        if len(counts) == MAX_PATTERNS:
            hint = "Columns other than trial_id, start_id and p_success must repeat"
            raise row.refuse(f"{MAX_PATTERNS} different rows before it", hint)
        counts[pattern] = 1
        trials.append(replace(trial, trial_id="", start_id=None, p_success=None))
    return list(zip(trials, counts.values(), strict=True))


def _rows(path: Path) -> Iterator[tuple[_Layout, int, list[str]]]:
    """Yield the rows with their numbers as a spreadsheet has them; comments are left out."""
    layout: _Layout | None = None
    for number, cells in numbered_lines(path):
        if layout is None:
            header = [name.strip() for name in cells]
            check_header(path, number, header, ("trial_id", "task"), COLUMNS)
            layout = _Layout(path, header)
            continue
        if len(cells) != len(layout.header):
            found = f"{len(cells)} fields where the header has {len(layout.header)}"
            hint = "Quote fields that contain commas"
            raise TableError(path=path, row=number, found=found, hint=hint)
        yield layout, number, cells


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


def _confirm(path: Path, suspects: set[int]) -> None:
    """Refuse the first id that is really there twice; equal hashes alone prove nothing."""
    seen: dict[str, int] = {}
    for layout, number, cells in _rows(path):
        row = layout.row(number, cells)
        trial_id = row.text("trial_id")
        if hash(trial_id) not in suspects:
            continue
        if trial_id in seen:
            raise row.refuse(
                f"trial_id {trial_id!r} stands in row {seen[trial_id]} already",
                "Give each trial its own id, or remove the copy",
            )
        seen[trial_id] = row.row
