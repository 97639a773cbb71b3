"""One reason why a factor of I(tau) is false, and the earliest of many."""

from collections.abc import Sequence
from dataclasses import dataclass

from bridge.task.verdict import Factor


@dataclass(frozen=True, kw_only=True)
class Failure:
    """What went wrong, when, and between whom."""

    t_ns: int
    cause: str
    detail: str
    bodies: tuple[str, ...] = ()


def factor_from(failures: Sequence[Failure], *, undecided: str | None = None) -> Factor:
    """Report the earliest failure; without one True, or None when something is undecided."""
    if failures:
        first = min(failures, key=lambda failure: failure.t_ns)
        return Factor(
            value=False,
            first_t_ns=first.t_ns,
            cause=first.cause,
            bodies=first.bodies,
            detail=first.detail,
        )
    if undecided is not None:
        return Factor(value=None, detail=undecided)
    return Factor(value=True)
