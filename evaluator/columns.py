"""Columns of the tables that programs read, by the type of what they hold; unknown is null."""

from dataclasses import Field, fields
from types import NoneType
from typing import Any, get_args

from bridge.exchange.trials_csv import TrialRecord


def _kind_of(field: "Field[Any]") -> type:
    kind = next(k for k in get_args(field.type) or (field.type,) if k is not NoneType)
    return kind if kind in (int, float, bool) else str


OF_TRIALS = {field.name: _kind_of(field) for field in fields(TrialRecord)}
"""As in ``trials.csv``."""
INTERVAL = ("low", "high", "level", "method")
OF_MEASUREMENTS: dict[str, type] = {
    "id": str,
    "value": float,
    "unit": str,
    "definition": str,
    "low": float,
    "high": float,
    "level": float,
    "method": str,
    "k": int,
    "n": int,
    "counted": str,
    **dict.fromkeys(("reason_if_undefined", "reason_without_interval", "episodes"), str),
}
"""The interval has columns of its own; episodes are joined by blanks."""
