"""A trials CSV, or another benchmark's results, into a ``Comparison``; a run's trials out again."""

from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.exchange.benchmark_results import (
    POLARIS_COLUMNS,
    read_lerobot_eval,
    read_polaris,
    read_simpler,
)
from bridge.exchange.trials_csv import TrialRecord, header_of, read_trials, trials_path
from bridge.exchange.trials_stream import count_trials
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.notes import with_notes
from evaluator.compare.published import check_published
from evaluator.compare.rates import compare_rates
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
    )


def imported_rows(
    run: RunFolder, recorded_ids: Container[str]
) -> tuple[list[TrialRow], list[Exclusion]]:
    """Read the run's imported trials; one that was recorded too is left out and named.

    Args:
        run: The run folder; without imported trials there are no rows.
        recorded_ids: Ids of the recorded episodes, which count before imported ones.

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


STREAM_ABOVE_BYTES = 32 * 2**20
"""A larger trials CSV is read row by row and only counted: about 300,000 trials."""


def compare_csv(path: Path, *, method: str = "wilson", goal: float | None = None) -> Comparison:
    """Compare a table, or another benchmark's result file or folder; its content tells which.

    Read are a trials CSV, a rates CSV, a published table (rates with printed figures),
    ``eval_results.csv`` of PolaRiS, ``eval_info.json`` of LeRobot, and a folder of SIMPLER videos.

    Args:
        path: The table, result file or folder.
        method: Interval of rates: wilson, clopper-pearson or jeffreys.
        goal: The success rate that is asked about, 0 to 1; None asks nothing.

    Raises:
        TableError: Naming the row that contradicts itself.
        UsageError: When it is none of these.
    """
    found = _compare(path, method, goal)
    if goal is None or any(table.id == "stopping" and table.rows for table in found.tables):
        return found
    missing = "stop or continue: --goal needs recorded outcomes of single trials, one after another"
    return replace(found, missing=(*found.missing, missing))


def _compare(path: Path, method: str, goal: float | None) -> Comparison:
    if path.is_dir():
        return _from_benchmark(path, read_simpler(path), "SIMPLER", method)
    if path.suffix.lower() == ".json":
        return _from_benchmark(path, read_lerobot_eval(path), "LeRobot", method)
    header = header_of(path)
    if "trial_id" in header:
        return compare_trials(path, method=method, goal=goal)
    if "statistic" in header:
        return check_published(path, method=method).comparison
    if "side" in header:
        return compare_rates(path, method=method)
    if set(POLARIS_COLUMNS) <= set(header):
        return _from_benchmark(path, read_polaris(path), "PolaRiS", method)
    message = (
        f"{path} is neither a trials CSV (no column trial_id) nor a rates CSV (no column side) nor "
        f"PolaRiS results ({', '.join(POLARIS_COLUMNS)}); its columns are: "
        f"{', '.join(header) or 'none'}."
    )
    raise UsageError(message)


def compare_trials(
    path: Path,
    *,
    method: str = "wilson",
    goal: float | None = None,
    stream_above: int = STREAM_ABOVE_BYTES,
) -> Comparison:
    """Compare a trials CSV as if it were a run.

    A large one is streamed: its rows are counted by their answers, in constant memory; what needs
    single trials (pairs of starts, success probabilities, the list of trials) is left out by name.

    Args:
        path: The trials CSV.
        method: Interval of rates: wilson, clopper-pearson or jeffreys.
        goal: The success rate that is asked about, 0 to 1; None asks nothing, and so does a
            streamed table.
        stream_above: Size of the file from which it is streamed [bytes].
    """
    if path.stat().st_size > stream_above:
        return _compare_streamed(path, method)
    records = read_trials(path)
    rows = [row_from_record(record) for record in records]
    stand_in = stand_in_of(record.stand_in for record in records)
    base = compare_rows(
        rows, run=path.stem, source="trials", stand_in=stand_in, method=method, goal=goal
    )
    return _with_source(base, path, _unknown(rows))


def _compare_streamed(path: Path, method: str) -> Comparison:
    counted = count_trials(path)
    rows = [replace(row_from_record(record), episode="", count=count) for record, count in counted]
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
    return replace(_with_source(base, path, left_out), rows=())


def _from_benchmark(
    path: Path, records: Sequence[TrialRecord], name: str, method: str
) -> Comparison:
    """Enter outcomes of closed-loop rollouts on the sim side, and say what they are."""
    rows = [row_from_record(record) for record in records]
    base = compare_rows(rows, run=path.stem, source="trials", stand_in=None, method=method)
    note = (
        f"{name} results are rollouts of a policy in that simulator, entered on the sim side: no "
        "plan was sent and nothing was replayed. Add real trials of the same starts to compare"
    )
    base = replace(base, tables=with_notes(base.tables, [(name, note)]))
    return _with_source(base, path, ())


def _unknown(rows: Sequence[TrialRow]) -> list[Exclusion]:
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
    )


def _with_source(base: Comparison, path: Path, left_out: Sequence[Exclusion]) -> Comparison:
    return replace(
        base,
        exclusions=(*left_out, *base.exclusions),
        provenance={
            "software": software(),
            "file": path.name,
            "sha256": hash_file(path) if path.is_file() else None,
        },
    )
