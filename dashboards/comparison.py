"""What the evaluator measured in a run, from its index; no page waits for what is not there yet."""

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import lru_cache
from tempfile import TemporaryFile
from threading import Lock
from typing import IO, Any

from bridge.episode.run_folder import RunFolder
from evaluator.result import Measurement
from evaluator.review_index import (
    RESULTS,
    ReviewIndex,
    RunState,
    Selection,
    UnusableIndexError,
    index_path,
    stamp_of,
    state_of,
)
from evaluator.trial_row import TrialRow

LARGE = 3_000
"""Files of a run that are not looked at for every page."""
NICENESS = 15
"""Of the process that reads a run: whoever records or replays meanwhile comes first."""
IMPORTED = "imported"
"""Kind of an episode that is a motion from elsewhere."""
RENDERS = "image."
"""Begins the ids of numbers about folders of renders."""
LISTS = ("exclusions", "missing", "answers", "notes", "tasks", "tables", "views")
REASONS = ("comparison_reason", "results_reason", "outdated", "stand_in")
NOTHING: dict[str, Any] = {**dict.fromkeys(LISTS, ()), **dict.fromkeys(REASONS)}
NOTHING |= {"num_exclusions": 0, "close_pp": 0.0}
"""What an index says at least."""
LOOKED_AT_S = 5.0
"""A larger run's files are looked at again after this; its folders at each page."""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """The numbers and trials of one run; what is not there is empty, with a reason."""

    run: RunFolder
    index: ReviewIndex | None
    """None while a run that nobody evaluated is read for the first time."""
    is_old: bool = False
    """Whether files of the run changed since."""
    is_being_updated: bool = False
    """Whether another process reads them now, or will next."""

    @property
    def about(self) -> dict[str, Any]:
        """What the index says besides trials and files."""
        return NOTHING | ({} if self.index is None else self.index.about)

    @property
    def has_results(self) -> bool:
        """Whether there are numbers."""
        return bool(self.measurements)

    @property
    def has_methods(self) -> bool:
        """Whether renders of several methods were compared, which no trial shows."""
        return any(item.id.startswith(RENDERS) for item in self.measurements)

    @property
    def rows(self) -> tuple[TrialRow, ...]:
        """All recorded trials, disagreements first."""
        return () if self.index is None else self.index.trials(Selection())

    @property
    def only_motions(self) -> bool:
        """Whether the run holds imported motions and not one trial."""
        if self.index is None or self.index.count(Selection()):
            return False
        files, _ = self.index.files(broken=False)
        return any(file.kind == IMPORTED and file.task for file in files)

    @property
    def only_a_table(self) -> bool:
        """Whether the results are of a table: there is no recording."""
        return self.has_results and not self.has_methods and not self.run.episodes()

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """The numbers of ``results.json``, or newer ones where the run changed since."""
        return () if self.index is None else self.index.measurements

    def row(self, episode_id: str) -> TrialRow | None:
        """Return the trial of one episode."""
        return None if self.index is None else self.index.trial(episode_id)


@dataclass
class _Known:
    """What this process knows of one run."""

    state: RunState | None = None
    folders: tuple[str, ...] = ()
    looked_s: float = 0.0
    told: bytes | None = None
    """The index that the last reader told: it may lie nowhere, if the run cannot be written."""
    tried: RunState | None = None
    """The state that was last brought up to date."""
    update: "subprocess.Popen[bytes] | None" = None
    output: IO[bytes] | None = None
    """What the reader tells."""

    def look(self) -> bool:
        """Whether another process reads the run now; what one told that has ended is kept."""
        if self.update is None or self.update.poll() is None:
            return self.update is not None
        if self.output is not None:
            with self.output as output:
                output.seek(0)
                self.told = output.read() or self.told
            self.output = None
        return False


_KNOWN: dict[RunFolder, _Known] = {}
_ASKING = Lock()
"""Two pages opened at once do not start two readers."""


def judge(run: RunFolder, *, reads: bool = True) -> Judgement:
    """Return what is known of a run; what changed since is read behind the page, if asked for."""
    with _ASKING:
        known = _KNOWN.setdefault(run, _Known())
        is_read, state = known.look(), _state(run, known)
        index = _open(run, known)
        if index is not None and index.is_of(state):
            return Judgement(run=run, index=index)
        if reads and not is_read and known.tried != state:
            is_read = any(other.look() for other in _KNOWN.values()) or _read(run, known, state)
        return Judgement(run=run, index=index, is_old=True, is_being_updated=is_read)


def _open(run: RunFolder, known: _Known) -> ReviewIndex | None:
    """Return the index of the present state, else one from before."""
    last = None
    for source in (index_path(run), known.told):
        try:
            index = None if source is None else _opened(source, stamp_of(index_path(run)))
        except UnusableIndexError:
            continue
        if index is not None and known.state is not None and index.is_of(known.state):
            return index
        last = index or last
    return last


@lru_cache(maxsize=8)
def _opened(source: Any, _stamp: str) -> ReviewIndex:
    return ReviewIndex(source)


def _state(run: RunFolder, known: _Known) -> RunState:
    """Look at the files; of a large run only at its folders, for a moment after it was looked at.

    A file that comes, goes or is written whole changes its folder.
    """
    places = (run.episodes_dir, run.derived_dir, run.notes_dir)
    folders = tuple(stamp_of(path) for path in (*places, run.path / RESULTS))
    is_recent = time.monotonic() - known.looked_s < LOOKED_AT_S
    is_large = known.state is not None and known.state.num_files > LARGE
    if known.state is not None and is_large and is_recent and folders == known.folders:
        return known.state
    known.state, known.folders = state_of(run), folders
    known.looked_s = time.monotonic()
    return known.state


def _read(run: RunFolder, known: _Known, state: RunState) -> bool:
    """Let another process read a run, once for each state: it takes seconds to minutes."""
    known.tried = state
    known.output = TemporaryFile()  # noqa: SIM115  # read once the process has ended
    known.update = subprocess.Popen(
        [sys.executable, "-m", "evaluator.report.review", str(run.path)],
        stdin=subprocess.DEVNULL,
        stdout=known.output,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    os.setpriority(os.PRIO_PROCESS, known.update.pid, NICENESS)
    return True


def stop_updates() -> None:
    """End what still reads a run; what was read so far is kept for the next time."""
    for known in _KNOWN.values():
        if known.update is not None and known.update.poll() is None:
            known.update.terminate()
            known.update.wait()
