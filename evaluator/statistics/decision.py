"""Would the twin have chosen what is best on the robot? A high r does not say so."""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.columns import Number


@dataclass(frozen=True, kw_only=True)
class Decision:
    """The candidates the twin calls best against those that are."""

    sim_best: frozenset[str]
    """Every candidate with the highest sim rate; several when they tie."""
    recorded_best: frozenset[str]
    possibly_right: bool
    """One of the twin's best is among the recorded best."""
    surely_right: bool
    """Every one of the twin's best is."""
    regret: Fraction
    """Best recorded rate minus that of the twin's choice, the worst of a tie."""
    regret_if_lucky: Fraction
    """The same for the best of a tie."""


def choose(*, recorded: Mapping[str, Number], sim: Mapping[str, Number]) -> Decision:
    """Choose among candidates by the twin and judge the choice by the recorded rates.

    Source: the decision audit of sim-to-real correlations (winner sets and selection regret,
    with ties as sets). Exact on counts.

    Args:
        recorded: Recorded success rate of each candidate.
        sim: The twin's, of the same candidates.

    Raises:
        UndefinedStatisticError: Below two candidates: there is nothing to choose.
        ValueError: When the sides name different candidates.
    """
    if recorded.keys() != sim.keys():
        message = f"different candidates: {sorted(recorded)} recorded, {sorted(sim)} in the twin"
        raise ValueError(message)
    if len(recorded) < 2:
        raise UndefinedStatisticError(
            statistic="decision",
            reason=f"{len(recorded)} candidate{'s' if len(recorded) != 1 else ''}; a choice needs "
            "two",
        )
    x = {name: Fraction(rate) for name, rate in recorded.items()}
    y = {name: Fraction(rate) for name, rate in sim.items()}
    sim_best = frozenset(name for name in y if y[name] == max(y.values()))
    recorded_best = frozenset(name for name in x if x[name] == max(x.values()))
    losses = [max(x.values()) - x[name] for name in sim_best]
    return Decision(
        sim_best=sim_best,
        recorded_best=recorded_best,
        possibly_right=bool(sim_best & recorded_best),
        surely_right=sim_best <= recorded_best,
        regret=max(losses),
        regret_if_lucky=min(losses),
    )


def over_tasks(rates: Mapping[str, Mapping[str, Number]]) -> dict[str, Fraction]:
    """Return each candidate's mean rate over tasks, from task -> candidate -> rate.

    Only candidates that every task has: others would be judged by easier or harder tasks.

    Raises:
        UndefinedStatisticError: Without tasks.
    """
    if not rates:
        raise UndefinedStatisticError(statistic="decision", reason="there are no tasks")
    shared = set.intersection(*(set(by_candidate) for by_candidate in rates.values()))
    return {
        name: sum((Fraction(by_candidate[name]) for by_candidate in rates.values()), Fraction(0))
        / len(rates)
        for name in sorted(shared)
    }


def without_each(names: list[str]) -> dict[str, list[str]]:
    """Return for each name the others: what is left when one task is left out.

    Raises:
        UndefinedStatisticError: Below two names: nothing would be left.
    """
    if len(names) < 2:
        raise UndefinedStatisticError(
            statistic="leave one task out",
            reason=f"{len(names)} task{'s' if len(names) != 1 else ''}; nothing would be left",
        )
    return {name: [other for other in names if other != name] for name in names}
