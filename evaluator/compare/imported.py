"""Trials that were kept in a spreadsheet and brought into the run (``import trials``)."""

from collections.abc import Container

from bridge.episode.run_folder import RunFolder
from bridge.exchange.trials_csv import TrialRecord, read_trials, trials_path
from evaluator.compare.rows import TrialRow
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
    )


def imported_rows(
    run: RunFolder, recorded_ids: Container[str]
) -> tuple[list[TrialRow], list[Exclusion]]:
    """Read the run's imported trials; one that was recorded too is left out and named.

    Raises:
        TableError: When somebody has changed the file so that a row cannot be believed.
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
