"""Lines of a trials CSV as trial rows, and back."""

from collections.abc import Container, Sequence
from dataclasses import fields

from bridge.episode.run_folder import RunFolder
from bridge.exchange.trials_csv import TrialRecord, read_trials, trials_path
from evaluator.compare.rows import TrialRow
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
    """Read the run's imported trials; one that was recorded too is left out and named."""
    path = trials_path(run)
    if not path.is_file():
        return [], []
    rows = [row_from_record(record) for record in read_trials(path)]
    why = f"notes/{path.name} has a row for it, but the recorded episode counts"
    doubled = [
        Exclusion(episode=row.episode, scope="everything", reason=why)
        for row in rows
        if row.episode in recorded_ids
    ]
    return [row for row in rows if row.episode not in recorded_ids], doubled


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
