"""Over groups: what the twin would have chosen, and what hangs on one task alone."""

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from evaluator.compare.agreement import sides, usable_groups
from evaluator.compare.measure import measured, proportion
from evaluator.compare.rows import RateGroup
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import DECISIONS, REGRET
from evaluator.result import Measurement, Table
from evaluator.statistics import agreement
from evaluator.statistics.agreement import Decision, choose, over_tasks, without_each

NO_SAMPLE = "the tasks are these, not a sample of others"


def decisions(groups: Sequence[RateGroup]) -> tuple[list[Measurement], tuple[Table, ...]]:
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
    return measurements, _decision_tables({**found, **_over_all(usable)}, usable)


def _of_these_tasks(share: Measurement) -> Measurement:
    """Leave out the interval of a share of tasks: it would be one of tasks drawn at random."""
    if share.value is None:
        return share
    return replace(share, interval=None, reason_without_interval=NO_SAMPLE)


def _mean_regret(found: dict[str, Decision], why: str) -> float:
    if not found:
        raise UndefinedStatisticError(statistic="regret", reason=why)
    return float(100 * sum(d.regret for d in found.values()) / len(found))


def _over_all(usable: Sequence[RateGroup]) -> dict[str, Decision]:
    """The one choice for all tasks, by mean rates of what every task has; nothing for one task."""
    by_task: dict[str, tuple[dict[str, Fraction], dict[str, Fraction]]] = {}
    for group in usable:
        recorded, sim = by_task.setdefault(group.task, ({}, {}))
        recorded[_candidate(group)] = group.recorded_rate or Fraction(0)
        sim[_candidate(group)] = group.sim_rate or Fraction(0)
    if len(by_task) < 2:
        return {}
    try:
        decision = choose(
            recorded=over_tasks({task: rates for task, (rates, _) in by_task.items()}),
            sim=over_tasks({task: rates for task, (_, rates) in by_task.items()}),
        )
    except UndefinedStatisticError:
        return {}
    return {"all tasks, mean rate": decision}


def _candidate(group: RateGroup) -> str:
    return ", ".join(p.replace("_", " ") for p in (group.condition, group.policy) if p)


def _decision_tables(found: dict[str, Decision], usable: Sequence[RateGroup]) -> tuple[Table, ...]:
    tables = []
    if found:
        tables.append(
            Table(
                id="decisions",
                title="What the twin would have chosen",
                columns=("task", "best in the twin", "best recorded", "right", "regret (pp)"),
                rows=tuple(
                    (
                        task,
                        " or ".join(sorted(d.sim_best)),
                        " or ".join(sorted(d.recorded_best)),
                        "yes" if d.confident else ("perhaps" if d.possibly_right else "no"),
                        round(float(100 * d.regret), 1),
                    )
                    for task, d in found.items()
                ),
                note="Ties are listed together. Regret: recorded success lost by the worst of the "
                "twin's best. Rates over trials where both sides are known.",
            )
        )
    return (*tables, *_leave_one_out(usable))


def _leave_one_out(usable: Sequence[RateGroup]) -> tuple[Table, ...]:
    try:
        left = without_each(list(dict.fromkeys(group.task for group in usable)))
    except UndefinedStatisticError:
        return ()
    rows = []
    for task, others in left.items():
        kept = [group for group in usable if group.task in others]
        recorded, sim = sides(kept)
        bias = 100 * agreement.bias(recorded=recorded, sim=sim)
        r, why = None, None
        try:
            r = round(agreement.pearson(recorded, sim), 3)
        except UndefinedStatisticError as error:
            why = error.reason
        rows.append((task, len(kept), r, round(bias, 1), why))
    note = "An agreement that one task carries alone is none."
    title = "Without one task"
    columns = ("task left out", "groups", "Pearson r", "bias (pp)", "why undefined")
    return (
        Table(id="leave_one_task_out", title=title, columns=columns, rows=tuple(rows), note=note),
    )
