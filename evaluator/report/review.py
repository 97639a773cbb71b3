"""Write the index that the review pages read: trials, files, numbers, and what they mean."""

import sys
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, file_names
from bridge.errors import GstError
from bridge.whole_file import write_whole
from evaluator import review_index
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare.conclusions import CLOSE_PP
from evaluator.compare.failures import failure_kind, start_regions
from evaluator.compare.images.views import VIEWS_TITLE
from evaluator.compare.motion import MotionSummary
from evaluator.compare.rows import Comparison, TrialRow
from evaluator.compare.run import compare_run, provenance_of, read_run
from evaluator.compare.stages import first_failed_stage
from evaluator.memory import without_collecting
from evaluator.quantity import slug
from evaluator.report.front import IN_NUMBERS, answer, front, rows_of, sentence
from evaluator.report.page import grid
from evaluator.report.wording import cell_text
from evaluator.result import Results, Table, load_results

SHOWN_EXCLUSIONS = 200
"""Of those left out; ``results.json`` has all."""
MADE_OF = ("episodes", "derived", "labels")
"""What numbers follow from, in their provenance."""
SHOWN_ROWS = 24
"""Of a table of a run without trials; the report has all."""


@dataclass(frozen=True, kw_only=True)
class _Read:
    """What the trials of a run say now, and the numbers."""

    state: review_index.RunState
    """When it began to be read: what changes meanwhile makes the index old."""
    results: Results | None = None
    rows: Sequence[TrialRow] = ()
    motions: Sequence[MotionSummary] = ()
    derived: Container[str] = ()
    """Names of the derived files that were read."""
    no_results: str | None = None
    """Why the stored results cannot be read."""
    outdated: str | None = None
    """What is not as it was when the stored results were computed."""
    reason: str | None = None
    """Why the trials say nothing."""


def refresh(run: RunFolder) -> bytes:
    """Read the run as it is now; write and return its index.

    Stored results that say what the trials say are kept; otherwise the statistics are computed
    anew, for the index alone. Where the run cannot be written, the index is only returned.
    """
    read = _Read(state=review_index.state_of(run))
    try:
        read = replace(read, results=load_results(run.path))
    except GstError as error:
        read = replace(read, no_results=str(error))
    try:
        with without_collecting(), SummaryCache(run.results_dir / FOLDER) as kept:
            found = read_run(RunFolder.open(run.path), kept)
            now, motions = provenance_of([found]), found.summaries.motions
            read = replace(read, rows=found.rows, motions=motions, derived=now["derived"])
            read = replace(read, outdated=_outdated(read.results, now))
            if (read.no_results or read.outdated) and (read.rows or run.episodes()):
                read = replace(read, results=compare_run(run, cache=kept).results())
    except GstError as error:
        read = replace(read, reason=str(error))
    return _write(run, read)


def index_run(
    run: RunFolder, comparison: Comparison, results: Results, state: review_index.RunState
) -> None:
    """Write the index of an evaluation that has just been written, in the state before it read."""
    read = _Read(
        state=replace(state, results=review_index.stamp_of(run.path / review_index.RESULTS)),
        results=results,
        rows=comparison.rows,
        motions=comparison.motions,
        derived=comparison.provenance.get("derived", {}),
    )
    _write(run, read)


def _write(run: RunFolder, read: _Read) -> bytes:
    planned = [motion for motion in read.motions if motion.against == "planned"]
    off = {motion.episode: (motion.path_max_m, motion.lag_s) for motion in planned}
    regions = start_regions(read.rows)
    trials = sorted(
        (
            _reviewed(row, off.get(row.episode, (None, None)), regions.get(row.episode, ""))
            for row in read.rows
        ),
        key=review_index.severity,
    )
    about = {
        "state": [read.state.digest, read.state.results],
        "comparison_reason": read.reason,
        "outdated": read.outdated,
        "results_reason": read.no_results,
        "stand_in": None if read.results is None else read.results.stand_in,
        **_about(read.results, has_trials=bool(read.rows)),
    }
    numbers = () if read.results is None else read.results.measurements
    files = _files(run, read, {trial.file for trial in trials})
    content = review_index.written_index(trials, files, about, numbers)
    path = review_index.index_path(run)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)
    except OSError:  # a read-only run is shown all the same, and read again next time
        pass
    return content


