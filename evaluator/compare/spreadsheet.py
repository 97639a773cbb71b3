"""A trials CSV into a ``Comparison``; a run's trials out again."""

from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.episode.run_folder import RunFolder
from bridge.exchange.results_intake import (
    PUBLISHED,
    STREAM_ABOVE_BYTES,
    Taken,
    is_large,
    take,
)
from bridge.exchange.table_text import AS_SAVED, TableOptions
from bridge.exchange.trials_csv import TrialRecord, open_trials, read_trials, trials_path
from bridge.exchange.trials_stream import count_trials
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.names import settle_names
from evaluator.compare.published import check_published
from evaluator.compare.rates import compare_records
from evaluator.compare.rows import Comparison, TrialRow, stand_in_of
from evaluator.compare.success import trials_in, unpaired_keys
from evaluator.result import Exclusion


def row_from_record(record: TrialRecord) -> TrialRow:
    """Turn one line of a trials CSV into a trial row."""
    return TrialRow(
        episode=record.trial_id,
        task=record.task,
        condition=record.condition,
        policy=record.policy,
        start_id=record.start_id,
        cell=record.cell,
        stand_in=record.stand_in,
        recorded=record.recorded,
        unit=record.unit,
        k=record.k,
        n=record.n,
        sim_planned=record.sim_planned,
        sim_executed=record.sim_executed,
        verdict=record.verdict,
        p_success=record.p_success,
        progress=record.progress,
        sim_progress=record.sim_progress,
        tags=record.tags,
    )


def imported_rows(
    run: RunFolder, recorded_ids: Container[str]
) -> tuple[list[TrialRow], list[Exclusion]]:
    """Read the run's imported trials; one that was recorded too is left out and named.

    Args:
        run: The run folder; without imported trials there are no rows.

    Raises:
        TableError: When somebody has changed the file so that a row contradicts itself.
    """
    path = trials_path(run)
    if not path.is_file():
        return [], []
    rows = [row_from_record(record) for record in read_trials(path)]
    doubled = [
        Exclusion(
            episode=row.episode,
            scope="everything",
            reason=f"notes/{path.name} has a row for it, but the recorded episode counts",
        )
        for row in rows
        if row.episode in recorded_ids
    ]
    return [row for row in rows if row.episode not in recorded_ids], doubled


def compare_csv(
    path: Path,
    *,
    method: str = "wilson",
    goal: float | None = None,
    options: TableOptions = AS_SAVED,
) -> Comparison:
    """Compare a table; its content tells which.

    Read are a trials CSV, a rates CSV, a published table (rates with printed figures) and a JSON
    list of trials or rates.

    Args:
        method: Interval of rates: wilson, clopper-pearson or jeffreys.
        goal: The success rate that is asked about, 0 to 1; None asks nothing.

    Raises:
        TableError: Naming the row that contradicts itself.
        UsageError: When it is none of these.
    """
    if not path.is_dir() and path.suffix.lower() != ".json" and is_large(path):
        found = _compare_streamed(path, method, options)
    else:
        found = compare_taken(take(path, options), method=method, goal=goal, options=options)
    if goal is None or any(table.id == "stopping" and table.rows for table in found.tables):
        return found
    missing = "stop or continue: --goal needs recorded outcomes of single trials, one after another"
    return replace(found, missing=(*found.missing, missing))


def compare_taken(
    taken: Taken,
    *,
    method: str = "wilson",
    goal: float | None = None,
    options: TableOptions = AS_SAVED,
) -> Comparison:
    """Compare what one file or folder holds.

    Args:
        method: Interval of rates: wilson, clopper-pearson or jeffreys.
        goal: The success rate that is asked about, 0 to 1; None asks nothing.
        options: What becomes of names that differ only by case.
    """
    path, read_as = taken.path, [taken.summary]
    if taken.kind == PUBLISHED:
        return check_published(path, method=method, options=options).comparison
    if taken.rates:
        settled, merged = settle_names(taken.rates, options.names)
        base = compare_records(settled, path, method=method)
        return replace(base, provenance={**base.provenance, "read_as": [*read_as, *merged]})
    settled_rows, merged = settle_names(map(row_from_record, taken.trials), options.names)
    stand_in = stand_in_of(record.stand_in for record in taken.trials)
    base = compare_rows(
        settled_rows, run=path.stem, source="trials", stand_in=stand_in, method=method, goal=goal
    )
    return _with_source(base, path, unknown_sides(settled_rows), [*read_as, *merged])


