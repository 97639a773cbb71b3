"""What one part of a comparison found."""

from dataclasses import dataclass

from evaluator.result import Exclusion, Measurement, Table


@dataclass(frozen=True, kw_only=True)
class Part:
    """Numbers, tables, and what could not enter them."""

    measurements: tuple[Measurement, ...] = ()
    tables: tuple[Table, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    missing: tuple[str, ...] = ()
