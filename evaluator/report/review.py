"""Write the index that the review pages read: trials, files, numbers, and what they mean."""

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, PathNotFoundError
from bridge.whole_file import write_whole
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare.failures import failure_kind, start_regions
from evaluator.compare.rows import Comparison, TrialRow
from evaluator.compare.run import compare_run
from evaluator.compare.stages import first_failed_stage
from evaluator.quantity import slug
from evaluator.report.front import CLOSE_PP, answer, conclusions, front, next_trials, sentence
from evaluator.report.page import grid
from evaluator.report.wording import cell_text
from evaluator.result import Measurement, Results, Table, load_results
from evaluator.review_index import (
    FACETS,
    NO_RESULTS,
    IndexedFile,
    IndexedTrial,
    index_path,
    plain_record,
    severity,
    state_of,
    written_index,
)

FROM_TRIALS = ("agreement.", "gain.", "rate.")
"""Numbers that follow from trials, labels and replays, whatever else was asked of an evaluation."""
DIGITS = 9
"""Two versions of the program may sum up in another order."""
SHOWN_EXCLUSIONS = 200
"""Of those left out; ``results.json`` has all."""
SHOWN_ROWS = 24
"""Of a table of a run without trials; the report has all."""


@dataclass(frozen=True, kw_only=True)
class _Stored:
    """``results.json``, or why there is none."""

    results: Results | None
    reason: str | None = None


def refresh(run: RunFolder) -> bytes:
    """Compare the run as it is now with its stored results; write and return its index.

    Where the run cannot be written, the index is only returned.
    """
    began_ns = time.time_ns()
    comparison, reason = None, None
    try:
        with SummaryCache(run.results_dir / FOLDER) as kept:
            comparison = compare_run(run, cache=kept)
    except GstError as error:
        reason = str(error)
    return _write(run, comparison, _load(run), reason, began_ns)


def index_run(run: RunFolder, comparison: Comparison, results: Results, began_ns: int) -> None:
    """Write the index of an evaluation that has just been written.

    Args:
        began_ns: When it began to read; what changed since is looked at again [ns since 1970].
    """
    _write(run, comparison, _Stored(results=results), None, began_ns)


def _load(run: RunFolder) -> _Stored:
    try:
        return _Stored(results=load_results(run.path))
    except PathNotFoundError:
        return _Stored(results=None, reason=NO_RESULTS)
    except GstError as error:
        return _Stored(results=None, reason=str(error))


def _write(
    run: RunFolder,
    comparison: Comparison | None,
    stored: _Stored,
    reason: str | None,
    began_ns: int,
) -> bytes:
    state = state_of(run)
    rows = [] if comparison is None else list(comparison.rows)
    motions = () if comparison is None else comparison.motions
    off = {
        motion.episode: (motion.path_max_m, motion.lag_s)
        for motion in motions
        if (motion.side, motion.against) == ("recorded", "planned")
    }
    regions = start_regions(rows)
    trials = sorted(
        (
            _trial(row, off.get(row.episode, (None, None)), regions.get(row.episode, ""))
            for row in rows
        ),
        key=severity,
    )
    about = {
        "state": state.digest,
        "as_of_ns": began_ns,
        "changed_meanwhile": state.newest_ns >= began_ns,
        "comparison_reason": reason,
        "outdated": _outdated(stored.results, comparison),
        **_about(comparison, stored, has_trials=bool(rows)),
    }
    slug_of = cache(slug)
    content = written_index(
        ((each, {name: slug_of(getattr(each, name)) for name in FACETS}) for each in trials),
        _files(run, comparison, {trial.file for trial in trials}),
        about,
    )
    path = index_path(run)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)
    except OSError:  # a read-only run is shown all the same, and read again next time
        pass
    return content


def _trial(row: TrialRow, off: tuple[float | None, float | None], region: str) -> IndexedTrial:
    kind = failure_kind(row)
    shared = {each.name for each in fields(IndexedTrial)} & vars(row).keys()
    return IndexedTrial(
        **{name: getattr(row, name) for name in shared},
        file="" if row.path is None else row.path.name,
        failed_stage=first_failed_stage(row) if row.recorded is False else "",
        distance_m=off[0],
        lag_s=off[1],
        fail_cause="" if kind is None else kind.cause,
        fail_stage="" if kind is None else kind.stage,
        fail_bodies="" if kind is None else kind.bodies,
        start_region=region,
    )