def compare_trials(
    path: Path,
    *,
    method: str = "wilson",
    goal: float | None = None,
    stream_above: int = STREAM_ABOVE_BYTES,
    options: TableOptions = AS_SAVED,
) -> Comparison:
    """Compare a trials CSV as if it were a run.

    A large one is streamed: its rows are counted by their answers, in constant memory; what needs
    single trials (pairs of starts, success probabilities, the list of trials) is left out by name.

    Args:
        method: Interval of rates: wilson, clopper-pearson or jeffreys.
        goal: The success rate that is asked about, 0 to 1; None asks nothing, and so does a
            streamed table.
        stream_above: Size of the file from which it is streamed [bytes].
    """
    if path.stat().st_size > stream_above:
        return _compare_streamed(path, method, options)
    return compare_taken(take(path, options), method=method, goal=goal, options=options)


def _compare_streamed(path: Path, method: str, options: TableOptions) -> Comparison:
    counted = count_trials(path, options)
    each = [replace(row_from_record(record), episode="", count=count) for record, count in counted]
    rows, merged = settle_names(each, options.names)
    stand_in = stand_in_of(record.stand_in for record, _ in counted)
    base = compare_rows(rows, run=path.stem, source="trials", stand_in=stand_in, method=method)
    left_out = [
        Exclusion(episode=f"{trials_in(lacking)} trials", scope="agreement", reason=reason)
        for reason, lacking in (
            ("the outcome is unknown", [row for row in rows if row.recorded is None]),
            ("sim_planned is unknown", [row for row in rows if row.sim_planned is None]),
        )
        if lacking
    ]
    summary = open_trials(path, options).understood("trials", sum(count for _, count in counted))
    return replace(_with_source(base, path, left_out, [summary, *merged]), rows=())


def unknown_sides(rows: Sequence[TrialRow]) -> list[Exclusion]:
    """Trials that lack a side; of an unpaired group all do, and each side counts on its own."""
    unpaired = unpaired_keys(rows)
    return [
        Exclusion(episode=row.episode, scope="agreement", reason=reason)
        for row in rows
        for reason, lacks in (
            ("the outcome is unknown", row.recorded is None),
            ("sim_planned is unknown", row.sim_planned is None),
        )
        if lacks
        and (
            (row.task, row.condition, row.policy) not in unpaired or row.recorded == row.sim_planned
        )
    ]


def record_from_row(row: TrialRow) -> TrialRecord:
    """Turn a trial row into one line of a trials CSV."""
    k, n = row.k, row.n
    if row.unit == "trial" and row.recorded is not None:
        k, n = int(row.recorded), 1
    return TrialRecord(
        trial_id=row.episode,
        task=row.task,
        condition=row.condition,
        policy=row.policy,
        start_id=row.start_id,
        unit=row.unit,
        k=k,
        n=n,
        recorded=row.recorded,
        sim_planned=row.sim_planned,
        sim_executed=row.sim_executed,
        verdict=row.verdict,
        p_success=row.p_success,
        cell=row.cell,
        stand_in=row.stand_in,
        progress=row.progress,
        sim_progress=row.sim_progress,
        tags=row.tags,
    )


def _with_source(
    base: Comparison, path: Path, left_out: Sequence[Exclusion], read_as: Sequence[str]
) -> Comparison:
    return replace(
        base,
        exclusions=(*left_out, *base.exclusions),
        provenance={
            "software": software(),
            "file": path.name,
            "sha256": hash_file(path) if path.is_file() else None,
            "read_as": list(read_as),
        },
    )
