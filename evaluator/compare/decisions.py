"""Over groups: what the twin would have chosen."""

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from evaluator.compare.agreement import usable_groups
from evaluator.compare.measure import measured, proportion
from evaluator.compare.rows import RateGroup
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import DECISIONS, REGRET
from evaluator.result import Measurement
from evaluator.statistics.agreement import Decision, choose

NO_SAMPLE = "the tasks are these, not a sample of others"


def decisions(groups: Sequence[RateGroup]) -> list[Measurement]:
    """Judge the choice the twin would have made among conditions and policies, task by task."""
    usable = usable_groups(groups)
    found: dict[str, Decision] = {}
    for task in dict.fromkeys(group.task for group in usable):
        members = [group for group in usable if group.task == task]
        try:
            found[task] = choose(
                recorded={_candidate(c): c.recorded_rate or Fraction(0) for c in members},
                sim={_candidate(c): c.sim_rate or Fraction(0) for c in members},
            )
        except UndefinedStatisticError:
            continue
    why = "no task has two conditions or policies to choose from"
    measurements = [
        _of_these_tasks(
            proportion(
                quantity.of(),
                sum(getattr(decision, name) for decision in found.values()),
                len(found),
                counted="task",
                reason_if_undefined=why,
            )
        )
        for name, quantity in DECISIONS.items()
    ]
    measurements.append(
        measured(
            REGRET.of(),
            lambda: _mean_regret(found, why),
            n=len(found),
            counted="task",
            reason_without_interval=NO_SAMPLE,
        )
    )
    return measurements


def _of_these_tasks(share: Measurement) -> Measurement:
    """Leave out the interval of a share of tasks: it would be one of tasks drawn at random."""
    if share.value is None:
        return share
    return replace(share, interval=None, reason_without_interval=NO_SAMPLE)


def _mean_regret(found: dict[str, Decision], why: str) -> float:
    if not found:
        raise UndefinedStatisticError(statistic="regret", reason=why)
    return float(100 * sum(d.regret for d in found.values()) / len(found))


def _candidate(group: RateGroup) -> str:
    return ", ".join(p.replace("_", " ") for p in (group.condition, group.policy) if p)
