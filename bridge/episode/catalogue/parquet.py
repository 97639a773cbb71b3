"""The catalogue as a Parquet table, for DuckDB, pandas and spreadsheets."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from bridge.episode.catalogue.entry import Entry
from bridge.errors import MissingDependencyError
from bridge.whole_file import write_whole


def write_parquet(entries: Sequence[Entry], path: Path) -> None:
    """Write one row per episode; columns are the fields of ``Entry``, times in ns.

    Raises:
        MissingDependencyError: Without pa.
    """
    try:
        import pyarrow as pa  # noqa: PLC0415  # only for this export
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(
            package="pyarrow", extra="report", purpose="exporting the catalogue to Parquet"
        ) from error

    types: dict[Any, Any] = {
        str: pa.string(),
        str | None: pa.string(),
        int: pa.int64(),
        int | None: pa.int64(),
        float: pa.float64(),
        bool: pa.bool_(),
        tuple[str, ...]: pa.list_(pa.string()),
    }
    names = [(item.name, types[item.type]) for item in fields(Entry)]
    rows = [{**vars(entry), "tags": list(entry.tags)} for entry in entries]
    table = pa.Table.from_pylist(rows, schema=pa.schema(names))
    sink = pa.BufferOutputStream()
    parquet.write_table(table, sink, compression="zstd")
    write_whole(path, sink.getvalue().to_pybytes())