def _reviewed(row: TrialRow, off: tuple[float | None, float | None], region: str) -> TrialRow:
    kind, parts = failure_kind(row), ("cause", "stage", "bodies")
    failure: dict[str, Any] = {f"fail_{part}": getattr(kind, part, "") for part in parts}
    return replace(
        row,
        failed_stage=first_failed_stage(row) if row.recorded is False else "",
        distance_m=off[0],
        lag_s=off[1],
        start_region=region,
        **failure,
    )


def _about(results: Results | None, *, has_trials: bool) -> dict[str, Any]:
    if results is None:
        return {"exclusions": [], "num_exclusions": 0, "missing": []}
    first = front(results)
    return {
        "exclusions": [dict(vars(each)) for each in results.exclusions[:SHOWN_EXCLUSIONS]],
        "num_exclusions": len(results.exclusions),
        "missing": list(results.missing),
        "answers": [("Next", first.next_step)] * bool(first.next_step)
        + [(asked, text) for asked, text in first.answers if asked != IN_NUMBERS],
        "notes": [list(note) for note in first.notes],
        "close_pp": CLOSE_PP,
        "tasks": [
            {
                "task": str(line["task"]),
                "slug": slug(str(line["task"])),
                "answer": answer(line),
                "sentence": sentence(line),
            }
            for line in rows_of(results, "conclusions")
        ],
        "views": _views(results),
        "tables": [] if has_trials else [_shown(t) for t in results.tables if t.rows],
    }


def _views(results: Results) -> list[dict[str, Any]]:
    """List the held-out views that the tables of views rate, the one drawn worst first."""
    found: list[dict[str, Any]] = []
    for table in (each for each in results.tables if each.title.startswith(VIEWS_TITLE)):
        file = f"{table.title.removeprefix(VIEWS_TITLE)}.mcap"
        rows: tuple[Any, ...] = table.rows
        first_ns = min((row[1] for row in rows), default=0)
        for camera, stamp_ns, psnr_db, ssim, *_ in rows:
            rated = {"camera": camera, "stamp_ns": stamp_ns, "psnr_db": psnr_db, "ssim": ssim}
            rated |= {"file": file, "after_s": 1e-9 * (stamp_ns - first_ns)}
            found += [rated] if psnr_db is not None else []
    return sorted(found, key=lambda view: view["psnr_db"])


def _shown(table: Table) -> dict[str, Any]:
    heads, rows = grid(table)
    return {
        "title": table.title,
        "note": table.note,
        "heads": heads,
        "rows": [[cell_text(cell) for cell in row] for row in rows[:SHOWN_ROWS]],
        "num_rows": len(rows),
    }


def _outdated(stored: Results | None, now: Mapping[str, Any]) -> str | None:
    """Say which file is not as it was when the stored results were computed; None of none."""
    was = {} if stored is None else stored.provenance
    for part in MADE_OF if "episodes" in was else ():
        before, after = was.get(part, {}), now[part]
        for name in {**before, **after}:
            if name not in before or name not in after:
                return f"{name} {'is new' if name in after else 'has gone'}"
            if before[name] != after[name]:
                return f"{name} changed"
    return None


def _files(run: RunFolder, read: _Read, trials: set[str]) -> Iterator[review_index.IndexedFile]:
    """Name what is no trial; derived files that were read well are not opened again."""
    for name in file_names(run.episodes_dir):
        if name not in trials:
            yield _file(run, run.episodes_dir / name)
    for name in file_names(run.derived_dir):
        was_read = f"{run.derived_dir.name}/{name}" in read.derived
        if not was_read and (found := _file(run, run.derived_dir / name)).error:
            yield found
    for path in run.unfinished():
        reason = "not finished: still being recorded, or its recorder was stopped"
        yield review_index.IndexedFile(name=str(path.relative_to(run.path)), error=reason)


def _file(run: RunFolder, path: Path) -> review_index.IndexedFile:
    try:
        episode = Episode.open(path)
        info = episode.info
        return review_index.IndexedFile(
            name=path.stem,
            kind=info.kind,
            task=info.task,
            source=info.robot or info.cell,
            duration_s=episode.duration_s,
        )
    except GstError as error:
        return review_index.IndexedFile(name=str(path.relative_to(run.path)), error=str(error))


if __name__ == "__main__":  # the dashboard reads a run in another process
    sys.stdout.buffer.write(refresh(RunFolder.open(Path(sys.argv[1]))))
