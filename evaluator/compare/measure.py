"""Turn counts and statistics into ``Measurement`` records; what is undefined keeps its reason."""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from statistics import median
from typing import TypeVar

from bridge.errors import UsageError
from evaluator.errors import AlikeNamesError, UndefinedStatisticError
from evaluator.measurements import Defined, quantity_of, slug
from evaluator.result import Cell, Exclusion, Interval, Measurement, Table
from evaluator.statistics.intervals import median_interval, wilson

Item = TypeVar("Item")
Group = TypeVar("Group")


def _rounded(value: float | None, factor: float) -> float | None:
    """Return a value in another unit; None where there is none, or it is not a number."""
    return None if value is None or not math.isfinite(value) else round(factor * value, 2)


millimetres = milliseconds = partial(_rounded, factor=1e3)
degrees = partial(_rounded, factor=math.degrees(1.0))


def ends(interval: Interval | None) -> tuple[float | None, float | None]:
    """Return both ends of an interval; unknown without one."""
    return (None, None) if interval is None else (interval.low, interval.high)


def percent(interval: Interval | None) -> Interval | None:
    """Return an interval of shares in per cent."""
    return interval and replace(interval, low=100 * interval.low, high=100 * interval.high)


RATE_COLUMNS = ("k", "n", "rate", "low", "high", "interval")
"""Columns of a table that ``rate_row`` fills: a share from 0 to 1 with its interval's method."""


def rate_row(rate: Measurement) -> tuple[Cell, ...]:
    """Lay one rate out in columns; unknown is None."""
    method = None if rate.interval is None else rate.interval.method
    counts = (None, None) if rate.value is None and not rate.n else (rate.k, rate.n)
    return (*counts, rate.value, *ends(rate.interval), method)


def grouped(items: Iterable[Item], key: Callable[[Item], Group]) -> dict[Group, list[Item]]:
    """Gather items by their key, in the order in which keys come first."""
    groups: dict[Group, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def average(items: Sequence[Item], read: Callable[[Item], float | None]) -> float | None:
    """Return the mean of what is known; None when nothing is."""
    values = [value for item in items if (value := read(item)) is not None]
    return sum(values) / len(values) if values else None


def mean_of(values: Sequence[float], statistic: str, reason: str) -> float:
    """Return the mean; undefined for the reason given where there is no value."""
    if not values:
        raise UndefinedStatisticError(statistic=statistic, reason=reason)
    return sum(values) / len(values)


@dataclass(frozen=True, kw_only=True)
class Part:
    """Numbers, tables, and what could not enter them."""

    measurements: tuple[Measurement, ...] = ()
    tables: tuple[Table, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    missing: tuple[str, ...] = ()


def joined(parts: Iterable[Part]) -> Part:
    """Put parts one behind the other."""
    together = list(parts)
    return Part(
        **{
            each.name: tuple(item for part in together for item in getattr(part, each.name))
            for each in fields(Part)
        }
    )


_HASHES = re.compile(r"\b(server|code|map)=(\S+)")
"""What a rollout says of who acted, beside or instead of a checkpoint."""


def refuse_changed(named: Iterable[tuple[str, str, str]]) -> None:
    """Refuse a policy that was another checkpoint before: one name would stand for both.

    ``named``: where it stands, the policy, and who acted.
    """
    seen: dict[tuple[str, str], tuple[str, str]] = {}
    for where, policy, who in named:
        parts = {**dict(_HASHES.findall(who)), "checkpoint": _HASHES.sub("", who).strip()}
        for part, now in parts.items():
            first, place = seen.setdefault((policy, part), (now, where)) if now else ("", "")
            if policy and now and first != now:
                raise UsageError(
                    f"{where}: policy {policy!r} is {part} {now!r}, in {place} {first!r}. Give "
                    "each checkpoint a policy name of its own, or leave one of them out."
                )


def refuse_alike(
    kind: str, named: Iterable[tuple[str, str]], by: Callable[[str], str] = slug
) -> None:
    """Refuse two names that would share an id: the number of one would stand for both."""
    places: dict[str, str] = {}
    for name, where in named:
        places.setdefault(name, where)
    first_with: dict[str, str] = {}
    for name, where in places.items():
        owner = first_with.setdefault(by(name), name)
        if owner != name:
            raise AlikeNamesError(kind=kind, names=(owner, name), places=(places[owner], where))


def measured(
    defined: Defined,
    compute: Callable[[], float | tuple[float, Interval | None]],
    *,
    n: int | None = None,
    counted: str | None = None,
    reason_without_interval: str | None = None,
    episodes: Iterable[str] = (),
) -> Measurement:
    """Compute one statistic; ``compute`` gives a value, or a value with its interval.

    It refuses by ``UndefinedStatisticError``. What is not finite is undefined and says so: one
    broken pose must not end an evaluation.
    """
    value: float | None = None
    interval: Interval | None = None
    reason: str | None = None
    try:
        outcome = compute()
        value, interval = outcome if isinstance(outcome, tuple) else (outcome, None)
    except UndefinedStatisticError as error:
        reason = error.reason
    if value is not None and not math.isfinite(value):
        value, interval = None, None
        reason = "the recorded or replayed data hold values that are not finite"
    quantity = quantity_of(defined.id)
    if value is not None and quantity is not None and not quantity.holds(value):
        reason = f"computed {value:.6g}, which its definition does not allow; please report this"
        value, interval = None, None
    if interval is not None and quantity is not None:  # what cannot be is no part of an interval
        low, high = max(interval.low, quantity.low), min(interval.high, quantity.high)
        interval = replace(interval, low=low, high=high)
    return Measurement(
        **vars(defined),
        value=value,
        interval=interval,
        n=n,
        counted=counted,
        reason_if_undefined=reason,
        reason_without_interval=reason_without_interval if interval is None else None,
        episodes=tuple(episodes),
    )


def measured_median(
    defined: Defined,
    values: Sequence[float],
    *,
    reason_if_undefined: str,
    n: int,
    counted: str,
    episodes: Iterable[str],
) -> Measurement:
    """Measure a median with its interval, or the reason why it has none."""
    interval, reason = None, None
    try:
        interval = median_interval(values)
    except UndefinedStatisticError as error:
        reason = error.reason

    def compute() -> tuple[float, Interval | None]:
        if not values:
            raise UndefinedStatisticError(statistic="median", reason=reason_if_undefined)
        return float(median(values)), interval

    more = {"counted": counted, "reason_without_interval": reason}
    return measured(defined, compute, n=n, episodes=episodes, **more)


def proportion(
    defined: Defined,
    k: int,
    n: int,
    *,
    reason_if_undefined: str,
    counted: str = "trial",
    episodes: Iterable[str] = (),
) -> Measurement:
    """Measure k/n with Wilson's interval; undefined for n = 0."""
    return Measurement(
        **vars(defined),
        value=k / n if n else None,
        interval=wilson(k, n) if n else None,
        k=k,
        n=n,
        counted=counted,
        reason_if_undefined=None if n else reason_if_undefined,
        episodes=tuple(episodes),
    )
