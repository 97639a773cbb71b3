"""What the evaluator measured in a run: ``results.json`` where there is one, and the trials."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, PathNotFoundError
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare import Comparison, TrialRow, compare_run
from evaluator.result import Measurement, Results, load_results

_ASKING = Lock()
FROM_TRIALS = ("agreement.", "gain.", "rate.")
"""Numbers that follow from trials, labels and replays, whatever else was asked of an evaluation."""
DIGITS = 9
"""Two versions of the program may sum up in another order."""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """The numbers and rows of one run; parts that are not there are None, with a reason."""

    results: Results | None
    results_reason: str | None
    comparison: Comparison | None
    comparison_reason: str | None

    @property
    def rows(self) -> tuple[TrialRow, ...]:
        """One row per recorded trial."""
        return () if self.comparison is None else self.comparison.rows

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """The numbers of ``results.json``; none before ``robot-gst evaluate``."""
        return () if self.results is None else self.results.measurements

    @property
    def stand_in(self) -> bool | None:
        """Whether the recorded side is a simulated laboratory; None when nothing says so."""
        for source in (self.results, self.comparison):
            if source is not None and source.stand_in is not None:
                return source.stand_in
        return None

    def outdated(self) -> tuple[Measurement | None, Measurement | None] | None:
        """Return the first number that differs between ``results.json`` and the files of the run.

        Returns:
            The stored value and the present one; None on a side that does not have it. None when
            all numbers are up to date, or when there is nothing to compare them with.
        """
        if self.results is None or self.comparison is None:
            return None
        stored, now = (_from_trials(side.measurements) for side in (self.results, self.comparison))
        for name in dict.fromkeys((*stored, *now)):
            if _counts(stored.get(name)) != _counts(now.get(name)):
                return stored.get(name), now.get(name)
        return None

    def row(self, episode_id: str) -> TrialRow | None:
        """Return the row of one episode."""
        return next((row for row in self.rows if row.episode == episode_id), None)

    def measurement(self, measurement_id: str) -> Measurement | None:
        """Return one number, or None when the results do not have it."""
        return next((m for m in self.measurements if m.id == measurement_id), None)


def _from_trials(measurements: Iterable[Measurement]) -> dict[str, Measurement]:
    return {m.id: m for m in measurements if m.id.startswith(FROM_TRIALS)}


def _counts(measurement: Measurement | None) -> tuple[float | None, int | None, int | None]:
    """What makes a number another one; its interval is a matter of how it was asked for."""
    if measurement is None:
        return None, None, None
    value = measurement.value
    return None if value is None else round(value, DIGITS), measurement.k, measurement.n


def agrees(row: TrialRow) -> bool | None:
    """Say whether the planned replay predicted the recorded outcome; None when one is unknown."""
    if row.sim_planned is None or row.recorded is None:
        return None
    return row.sim_planned == row.recorded


def judge(run: RunFolder) -> Judgement:
    """Ask the evaluator about a run; asked again only when a file of the run changed."""
    with _ASKING:  # two pages opened at once wait for one answer instead of asking twice
        return _judge(run, _state_of(run))


def _state_of(run: RunFolder) -> tuple[tuple[str, int, int], ...]:
    files = [*run.episodes(), *run.derived(), run.results_dir / "results.json"]
    files += sorted(run.notes_dir.glob("*")) if run.notes_dir.is_dir() else []
    state = []
    for path in files:
        if path.is_file():
            status = path.stat()
            state.append((str(path), status.st_mtime_ns, status.st_size))
    return tuple(state)


@lru_cache(maxsize=8)
def _judge(run: RunFolder, _state: tuple[tuple[str, int, int], ...]) -> Judgement:
    results, results_reason = None, None
    try:
        results = load_results(run.path)
    except PathNotFoundError:
        results_reason = "no results yet"
    except GstError as error:
        results_reason = str(error)
    comparison, comparison_reason = None, None
    try:
        with SummaryCache(run.results_dir / FOLDER) as cache:
            comparison = compare_run(run, cache=cache)
    except GstError as error:
        comparison_reason = str(error)
    return Judgement(
        results=results,
        results_reason=results_reason,
        comparison=comparison,
        comparison_reason=comparison_reason,
    )
