"""Rates CSV in: success rates as papers print them, with the counts they must come from.

Columns: task, condition, policy, side, unit, k, n, and rate (0..1) or rate_percent (0..100).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from fractions import Fraction

from bridge.exchange.table_text import SourceRow, TableError
from bridge.exchange.trials_csv import SIDES, UNITS

COLUMNS = ("task", "condition", "policy", "side", "unit", "k", "n", "rate", "rate_percent")
MOST_DIGITS = 30
"""Before or behind the point of a printed figure; more would take forever to compare."""
FLOAT_DIGITS = 7
"""Digits from which on a program and no person chose how many: 32-bit floats have so many."""


class ImpossibleRateError(TableError):
    """A printed rate that no count of n rounds to, or another than the one beside it."""


class AmbiguousRateError(TableError):
    """A printed rate that several counts of n round to."""


@dataclass(frozen=True, kw_only=True)
class RateRecord:
    """One printed rate."""

    task: str
    condition: str
    side: str
    """sim, real or stand-in."""
    unit: str
    k: int | None
    n: int | None
    """None when the source gives a rate without its number of trials."""
    rate: Fraction
    """k/n where both are known, else as printed."""
    row: int
    policy: str = ""
    half: Fraction = Fraction(0)
    """How far the true rate may lie from the printed one; 0 where a count says it exactly."""


def rates_of(rows: Sequence[SourceRow]) -> list[RateRecord]:
    """Check the rows of a table of rates, each alone and beside the others."""
    records: list[RateRecord] = []
    for row in rows:
        record = read_rate(row)
        check_beside(row, record, records)
        records.append(record)
    return records


def check_beside(row: SourceRow, record: RateRecord, earlier: Sequence[RateRecord]) -> None:
    """Refuse a cell that is there already, and a second unit in one task."""
    for other in earlier:
        if other.task == record.task and other.unit != record.unit:
            raise row.refuse(
                f"unit {record.unit!r} in task {record.task!r}, but row {other.row} says "
                f"{other.unit!r}",
                "One task is counted in one unit; mixing them changes what a rate means",
            )
        if _key(other) == _key(record):
            parts = (record.task, record.condition, *filter(None, [record.policy]))
            found = (
                f"{record.side} of {' '.join(map(repr, parts))} stands in row {other.row} already"
            )
            raise row.refuse(found, "Give each cell once")


def _key(record: RateRecord) -> tuple[str, str, str, str]:
    side = "sim" if record.side == "sim" else "recorded"
    return record.task, record.condition, record.policy, side


def read_rate(row: SourceRow) -> RateRecord:
    """Read one row of a rates CSV; other columns than ours are not looked at."""
    if not row.text("task"):
        raise row.refuse("task is empty", "Every rate needs its task")
    side, unit = row.text("side").lower(), row.text("unit") or "trial"
    if side not in SIDES:
        raise row.refuse(f"side is {side!r}", f"Sides: {', '.join(SIDES)}")
    if unit not in UNITS:
        raise row.refuse(f"unit is {unit!r}", f"Units: {', '.join(UNITS)}")
    k, n = row.whole("k"), row.whole("n")
    printed = printed_rate(row)
    if n == 0 or (k is not None and n is not None and k > n):
        raise row.refuse(f"{k} of {n} is not a possible count", "Check k and n")
    if k is not None and n is None:
        raise row.refuse("k without n", "Give both, or only the rate")
    if printed is not None and n is not None:
        k = _count(row, printed, n, k)
    if k is not None and n is not None:
        rate = Fraction(k, n)
    elif printed is not None:
        rate = printed[0]
    else:
        raise row.refuse("neither a rate nor both k and n", "Give k and n, or a rate")
    return RateRecord(
        task=row.text("task"),
        condition=row.text("condition"),
        side=side,
        unit=unit,
        k=k,
        n=n,
        rate=rate,
        row=row.row,
        policy=row.text("policy"),
        half=printed[1] if printed is not None and k is None else Fraction(0),
    )


def printed_rate(row: SourceRow) -> tuple[Fraction, Fraction] | None:
    """Return the rate as printed and half a unit of its last digit, both as fractions of 1."""
    texts = {name: row.figure(name) for name in ("rate", "rate_percent")}
    given = {name: text for name, text in texts.items() if text}
    if len(given) == 2:
        raise row.refuse("both rate and rate_percent", "Give one of them")
    if not given:
        return None
    name, text = next(iter(given.items()))
    scale = 1 if name == "rate" else 100
    try:
        number = Decimal(text.removesuffix("%"))
    except InvalidOperation:
        number = Decimal("NaN")
    if not is_figure(number) or not 0 <= number <= scale:
        hint = f"{name} lies in 0..{scale}; percent go into the column rate_percent"
        raise row.refuse(f"{name} is {text!r}", hint)
    return Fraction(number) / scale, half_digit(number) / scale


def is_figure(number: Decimal) -> bool:
    """Say whether somebody may have printed this: finite, and not endlessly many digits."""
    exponent = number.as_tuple().exponent
    return isinstance(exponent, int) and max(abs(exponent), abs(number.adjusted())) <= MOST_DIGITS


def half_digit(number: Decimal) -> Fraction:
    """Return how far the true value may lie from the printed one: half a unit of its last digit.

    As many digits as a program prints end where its floats do: there the last ones are noise.
    """
    _, digits, exponent = number.as_tuple()
    half = Fraction(1, 2 * 10 ** max(0, -exponent if isinstance(exponent, int) else 0))
    return half + (abs(Fraction(number)) / 2**22 if len(digits) >= FLOAT_DIGITS else 0)


def _count(row: SourceRow, printed: tuple[Fraction, Fraction], n: int, k: int | None) -> int:
    """Return the count behind a printed rate, refusing what no count of n rounds to."""
    rate, half = printed
    nearest = int(rate * n + Fraction(1, 2))
    fewest, most = max(0, math.ceil((rate - half) * n)), min(n, math.floor((rate + half) * n))
    if k is not None:
        if not fewest <= k <= most:
            found = f"the rate {float(rate):.6g} is not {k}/{n} = {k / n:.6g}"
            raise row.refuse(found, "Correct one of them", ImpossibleRateError)
        return k
    if fewest > most:
        below = int(rate * n)
        found = f"{float(rate):.6g} x {n} = {float(rate * n):.6g} is no whole number of successes"
        hint = (
            f"{below}/{n} = {below / n:.6g} and {below + 1}/{n} = {(below + 1) / n:.6g} are the "
            "possible rates. Was another unit counted? 0.46 fits 23 of 50 objects, not 10 trials"
        )
        raise row.refuse(found, hint, ImpossibleRateError)
    if fewest < most and Fraction(nearest, n) != rate:
        found = f"{most - fewest + 1} counts of {n} round to {float(rate):.6g}"
        raise row.refuse(found, "Give k as well", AmbiguousRateError)
    return nearest