def _about(comparison: Comparison | None, stored: _Stored, *, has_trials: bool) -> dict[str, Any]:
    results = stored.results
    stand_in = next(
        (s.stand_in for s in (results, comparison) if s is not None and s.stand_in is not None),
        None,
    )
    about: dict[str, Any] = {"results_reason": stored.reason, "stand_in": stand_in}
    if results is None:
        return about | {"measurements": [], "exclusions": [], "num_exclusions": 0, "missing": []}
    lines = conclusions(results)
    first = front(results)
    failures = next((t for t in results.tables if t.id == "failures"), None)
    return about | {
        "measurements": [plain_record(each) for each in results.measurements],
        "exclusions": [dict(vars(each)) for each in results.exclusions[:SHOWN_EXCLUSIONS]],
        "num_exclusions": len(results.exclusions),
        "missing": list(results.missing),
        "summary": first.summary,
        "notes": [list(note) for note in first.notes],
        "close_pp": CLOSE_PP,
        "tasks": [
            {
                "task": str(line["task"]),
                "slug": slug(str(line["task"])),
                "answer": answer(line),
                "sentence": sentence(line),
            }
            for line in lines
        ],
        "next_trials": next_trials(lines),
        "failures": [] if failures is None else [list(row) for row in failures.rows],
        "tables": [] if has_trials else [_shown(t) for t in results.tables if t.rows],
    }


def _shown(table: Table) -> dict[str, Any]:
    heads, rows = grid(table)
    return {
        "title": table.title,
        "note": table.note,
        "heads": heads,
        "rows": [[cell_text(cell) for cell in row] for row in rows[:SHOWN_ROWS]],
        "num_rows": len(rows),
    }


def _outdated(results: Results | None, comparison: Comparison | None) -> list[Any] | None:
    """Return the first number that differs between ``results.json`` and the files of the run.

    Returns:
        The stored value and the present one; None on a side that does not have it. None when all
        numbers are up to date, or when there is nothing to compare them with.
    """
    if results is None or comparison is None:
        return None
    stored, now = (
        {m.id: m for m in side.measurements if m.id.startswith(FROM_TRIALS)}
        for side in (results, comparison)
    )
    for name in dict.fromkeys((*stored, *now)):
        if _counts(stored.get(name)) != _counts(now.get(name)):
            pair = (stored.get(name), now.get(name))
            return [None if side is None else plain_record(side) for side in pair]
    return None


def _counts(measurement: Measurement | None) -> tuple[float | None, int | None, int | None]:
    """What makes a number another one; its interval is a matter of how it was asked for."""
    if measurement is None:
        return None, None, None
    value = measurement.value
    return None if value is None else round(value, DIGITS), measurement.k, measurement.n


def _files(
    run: RunFolder, comparison: Comparison | None, trials: set[str]
) -> Iterator[IndexedFile]:
    """Name what is no trial; what the comparison has read well is not opened again."""
    derived = {} if comparison is None else comparison.provenance.get("derived", {})
    read = {name.rpartition("/")[2] for name in derived}
    for path in run.episodes():
        if path.name not in trials:
            yield _file(run, path)
    for path in run.derived():
        if path.name not in read:
            found = _file(run, path)
            if found.error:
                yield found
    for path in run.unfinished():
        reason = "not finished: still being recorded, or its recorder was stopped"
        yield IndexedFile(name=str(path.relative_to(run.path)), error=reason)


def _file(run: RunFolder, path: Path) -> IndexedFile:
    try:
        episode = Episode.open(path)
        info = episode.info
        return IndexedFile(
            name=path.stem,
            kind=info.kind,
            task=info.task,
            source=info.robot or info.cell,
            duration_s=episode.duration_s,
        )
    except GstError as error:
        return IndexedFile(name=str(path.relative_to(run.path)), error=str(error))


if __name__ == "__main__":  # the dashboard reads a large run in another process
    refresh(RunFolder.open(Path(sys.argv[1])))
