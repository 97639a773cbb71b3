"""Trials CSV and rates CSV into a ``Comparison``, and a run's trials out again."""

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.errors import UsageError
from bridge.exchange.trials_csv import TrialRecord, header_of, read_trials
from bridge.exchange.trials_rates import RateRecord, read_rates
from evaluator.compare.imported import row_from_record
from evaluator.compare.measure import slug
from evaluator.compare.rows import Comparison, RateCell, TrialRow
from evaluator.compare.run import compare_rows
from evaluator.compare.success import WITH, cell_agreement, replanning_gains
from evaluator.compare.tables import gains_table, success_table
from evaluator.result import Exclusion, Measurement
from evaluator.statistics.proportion import wilson


def compare_csv(path: Path) -> Comparison:
    """Compare a trials CSV or a rates CSV; the header tells which it is.

    Raises:
        TableError: Naming the row that cannot be believed.
        UsageError: When the columns are neither's.
    """
    header = header_of(path)
    if "trial_id" in header:
        return compare_trials(path)
    if "side" in header:
        return compare_rates(path)
    message = (
        f"{path} is neither a trials CSV (no column trial_id) nor a rates CSV (no column side); "
        f"its columns are: {', '.join(header) or 'none'}."
    )
    raise UsageError(message)


def compare_trials(path: Path) -> Comparison:
    """Compare a trials CSV as if it were a run."""
    records = read_trials(path)
    rows = [row_from_record(record) for record in records]
    base = compare_rows(
        rows, run=path.stem, source="trials", stand_in=any(record.stand_in for record in records)
    )
    left_out = [
        Exclusion(episode=row.episode, scope="agreement", reason=reason)
        for row in rows
        for reason, lacks in (
            ("the outcome is unknown", row.recorded is None),
            ("sim_planned is unknown", row.sim_planned is None),
        )
        if lacks
    ]
    return _with_source(base, path, left_out)


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


def compare_rates(path: Path) -> Comparison:
    """Compare printed rates: r over cells, gains, intervals where n is known."""
    records = read_rates(path)
    stand_in = any(record.side == "stand-in" for record in records)
    cells, left_out = _rate_cells(records)
    word = "stand-in" if stand_in else "real"
    gains = replanning_gains(cells)
    table = gains_table(gains, word)
    tables = (success_table(cells, word, "Rates as given."), *(() if table is None else (table,)))
    base = Comparison(
        run=path.stem,
        source="rates",
        stand_in=stand_in,
        cells=cells,
        measurements=(
            *(side for cell in cells for side in (cell.recorded, cell.sim)),
            *cell_agreement(cells),
            *gains,
        ),
        tables=tables,
        missing=("trial-level agreement: a table of rates does not say which trial succeeded",),
    )
    return _with_source(base, path, left_out)


def _rate_cells(records: Sequence[RateRecord]) -> tuple[tuple[RateCell, ...], list[Exclusion]]:
    keys = list(dict.fromkeys((r.task, r.condition, r.unit) for r in records))
    tasks = list(dict.fromkeys(record.task for record in records))
    keys.sort(key=lambda key: (tasks.index(key[0]), key[1] == WITH))
    cells, left_out = [], []
    for task, condition, unit in keys:
        sides: dict[str, RateRecord] = {
            "sim" if r.side == "sim" else "recorded": r
            for r in records
            if (r.task, r.condition) == (task, condition)
        }
        for side in ("sim", "recorded"):
            if side not in sides:
                reason = f"{task} {condition}: no {side} rate"
                left_out.append(Exclusion(episode=task, scope="agreement of cells", reason=reason))
        cells.append(
            RateCell(
                task=task,
                condition=condition,
                policy="",
                unit=unit,
                recorded=_rate(sides.get("recorded"), "recorded", task, condition, unit),
                sim=_rate(sides.get("sim"), "sim_planned", task, condition, unit),
                recorded_rate=_fraction(sides.get("recorded")),
                sim_rate=_fraction(sides.get("sim")),
            )
        )
    return tuple(cells), left_out


def _fraction(record: RateRecord | None) -> Fraction | None:
    return None if record is None else record.rate


def _rate(
    record: RateRecord | None, side: str, task: str, condition: str, unit: str
) -> Measurement:
    known = record is not None and record.k is not None and record.n is not None
    return Measurement(
        id=f"rate.{side}.{slug(task)}.{slug(condition)}.-",
        value=None if record is None else float(record.rate),
        unit="1",
        definition=f"successes / {unit}s, as given"
        + (f" in row {record.row} ({record.side})" if record is not None else ""),
        interval=wilson(record.k, record.n)
        if record is not None and record.k is not None and record.n is not None
        else None,
        k=record.k if record is not None else None,
        n=record.n if record is not None else None,
        counted=unit,
        reason_if_undefined="not in the table" if record is None else None,
        reason_without_interval=None if known else "no n",
    )


def _with_source(base: Comparison, path: Path, left_out: Sequence[Exclusion]) -> Comparison:
    return replace(
        base,
        exclusions=(*left_out, *base.exclusions),
        provenance={"software": software(), "file": path.name, "sha256": hash_file(path)},
    )
