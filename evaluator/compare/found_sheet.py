"""A table cut into names of columns and rows, and what is found in it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bridge.exchange.table_text import TableError
from bridge.exchange.trials_csv import TrialRecord
from bridge.exchange.trials_rates import RateRecord
from evaluator.compare.table_words import Column, Figure

Line = tuple[int, list[str]]
NAMED = ("task", "policy", "condition")


@dataclass(kw_only=True)
class Found:
    """What a table was read as."""

    trials: tuple[TrialRecord, ...] = ()
    rates: tuple[RateRecord, ...] = ()
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    """Readings that are likely, and not the only ones."""


@dataclass(frozen=True, kw_only=True)
class Value:
    """One figure with whom it is about."""

    row: int
    labels: dict[str, str]
    side: str
    column: Column
    figure: Figure | None


@dataclass(kw_only=True)
class Sheet:
    """A table cut into names of columns and rows below."""

    path: Path
    columns: list[Column]
    lines: list[Line]
    found: Found
    read: set[int] = field(default_factory=set)
    """Columns that were used."""
    labels: set[str] = field(default_factory=set)
    """Labels that have a column."""

    def labelled(self, label: str) -> Column | None:
        """Return the column of one label.

        Raises:
            TableError: When there are two of them.
        """
        these = [column for column in self.columns if column.label == label]
        if len(these) > 1:
            raise self.refuse(None, two_of(these, label), f'Say which: --map "{label}=..."')
        self.read |= {column.place for column in these}
        return these[0] if these else None

    def refuse(self, row: int | None, found: str, hint: str) -> TableError:
        """Build the error that names a place."""
        return TableError(path=self.path, row=row, found=found, hint=hint)

    def cells(self, column: Column) -> list[str]:
        """Return what a column holds."""
        return [cells[column.place] for _, cells in self.lines]


def key_of(value: Value) -> tuple[str, ...]:
    """Whom a figure is about: the names of its row, and the side."""
    return (*(value.labels[name] for name in NAMED), value.side)


def two_of(columns: Sequence[Column], what: str) -> str:
    """Say that each of some columns may be what only one can be."""
    return f"{' and '.join(repr(column.name) for column in columns)} may both be the {what}"
