"""Trials and measurements as typed columns for pandas, DuckDB and R: ``.parquet`` beside the CSV.

Importing this module loads pyarrow; the evaluator does so only when it writes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import Field, fields
from pathlib import Path
from types import NoneType
from typing import Any, get_args

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow.json import ParseOptions, ReadOptions, read_json

from bridge.exchange.trials_csv import TrialRecord
from bridge.whole_file import part_of
from evaluator.result import Measurement, Table

ARROW = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
"""Column types in which unknown is null, never "", 0, NaN or False."""


def _kind_of(field: "Field[Any]") -> type:
    kind = next(k for k in get_args(field.type) or (field.type,) if k is not NoneType)
    return kind if kind in ARROW else str


OF_TRIALS = {field.name: _kind_of(field) for field in fields(TrialRecord)}
"""As in ``trials.csv``; tags are one text."""
INTERVAL = ("low", "high", "level", "method")
"""Columns of their own; the episodes of a measurement are joined by blanks."""
OF_MEASUREMENTS = {
    f.name: _kind_of(f) for f in fields(Measurement) if f.name not in ("interval", "episodes")
}
OF_MEASUREMENTS |= dict(zip(INTERVAL, (float, float, float, str), strict=True)) | {"episodes": str}


def write_trials(path: Path, trials: Sequence[TrialRecord]) -> Path:
    """Write one row per trial, the columns of ``trials.csv``; outcomes are true, false or null."""
    return _write(path, [vars(trial) for trial in trials], OF_TRIALS)


def write_measurements(path: Path, measurements: Sequence[Measurement]) -> Path:
    """Write one row per measured number, its interval in columns."""
    joined: dict[tuple[str, ...], str] = {}
    rows = []
    for item in measurements:
        episodes = joined.setdefault(item.episodes, " ".join(item.episodes))
        ends = {name: getattr(item.interval, name, None) for name in INTERVAL}
        rows.append(vars(item) | ends | {"episodes": episodes})
    return _write(path, rows, OF_MEASUREMENTS)


def write_table(path: Path, table: Table) -> Path:
    """Write one row per row of a table, each column with the type of what it holds."""
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    types: dict[str, type] = {}
    for name in table.columns:
        kinds = {type(row[name]) for row in rows if row[name] is not None}
        found = next((kind for kind in (bool, int, float) if kinds == {kind}), str)
        types[name] = float if kinds == {int, float} else found
    return _write(path, rows, types)


def _write(path: Path, rows: Sequence[Mapping[str, Any]], types: Mapping[str, type]) -> Path:
    schema = pa.schema([(name, ARROW[kind]) for name, kind in types.items()])
    text = b"\n".join(msgspec.json.encode({name: row[name] for name in types}) for row in rows)
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
