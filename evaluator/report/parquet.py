"""Trials and measurements as typed columns for pandas, DuckDB and R: ``.parquet`` beside the CSV.

Importing this module loads pyarrow; the evaluator does so only when it writes.
"""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bridge.exchange.trials_csv import TrialRecord
from evaluator.result import Measurement

_TEXT, _WHOLE, _NUMBER, _ANSWER = pa.string(), pa.int64(), pa.float64(), pa.bool_()
"""Column types in which unknown is null, never 0, False or NaN."""
_NUMPY = {_WHOLE: np.int64, _NUMBER: np.float64}
_MOST_BYTES = 2**31 - 1
"""Of one column of texts, whose places have 32 bits."""

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
    columns = {name: [getattr(trial, name) for trial in trials] for name in names}
    return _write(path, columns, TRIAL_TYPES)


def write_measurements(path: Path, measurements: Sequence[Measurement]) -> Path:
    """Write one row per measured number, its interval in columns."""
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


def _write(path: Path, columns: dict[str, list[Any]], types: dict[str, pa.DataType]) -> Path:
    part = path.with_name(path.name + ".part")
    arrays = [_array(columns[name], kind) for name, kind in types.items()]
    table = pa.Table.from_arrays(arrays, names=list(types))
    pq.write_table(table, part, compression="zstd")
    part.replace(path)
    return path


def _array(values: list[Any], kind: pa.DataType) -> pa.Array | pa.ChunkedArray:
    """Fill a typed column; ``pyarrow.array`` would load pandas, which takes a third of a second."""
    there = np.array([value is not None for value in values], dtype=bool)
    buffers = [_buffer(np.packbits(there, bitorder="little"))]
    if kind == _TEXT:
        texts = [b"" if value is None else value.encode() for value in values]
        ends = np.cumsum([0, *map(len, texts)])
        if ends[-1] > _MOST_BYTES:
            return pa.array(values, type=kind)  # which cuts it into pieces
        buffers += [_buffer(ends.astype(np.int32)), pa.py_buffer(b"".join(texts))]
    elif kind == _ANSWER:
        yes = np.array([bool(value) for value in values], dtype=bool)
        buffers.append(_buffer(np.packbits(yes, bitorder="little")))
    else:
        numbers = [0 if value is None else value for value in values]
        buffers.append(_buffer(np.array(numbers, dtype=_NUMPY[kind])))
    return pa.Array.from_buffers(kind, len(values), buffers)


def _buffer(array: np.ndarray) -> pa.Buffer:
    return pa.py_buffer(array.tobytes())
