"""Trials and measurements as typed columns for pandas, DuckDB and R: ``.parquet`` beside the CSV.

Importing this module loads pyarrow; the evaluator does so only when it writes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow.json import ParseOptions, ReadOptions, read_json

from bridge.exchange.trials_csv import TrialRecord
from bridge.whole_file import part_of
from evaluator.columns import INTERVAL, OF_MEASUREMENTS, OF_TRIALS
from evaluator.result import Cell, Measurement, Table

ARROW = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
"""Column types in which unknown is null, never "", 0, NaN or False."""


def write_trials(path: Path, trials: Sequence[TrialRecord]) -> Path:
    """Write one row per trial, the columns of ``trials.csv``; outcomes are true, false or null."""
    columns = {name: [getattr(trial, name) for trial in trials] for name in OF_TRIALS}
    return _write(path, columns, OF_TRIALS)


def write_measurements(path: Path, measurements: Sequence[Measurement]) -> Path:
    """Write one row per measured number, its interval in columns."""
    columns: dict[str, list[Any]] = {
        name: [getattr(item, name, None) for item in measurements] for name in OF_MEASUREMENTS
    }
    for name in INTERVAL:
        columns[name] = [getattr(item.interval, name, None) for item in measurements]
    joined: dict[tuple[str, ...], str] = {}
    for item in measurements:
        joined.setdefault(item.episodes, " ".join(item.episodes))
    columns["episodes"] = [joined[item.episodes] for item in measurements]
    return _write(path, columns, OF_MEASUREMENTS)


def write_table(path: Path, table: Table) -> Path:
    """Write one row per row of a table, each column with the type of what it holds."""
    columns = {name: [row[i] for row in table.rows] for i, name in enumerate(table.columns)}
    types = {name: _type_of(values) for name, values in columns.items()}
    return _write(path, columns, types)


def _type_of(values: Sequence[Cell]) -> type:
    kinds = {type(value) for value in values if value is not None}
    found = next((kind for kind in (bool, int, float) if kinds == {kind}), str)
    return float if kinds == {int, float} else found


def _write(path: Path, columns: dict[str, list[Any]], types: dict[str, type]) -> Path:
    schema = pa.schema([(name, ARROW[kind]) for name, kind in types.items()])
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
