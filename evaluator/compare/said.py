"""What a verdict said, as far as an evaluation goes by it."""

from dataclasses import dataclass

from bridge.clock import NS_PER_S
from bridge.task.verdict import Verdict
from evaluator.compare.clauses import FACTORS, Clauses, clauses_of


@dataclass(frozen=True, kw_only=True)
class Said:
    """One verdict on one plan."""

    accepted: bool | None
    """None where the twin could not decide."""
    why_undecided: str
    p_success: float | None
    first_failing: str | None
    """ik, clearance or terminal; None where none is false."""
    failing_cause: str | None
    """The cause alone, to be counted: ``collision``, ``unreachable`` ..."""
    failing_detail: str | None
    """Cause, bodies and time, to be read."""
    clauses: Clauses = ()


def said_by(verdict: Verdict) -> Said:
    """Sum a verdict up."""
    name = verdict.first_failing
    probability = None if verdict.p_success is None else verdict.p_success.get("value")
    return Said(
        accepted=verdict.accepted,
        why_undecided=verdict.reason or _undecided(verdict),
        p_success=None if probability is None else float(probability),
        first_failing=name,
        failing_cause=None if name is None else getattr(verdict, name).cause,
        failing_detail=_detail(verdict),
        clauses=clauses_of(verdict),
    )


def _undecided(verdict: Verdict) -> str:
    names = [name for name in FACTORS if getattr(verdict, name).value is None]
    return f"{' and '.join(names)} undecided"


def _detail(verdict: Verdict) -> str | None:
    if verdict.first_failing is None:
        return None
    factor = getattr(verdict, verdict.first_failing)
    parts = [factor.cause, " and ".join(factor.bodies), factor.detail]
    if factor.first_t_ns is not None:
        parts.append(f"at {factor.first_t_ns / NS_PER_S:.2f} s")
    return ", ".join(part for part in parts if part) or None
