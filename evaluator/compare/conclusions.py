"""What an evaluation means, task by task: bias, worth of a yes, whether the ranking is settled."""

from collections.abc import Sequence

from evaluator.compare.agreement import usable_groups
from evaluator.compare.measure import ends
from evaluator.compare.policies import Answer, Candidate
from evaluator.compare.rows import RateGroup, TrialRow
from evaluator.compare.success import trials_in
from evaluator.result import Cell, Interval, Table
from evaluator.statistics.differences import points_of
from evaluator.statistics.sequential import Stratum

MOST_TASKS = 200
"""Tasks that get a line of their own; more are a sample, and the model speaks of it."""


def conclusions_table(
    groups: Sequence[RateGroup], answers: Sequence[Answer], rows: Sequence[TrialRow] = ()
) -> tuple[Table, ...]:
    """Lay out for each task what its numbers mean; none without groups that have both rates.

    The bias is of pairs, else of both sides' own trials, over a task's groups. The ranking is
    settled when the comparison of the best and the next is decided.
    """
    usable = usable_groups(groups)
    tasks = list(dict.fromkeys(group.task for group in usable))
    if not tasks or len(tasks) > MOST_TASKS:
        return ()
    lines = [_line(task, usable, answers, rows) for task in tasks]
    note = (
        "Bias: sim minus recorded, mean of the task's groups. A yes: trials in which sim said "
        "success, and those that then succeeded; beside it what succeeded whatever sim said. "
        "Ranked: whether the recorded trials settle which candidate is best; more trials, of the "
        "best and the next together, after which the comparison is likely to be decided."
    )
    return (Table.of(lines, id="conclusions", title="What it means, task by task", note=note),)


def _line(
    task: str,
    usable: Sequence[RateGroup],
    answers: Sequence[Answer],
    rows: Sequence[TrialRow],
) -> dict[str, Cell]:
    members = [group for group in usable if group.task == task]
    bias, interval = _bias(members)
    judged = [r for r in rows if r.task == task and None not in (r.sim_planned, r.recorded)]
    accepted = [row for row in judged if row.sim_planned]
    single = len({group.task for group in usable}) == 1
    mine = [each for each in answers if each.task == task or (single and not each.task)]
    best, ranked, more = _ranking(members, mine)
    return {
        "task": task,
        "groups": len(members),
        "bias (pp)": bias,
        **dict(zip(("low", "high"), ends(interval), strict=True)),
        "interval": None if interval is None else interval.method,
        "yes": trials_in(accepted) or None,
        "yes and right": trials_in(r for r in accepted if r.recorded) if accepted else None,
        "succeeded": trials_in(r for r in judged if r.recorded) if accepted else None,
        "trials": trials_in(judged) if accepted else None,
        "candidates": len(members),
        "best recorded": best,
        "ranked": ranked,
        "more trials": more,
    }


def _bias(members: Sequence[RateGroup]) -> tuple[float, Interval | None]:
    gaps = [float((g.sim_rate or 0) - (g.recorded_rate or 0)) for g in members]
    value = 100 * sum(gaps) / len(gaps)
    strata = [_counted(group) for group in members]
    known = [each for each in strata if each is not None]
    if len(known) < len(members):
        return value, None
    return points_of(known)


def _counted(group: RateGroup) -> Stratum | None:
    """The twin's trials against the recorded ones: pairs where each trial has both sides."""
    if group.trial_table is not None and any(group.trial_table):
        _, only_sim, only_recorded, _ = group.trial_table
        return Stratum(improved=only_sim, worsened=only_recorded, pairs=sum(group.trial_table))
    real, sim = group.recorded, group.sim
    if real.k is None or not real.n or sim.k is None or not sim.n:
        return None
    return Stratum(first=(real.k, real.n), second=(sim.k, sim.n))


def _ranking(
    members: Sequence[RateGroup], answers: Sequence[Answer]
) -> tuple[str | None, str | None, int | None]:
    """Return the best candidate as recorded, whether that is settled, and how many more trials."""
    if len(members) < 2:
        return None, None, None
    ordered = sorted(members, key=lambda group: -(group.recorded_rate or 0))
    first, second = ordered[:2]
    name = ", ".join(part for part in (first.condition, first.policy) if part).replace("_", " ")
    if first.recorded_rate == second.recorded_rate:
        return None, "tie", None
    if first.recorded.n is None or second.recorded.n is None:
        return name, "no n", None
    if first.unit != "trial":
        return name, f"counted in {first.unit}s", None
    pair = {Candidate(policy=g.policy, condition=g.condition) for g in (first, second)}
    found = [e for e in answers if {e.question.first, e.question.second} == pair]
    if not found:
        return name, "no", None
    reading = found[0].reading
    if reading.better:
        return name, "yes", 0
    return name, "no", None if reading.more is None else 2 * reading.more


def direction(low: float | None, high: float | None) -> str:
    """Say what an interval of the bias settles: optimistic, pessimistic, or neither."""
    if low is None or high is None:
        return ""
    return "optimistic" if low > 0 else "pessimistic" if high < 0 else ""
