"""A trials CSV into a ``Comparison``; a run's trials out again."""

from collections.abc import Container, Sequence
from dataclasses import fields, replace
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.episode.run_folder import RunFolder
from bridge.exchange.table_text import AS_SAVED, TableOptions
from bridge.exchange.trials_csv import TrialRecord, read_trials, trials_path
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.intake import PUBLISHED, Taken, take
from evaluator.compare.names import settle_names
from evaluator.compare.published import check_published
from evaluator.compare.rates import compare_records
from evaluator.compare.rows import Comparison, TrialRow, stand_in_of
from evaluator.compare.success import unpaired_keys
from evaluator.result import Exclusion

SHARED = tuple(
    field.name for field in fields(TrialRecord) if field.name in TrialRow.__dataclass_fields__
)
"""What a line of a trials CSV and a trial row call by the same name."""


def row_from_record(record: TrialRecord) -> TrialRow:
    """Turn one line of a trials CSV into a trial row."""
    return TrialRow(episode=record.trial_id, **{name: getattr(record, name) for name in SHARED})


def imported_rows(
    run: RunFolder, recorded_ids: Container[str]
) -> tuple[list[TrialRow], list[Exclusion]]:
    """Read the run's imported trials; one that was recorded too is left out and named.

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
    options: TableOptions = AS_SAVED,
) -> Comparison:
    """Compare a table; its content tells which.

    Read are a trials CSV, a rates CSV, a published table (rates with printed figures) and a JSON
    list of trials or rates.

    Raises:
        TableError: Naming the row that contradicts itself.
    """
    return compare_taken(take(path, options), method=method, options=options)


def compare_taken(
    taken: Taken,
    *,
    method: str = "wilson",
    options: TableOptions = AS_SAVED,
) -> Comparison:
    """Compare what one file or folder holds."""
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
        settled_rows, run=path.stem, source="trials", stand_in=stand_in, method=method
    )
    return _with_source(base, path, unknown_sides(settled_rows), [*read_as, *merged])


def unknown_sides(rows: Sequence[TrialRow]) -> list[Exclusion]:
    """Trials that lack a side; of an unpaired group all do, and each side counts on its own."""
    unpaired = unpaired_keys(rows)
    has_twin = any(row.sim_planned is not None for row in rows)
    return [
        Exclusion(episode=row.episode, scope="agreement", reason=reason)
        for row in rows
        for reason, lacks in (
            ("the outcome is unknown", row.recorded is None),
            ("sim_planned is unknown", row.sim_planned is None and has_twin),
        )
        if lacks
        and (
            (row.task, row.condition, row.policy) not in unpaired or row.recorded == row.sim_planned
        )
    ]


def record_from_row(row: TrialRow) -> TrialRecord:
    """Turn a trial row into one line of a trials CSV."""
    shared = {name: getattr(row, name) for name in SHARED}
    if row.unit == "trial" and row.recorded is not None:
        shared |= {"k": int(row.recorded), "n": 1}
    return TrialRecord(trial_id=row.episode, **shared)


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
