"""Trials and measurements as typed columns for pandas, DuckDB and R: ``.parquet`` beside the CSV.

Importing this module loads pandas; the evaluator does so only when it writes.
"""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from bridge.exchange.trials_csv import TrialRecord
from evaluator.result import Measurement

_TEXT, _WHOLE, _NUMBER, _ANSWER = "string", "Int64", "Float64", "boolean"
"""Column types of pandas in which unknown is unknown, never 0, False or NaN."""

TRIAL_TYPES = {
    "trial_id": _TEXT,
    "task": _TEXT,
    "condition": _TEXT,
    "policy": _TEXT,
    "start_id": _TEXT,
    "unit": _TEXT,
    "k": _WHOLE,
    "n": _WHOLE,
    "recorded": _ANSWER,
    "sim_planned": _ANSWER,
    "sim_executed": _ANSWER,
    "verdict": _ANSWER,
    "p_success": _NUMBER,
    "cell": _TEXT,
    "stand_in": _ANSWER,
}
MEASUREMENT_TYPES = {
    "id": _TEXT,
    "value": _NUMBER,
    "unit": _TEXT,
    "definition": _TEXT,
    "low": _NUMBER,
    "high": _NUMBER,
    "level": _NUMBER,
    "method": _TEXT,
    "k": _WHOLE,
    "n": _WHOLE,
    "counted": _TEXT,
    "reason_if_undefined": _TEXT,
    "reason_without_interval": _TEXT,
    "episodes": _TEXT,
}
"""``low``, ``high``, ``level`` and ``method`` are the interval; episodes are joined by blanks."""


def write_trials(path: Path, trials: Sequence[TrialRecord]) -> Path:
    """Write one row per trial, the columns of ``trials.csv``; outcomes are true, false or null."""
    names = [field.name for field in fields(TrialRecord)]
    rows = [{name: getattr(trial, name) for name in names} for trial in trials]
    return _write(path, rows, TRIAL_TYPES)


def write_measurements(path: Path, measurements: Sequence[Measurement]) -> Path:
    """Write one row per measured number, its interval in columns."""
    return _write(path, [_row(measurement) for measurement in measurements], MEASUREMENT_TYPES)


def _row(measurement: Measurement) -> dict[str, Any]:
    interval = measurement.interval
    row = {name: getattr(measurement, name, None) for name in MEASUREMENT_TYPES}
    for name in ("low", "high", "level", "method"):
        row[name] = None if interval is None else getattr(interval, name)
    return row | {"episodes": " ".join(measurement.episodes)}


def _write(path: Path, rows: Sequence[dict[str, Any]], types: dict[str, str]) -> Path:
    columns = {
        name: pd.array([row[name] for row in rows], dtype=kind) for name, kind in types.items()
    }
    part = path.with_name(path.name + ".part")
    table = pa.Table.from_pandas(pd.DataFrame(columns), preserve_index=False)
    pq.write_table(table, part)
    part.replace(path)
    return path
