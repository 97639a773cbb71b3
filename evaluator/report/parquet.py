"""Trials and measurements as typed columns for pandas, DuckDB and R: ``.parquet`` beside the CSV.

Importing this module loads pyarrow; the evaluator does so only when it writes.
"""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow.json import ParseOptions, ReadOptions, read_json

from bridge.exchange.trials_csv import TrialRecord, tags_text
from bridge.whole_file import part_of
from evaluator.result import Cell, Measurement, Table

TEXT, WHOLE, NUMBER, ANSWER = pa.string(), pa.int64(), pa.float64(), pa.bool_()
"""Column types in which unknown is null, never "", 0, NaN or False."""
TRIAL_TYPES = {
    "trial_id": TEXT,
    "task": TEXT,
    "condition": TEXT,
    "policy": TEXT,
    "start_id": TEXT,
    "unit": TEXT,
    "k": WHOLE,
    "n": WHOLE,
    "recorded": ANSWER,
    "sim_planned": ANSWER,
    "sim_executed": ANSWER,
    "verdict": ANSWER,
    "p_success": NUMBER,
    "cell": TEXT,
    "stand_in": ANSWER,
    "progress": NUMBER,
    "sim_progress": NUMBER,
    "tags": TEXT,
}
MEASUREMENT_TYPES = {
    "id": TEXT,
    "value": NUMBER,
    "unit": TEXT,
    "definition": TEXT,
    "low": NUMBER,
    "high": NUMBER,
    "level": NUMBER,
    "method": TEXT,
    "k": WHOLE,
    "n": WHOLE,
    "counted": TEXT,
    "reason_if_undefined": TEXT,
    "reason_without_interval": TEXT,
    "episodes": TEXT,
}
"""``low``, ``high``, ``level`` and ``method`` are the interval; episodes are joined by blanks."""


def write_trials(path: Path, trials: Sequence[TrialRecord]) -> Path:
    """Write one row per trial, the columns of ``trials.csv``; outcomes are true, false or null."""
    names = [field.name for field in fields(TrialRecord)]
    columns = {name: [getattr(trial, name) for trial in trials] for name in names}
    columns["tags"] = [tags_text(tags) or None for tags in columns["tags"]]
    return _write(path, columns, TRIAL_TYPES)


def write_measurements(path: Path, measurements: Sequence[Measurement]) -> Path:
    """Write one row per measured number, its interval in columns.

    Args:
        measurements: One for each row; an undefined one has an empty value and its reason.
    """
    columns: dict[str, list[Any]] = {
        name: [getattr(item, name, None) for item in measurements] for name in MEASUREMENT_TYPES
    }
    for name in ("low", "high", "level", "method"):
        columns[name] = [getattr(item.interval, name, None) for item in measurements]
    joined: dict[tuple[str, ...], str] = {}
    for item in measurements:
        joined.setdefault(item.episodes, " ".join(item.episodes))
    columns["episodes"] = [joined[item.episodes] for item in measurements]
    return _write(path, columns, MEASUREMENT_TYPES)


def write_table(path: Path, table: Table) -> Path:
    """Write one row per row of a table, each column with the type of what it holds."""
    columns = {name: [row[i] for row in table.rows] for i, name in enumerate(table.columns)}
    types = {name: _type_of(values) for name, values in columns.items()}
    return _write(path, columns, types)


def _type_of(values: Sequence[Cell]) -> pa.DataType:
    kinds = {type(value) for value in values if value is not None}
    by_kind = ((bool, ANSWER), (int, WHOLE), (float, NUMBER))
    found = next((arrow for kind, arrow in by_kind if kinds == {kind}), TEXT)
    return NUMBER if kinds == {int, float} else found


def _write(path: Path, columns: dict[str, list[Any]], types: dict[str, pa.DataType]) -> Path:
    schema = pa.schema(list(types.items()))
    rows = zip(*(columns[name] for name in types), strict=True)
    text = b"\n".join(msgspec.json.encode(dict(zip(types, row, strict=True))) for row in rows)
    if text:  # pyarrow reads JSON without loading pandas, which pa.array does: 0.4 s
        table = read_json(
            pa.BufferReader(text),
            read_options=ReadOptions(block_size=len(text)),
            parse_options=ParseOptions(explicit_schema=schema),
        )
    else:
        table = schema.empty_table()
    part = part_of(path)
    pq.write_table(table, part, compression="zstd")
    part.replace(path)
    return path
