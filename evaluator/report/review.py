"""Write the index that the review pages read: trials, files, numbers, and what they mean."""

import csv
import sys
import time
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, file_names
from bridge.errors import GstError, PathNotFoundError
from bridge.exchange.trials_csv import trials_text
from bridge.whole_file import write_whole
from evaluator import review_index
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare.conclusions import CLOSE_PP
from evaluator.compare.failures import failure_kind, start_regions
from evaluator.compare.images.views import VIEWS_TITLE
from evaluator.compare.measure import refuse_alike
from evaluator.compare.motion import MotionSummary
from evaluator.compare.rows import Comparison, TrialRow, stand_in_of
from evaluator.compare.run import read_run
from evaluator.compare.spreadsheet import record_from_row
from evaluator.compare.stages import first_failed_stage
from evaluator.memory import without_collecting
from evaluator.quantity import slug
from evaluator.report.front import IN_NUMBERS, answer, front, rows_of, sentence
from evaluator.report.page import grid
from evaluator.report.wording import cell_text
from evaluator.result import Results, Table, load_results

SHOWN_EXCLUSIONS = 200
"""Of those left out; ``results.json`` has all."""
SHOWN_ROWS = 24
"""Of a table of a run without trials; the report has all."""


@dataclass(frozen=True, kw_only=True)
class _Read:
    """What the trials of a run say now, without the statistics of it, or why nothing."""

    began_ns: int
    """When it began to be read."""
    rows: Sequence[TrialRow] = ()
    motions: Sequence[MotionSummary] = ()
    derived: Container[str] = ()
    """Names of the derived files that were read."""
    reason: str | None = None


def refresh(run: RunFolder) -> bytes:
    """Read the run as it is now, beside its stored results; write and return its index.

    Where the run cannot be written, the index is only returned.
    """
    read = _Read(began_ns=time.time_ns())
    try:
        with without_collecting(), SummaryCache(run.results_dir / FOLDER) as kept:
            found = read_run(RunFolder.open(run.path), kept)
        for kind in review_index.FACETS:
            refuse_alike(kind, ((getattr(row, kind), row.episode) for row in found.rows))
        derived = {file.name for file in found.contents.derived}
        read = replace(read, rows=found.rows, motions=found.summaries.motions, derived=derived)
    except GstError as error:
        read = replace(read, reason=str(error))
    try:
        return _write(run, read, load_results(run.path), None)
    except PathNotFoundError:
        return _write(run, read, None, review_index.NO_RESULTS)
    except GstError as error:
        return _write(run, read, None, str(error))


def index_run(run: RunFolder, comparison: Comparison, results: Results, began_ns: int) -> None:
    """Write the index of an evaluation that has just been written.

    Args:
        began_ns: When it began to read; what changed since is looked at again [ns since 1970].
    """
    derived = comparison.provenance.get("derived", {})
    read = _Read(
        began_ns=began_ns, rows=comparison.rows, motions=comparison.motions, derived=derived
    )
    _write(run, read, results, None, is_new=True)


def _write(
    run: RunFolder, read: _Read, results: Results | None, none: str | None, *, is_new: bool = False
) -> bytes:
    state = review_index.state_of(run)
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
        "state": state.digest,
        "as_of_ns": read.began_ns,
        "changed_meanwhile": state.newest_ns >= read.began_ns,
        "comparison_reason": read.reason,
        "outdated": None if is_new or not results or read.reason else _outdated(run, read.rows),
        "results_reason": none,
        "stand_in": stand_in_of(row.stand_in for row in read.rows)
        if results is None or results.stand_in is None
        else results.stand_in,
        **_about(results, has_trials=bool(read.rows)),
    }
    numbers = () if results is None else results.measurements
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
        "worst_view": _worst_view(results),
        "tables": [] if has_trials else [_shown(t) for t in results.tables if t.rows],
    }


def _worst_view(results: Results) -> dict[str, Any] | None:
    """Find the held-out view that is drawn worst, as the tables of views rate it."""
    found: list[dict[str, Any]] = []
    for table in (each for each in results.tables if each.title.startswith(VIEWS_TITLE)):
        file = f"{table.title.removeprefix(VIEWS_TITLE)}.mcap"
        for camera, stamp_ns, psnr_db, ssim, *_ in table.rows:
            rated = {"camera": camera, "stamp_ns": stamp_ns, "psnr_db": psnr_db, "ssim": ssim}
            found += [{"file": file, **rated}] if psnr_db is not None else []
    return min(found, key=lambda view: view["psnr_db"], default=None)


def _shown(table: Table) -> dict[str, Any]:
    heads, rows = grid(table)
    return {
        "title": table.title,
        "note": table.note,
        "heads": heads,
        "rows": [[cell_text(cell) for cell in row] for row in rows[:SHOWN_ROWS]],
        "num_rows": len(rows),
    }


def _outdated(run: RunFolder, rows: Sequence[TrialRow]) -> str | None:
    """Say what of a trial is not as it was when the stored results were computed; None of none."""
    try:
        stored = (run.results_dir / "trials.csv").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None  # nothing to compare with
    was, now = (
        {line["trial_id"]: line for line in csv.DictReader(text.splitlines())}
        for text in (stored, trials_text(map(record_from_row, rows)))
    )
    for name in dict.fromkeys((*was, *now)):
        if name not in was or name not in now:
            return f"trial {name} {'is new' if name in now else 'has gone'}"
        for part, value in now[name].items():
            if (before := was[name].get(part)) != value:
                return f"{part} of {name} was {before or 'unknown'} and is now {value or 'unknown'}"
    return None


def _files(run: RunFolder, read: _Read, trials: set[str]) -> Iterator[review_index.IndexedFile]:
    """Name what is no trial; derived files that were read well are not opened again."""
    for name in run.episode_parts():
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


if __name__ == "__main__":  # the dashboard reads a large run in another process
    refresh(RunFolder.open(Path(sys.argv[1])))
