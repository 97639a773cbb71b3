"""What the evaluator measured in a run, from its index; the index is made anew where it is old."""

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from threading import Lock
from typing import Any

from bridge.episode.run_folder import RunFolder
from evaluator.report.review import refresh
from evaluator.result import Measurement, Results, load_results
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

WAITED_FOR = 3_000
"""Files of a run that a page waits for; a larger run is brought up to date behind the page."""
IMPORTED = "imported"
"""Kind of an episode that is a motion from elsewhere."""
RENDERS = "image."
"""Begins the ids of numbers about folders of renders."""
LISTS = ("exclusions", "missing", "answers", "notes", "tasks", "tables")
NOTHING: dict[str, Any] = {
    **dict.fromkeys(LISTS, ()),
    "num_exclusions": 0,
    "close_pp": 0.0,
    "worst_view": None,
}
"""What an index says at least."""
LOOKED_AT_S = 5.0
"""A larger run's files are looked at again after this; its folders at each page."""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """The numbers and trials of one run; what is not there is empty, with a reason."""

    run: RunFolder
    index: ReviewIndex | None
    """None while a large run that nobody evaluated is read for the first time."""
    is_old: bool = False
    """Whether files of a large run changed since."""
    is_being_updated: bool = False
    """Whether another process reads them now."""

    @property
    def about(self) -> dict[str, Any]:
        """What the index says besides trials and files."""
        return NOTHING | ({} if self.index is None else self.index.about)

    @property
    def has_results(self) -> bool:
        """Whether the run was evaluated and its results can be read."""
        return self.index is not None and self.about["results_reason"] is None

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
        """The numbers of ``results.json``; none before ``robot-gst evaluate``."""
        return () if self.index is None else self.index.measurements

    @property
    def results(self) -> Results | None:
        """The whole of ``results.json``, with every table."""
        return _results(self.run, stamp_of(self.run.path / RESULTS)) if self.has_results else None

    @property
    def comparison_reason(self) -> str | None:
        """Why the trials cannot be compared."""
        found = self.about.get("comparison_reason")
        return found if isinstance(found, str) else None

    @property
    def stand_in(self) -> bool | None:
        """Whether the recorded side is a simulated laboratory; None when nothing says so."""
        found = self.about.get("stand_in")
        return found if isinstance(found, bool) else None

    def outdated(self) -> str | None:
        """Say what of a trial is not as it was when the stored numbers were computed."""
        found = self.about.get("outdated")
        return found if isinstance(found, str) else None

    def row(self, episode_id: str) -> TrialRow | None:
        """Return the trial of one episode."""
        return None if self.index is None else self.index.trial(episode_id)


@lru_cache(maxsize=2)
def _results(run: RunFolder, _stamp: str) -> Results:
    return load_results(run.path)


@dataclass
class _Known:
    """What this process knows of one run."""

    state: RunState | None = None
    folders: tuple[str, ...] = ()
    looked_s: float = 0.0
    unwritten: bytes | None = None
    """The index of a run that cannot be written."""
    tried: str = ""
    """The state that was last brought up to date."""
    update: "subprocess.Popen[bytes] | None" = None
    asking: Lock = field(default_factory=Lock)


_KNOWN: dict[RunFolder, _Known] = {}
_ADDING = Lock()


def judge(run: RunFolder) -> Judgement:
    """Return what is known of a run; a small one that changed is read again first."""
    with _ADDING:
        known = _KNOWN.setdefault(run, _Known())
    with known.asking:  # two pages opened at once wait for one answer instead of asking twice
        state = _state(run, known)
        index = _open(run, known)
        if index is not None and _holds(index, state, known):
            return Judgement(run=run, index=index)
        if state.num_files > WAITED_FOR:
            is_read = _update_behind(run, known, state)
            return Judgement(run=run, index=index, is_old=True, is_being_updated=is_read)
        known.unwritten, known.tried = refresh(run), state.digest
        return Judgement(run=run, index=_open(run, known))


def _holds(index: ReviewIndex, state: RunState, known: _Known) -> bool:
    if index.about["state"] != state.digest:
        return False
    return known.tried == state.digest or not index.about["changed_meanwhile"]


def _open(run: RunFolder, known: _Known) -> ReviewIndex | None:
    path = index_path(run)
    sources: Sequence[Any] = (path, known.unwritten) if path.is_file() else (known.unwritten,)
    for source in sources:
        try:
            return None if source is None else _opened(source, stamp_of(path))
        except UnusableIndexError:
            continue
    return None


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
    is_large = known.state is not None and known.state.num_files > WAITED_FOR
    if known.state is not None and is_large and is_recent and folders == known.folders:
        return known.state
    known.state, known.folders = state_of(run), folders
    known.looked_s = time.monotonic()
    return known.state


def _update_behind(run: RunFolder, known: _Known, state: RunState) -> bool:
    """Let another process read a large run, once for each state: it takes minutes and memory.

    Returns:
        Whether one reads it now.
    """
    is_reading = known.update is not None and known.update.poll() is None
    if is_reading or known.tried == state.digest:
        return is_reading
    known.tried = state.digest
    known.update = subprocess.Popen(
        [sys.executable, "-m", "evaluator.report.review", str(run.path)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    return True


def stop_updates() -> None:
    """End what still reads large runs; what was read so far is kept for the next time."""
    for known in _KNOWN.values():
        if known.update is not None and known.update.poll() is None:
            known.update.terminate()
            known.update.wait()
