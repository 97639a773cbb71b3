"""One reason why a factor of I(tau) is false, and the earliest of many."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bridge.task.causes import Cause
from bridge.task.verdict import Factor
from twin.errors import TwinError

WORDS = {True: "accepted", False: "rejected", None: "undecided"}


class NotEvaluatedError(TwinError):
    """A trajectory cannot be judged at all; the message says why."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """What went wrong, when, and between whom."""

    t_ns: int
    cause: Cause
    detail: str
    bodies: tuple[str, ...] = ()


def factor_from(failures: Sequence[Failure], *, undecided: str | None = None) -> Factor:
    """Report the earliest failure; without one True, or None with what is ``undecided``."""
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


def with_reasons(reasons: Mapping[str, str | None]) -> str:
    """Names with why, each reason once: ``cube, box (no frames at rest); duck``."""
    names: dict[str | None, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason, []).append(name)
    return "; ".join(
        ", ".join(sharing) + (f" ({reason})" if reason else "") for reason, sharing in names.items()
    )
