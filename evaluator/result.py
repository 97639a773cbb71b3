"""One measured number, and ``results.json``: everything one evaluation has to say.

Undefined is undefined, with its reason; it is never 0, 1 or NaN.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import msgspec

from bridge.errors import InvalidRecordError, PathNotFoundError
from bridge.task.record import check_record, parse_record
from bridge.whole_file import write_whole
from evaluator.errors import EvaluatorError

UNITS = ("m", "rad", "s", "ns", "dB", "1", "count", "pp")
"""SI units and the few dimensionless ones that measurements carry."""
SCHEMA_VERSION = 2

Cell = str | int | float | bool | None
"""What a table may hold; None is printed as undefined, never as zero."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Where the true value plausibly lies."""

    low: float
    high: float
    level: float
    method: str
    """For example ``wilson``; a method is always named."""


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """One measured number with all that is needed to judge it."""

    id: str
    """Dotted, stable: ``rate.recorded.cube_into_box.with_replanning``."""
    value: float | None
    unit: str
    """``1`` for fractions and coefficients, ``pp``, ``m``, ``rad``, ``dB``, ``count``."""
    definition: str
    """What was counted or computed, from what."""
    interval: Interval | None = None
    k: int | None = None
    """Successes, where the value is k/n."""
    n: int | None = None
    counted: str | None = None
    """What ``n`` counts: trial, object, pair, group, image, run."""
    reason_if_undefined: str | None = None
    """Set exactly when ``value`` is None."""
    reason_without_interval: str | None = None
    episodes: tuple[str, ...] = ()
    """The recorded episodes the number rests on."""

    def __post_init__(self) -> None:
        """Refuse NaN, infinity, unknown units, and undefined values without a reason."""
        if self.unit not in UNITS:
            message = f"{self.unit!r} is not a unit of a measurement: {', '.join(UNITS)}"
            raise ValueError(message)
        if self.value is not None and not math.isfinite(self.value):
            message = f"measurement {self.id} is {self.value}; say it is undefined and why"
            raise ValueError(message)
        if (self.value is None) != (self.reason_if_undefined is not None):
            message = f"measurement {self.id} needs a value or a reason, and not both"
            raise ValueError(message)

    @property
    def is_beyond(self) -> bool:
        """Whether the value is outside its interval: that of r is without the noise of counting."""
        if self.value is None or self.interval is None:
            return False
        return not self.interval.low <= self.value <= self.interval.high


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows a report prints as they are."""

    id: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

    @staticmethod
    def of(rows: Sequence[Mapping[str, Cell]], *, id: str, title: str, note: str = "") -> "Table":
        """Make a table of at least one row, each its cells by column, all with the same columns."""
        lines = tuple(tuple(row.values()) for row in rows)
        return Table(id=id, title=title, columns=tuple(rows[0]), rows=lines, note=note)


@dataclass(frozen=True, kw_only=True)
class Exclusion:
    """Something left out of a number, and why."""

    episode: str
    scope: str
    """What it was left out of: ``agreement``, ``pairing``, ``views`` ..."""
    reason: str


@dataclass(frozen=True, kw_only=True)
class Results:
    """The content of ``results.json``."""

    run: str
    source: str
    """run, trials, rates or images."""
    stand_in: bool | None
    """None when the input does not say, as rates of the twin alone."""
    measurements: tuple[Measurement, ...] = ()
    tables: tuple[Table, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    missing: tuple[str, ...] = ()
    """What could not be computed at all because its input is not there."""
    provenance: dict[str, Any] = field(default_factory=dict)

    def get(self, measurement_id: str) -> Measurement:
        """Return one measurement."""
        by_id = {measurement.id: measurement for measurement in self.measurements}
        if measurement_id in by_id:
            return by_id[measurement_id]
        message = f"no measurement {measurement_id!r} in the results of {self.run}"
        raise EvaluatorError(f"{message}. There are: {', '.join(by_id)}.")

    def to_record(self) -> dict[str, Any]:
        """Return the JSON record, checked against the schema.

        Many numbers rest on the same episodes: each list of them is held once.
        """
        lists: dict[tuple[str, ...], int] = {}
        measurements = [
            {
                **{name: getattr(item, name) for name in _PLAIN},
                "interval": None if item.interval is None else dict(vars(item.interval)),
                "episodes": lists.setdefault(item.episodes, len(lists)),
            }
            for item in self.measurements
        ]
        record = {
            "schema_version": SCHEMA_VERSION,
            "run": self.run,
            "source": self.source,
            "stand_in": self.stand_in,
            "measurements": measurements,
            "episode_lists": [list(episodes) for episodes in lists],
            "tables": [
                {**vars(table), "columns": list(table.columns), "rows": list(map(list, table.rows))}
                for table in self.tables
            ],
            "exclusions": [dict(vars(item)) for item in self.exclusions],
            "missing": list(self.missing),
            "provenance": msgspec.to_builtins(self.provenance),
        }
        _check(record)
        return record


_PLAIN = tuple(f.name for f in fields(Measurement) if f.name not in ("interval", "episodes"))
_CHECKED_ROWS = 20
"""Rows of a table that the schema sees; the cells of the others are checked by their types."""
_Rows = list[list[Cell]]


def _check(record: dict[str, Any]) -> None:
    """Check the record, and long tables and lists in a time that ten thousand trials allow."""
    short = [{**table, "rows": table["rows"][:_CHECKED_ROWS]} for table in record["tables"]]
    lists = [episodes[:_CHECKED_ROWS] for episodes in record["episode_lists"]]
    shown = {**record, "tables": short, "episode_lists": lists}
    check_record(shown, name="results", package="evaluator")
    for table in record["tables"]:
        try:
            msgspec.convert(table["rows"], _Rows)
            _encode(table["rows"])
        except ValueError as error:
            where = f"table {table['id']}"
            raise InvalidRecordError(name="results", where=where, found=str(error)) from error


_encode = json.JSONEncoder(allow_nan=False).encode
"""As ``json.dumps``, which makes an encoder anew for every call that forbids NaN."""


def _written(record: Mapping[str, Any]) -> str:
    """Write each number, table and list on one line: quick, and a diff names what changed."""
    parts = []
    for name, value in record.items():
        if isinstance(value, list) and value:
            lines = ",\n  ".join(map(_encode, value))
            parts.append(f" {_encode(name)}: [\n  {lines}\n ]")
        else:
            parts.append(f" {_encode(name)}: {_encode(value)}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def write_results(results: Results, path: Path) -> Path:
    """Write ``results.json``; a half-written file never carries the final name."""
    text = _written(results.to_record())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text.encode())
    except OSError as error:
        message = f"cannot write {path}: {error.strerror}. Choose another folder with --out."
        raise EvaluatorError(message) from error
    return path


def load_results(path: Path) -> Results:
    """Read ``results.json``, or the one of a run folder; what does not fit is refused."""
    if path.is_dir():
        path = path / "results" / "results.json"
    if not path.is_file():
        raise PathNotFoundError(
            path=path, what="results", hint="Make them first: robot-gst evaluate RUN."
        )
    record = parse_record(path.read_bytes(), name="results", package="evaluator")
    try:
        return _from_record(record)
    except ValueError as error:
        raise InvalidRecordError(name="results", where="measurements", found=str(error)) from error


def _from_record(record: Mapping[str, Any]) -> Results:
    lists = record.get("episode_lists", [])
    for item in record["measurements"]:
        place = item["episodes"]  # version 1 wrote each list out
        if isinstance(place, int):
            if place >= len(lists):
                message = f"{item['id']} names list {place} of {len(lists)} lists of episodes"
                raise ValueError(message)
            item["episodes"] = lists[place]
    try:
        return msgspec.convert(record, Results)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from error
