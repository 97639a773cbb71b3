"""What an evaluation means, task by task: bias, and the worth of a yes."""

from collections.abc import Sequence

from evaluator.compare.agreement import usable_groups
from evaluator.compare.measure import ends, grouped
from evaluator.compare.rows import RateGroup, TrialRow
from evaluator.result import Cell, Table
from evaluator.statistics.differences import points_of
from evaluator.statistics.sequential import Stratum

MOST_TASKS = 200
"""Tasks that get a line of their own; more are a sample, and the model speaks of it."""
CLOSE_PP = 10.0
"""A bias smaller than this does not change what one does with a rate [percentage points]."""


def conclusions_table(
    groups: Sequence[RateGroup], rows: Sequence[TrialRow] = ()
) -> tuple[Table, ...]:
    """Lay out for each task what its numbers mean; none without groups that have both rates.

    The bias is of pairs, else of both sides' own trials, over a task's groups.
    """
    tasks = grouped(usable_groups(groups), lambda group: group.task)
    if not tasks or len(tasks) > MOST_TASKS:
        return ()
    lines = [_line(task, members, rows) for task, members in tasks.items()]
    note = (
        "Bias: twin minus recorded, mean of the task's groups. A yes: trials in which it said "
        "success, and those that then succeeded; beside it what succeeded whatever it said."
    )
    return (Table.of(lines, id="conclusions", title="What it means, task by task", note=note),)


def _line(task: str, members: Sequence[RateGroup], rows: Sequence[TrialRow]) -> dict[str, Cell]:
    bias = 100 * sum(float(group.gap or 0) for group in members) / len(members)
    known, interval = [each for each in map(counted, members) if each is not None], None
    if len(known) == len(members):
        bias, interval = points_of(known)
    judged = [r for r in rows if r.task == task and None not in (r.sim_planned, r.recorded)]
    accepted = [row for row in judged if row.sim_planned]
    return {
        "task": task,
        "groups": len(members),
        "bias (pp)": bias,
        **dict(zip(("low", "high"), ends(interval), strict=True)),
        "interval": None if interval is None else interval.method,
        "yes": len(accepted) or None,
        "yes and right": sum(bool(r.recorded) for r in accepted) if accepted else None,
        "succeeded": sum(bool(r.recorded) for r in judged) if accepted else None,
        "trials": len(judged) if accepted else None,
    }


def counted(group: RateGroup) -> Stratum | None:
    """Lay the twin's trials beside the recorded ones, as pairs where each trial has both sides."""
    if group.trial_table is not None and any(group.trial_table):
        _, only_sim, only_recorded, _ = group.trial_table
        return Stratum(improved=only_sim, worsened=only_recorded, pairs=sum(group.trial_table))
    real, sim = group.recorded, group.sim
    if real.k is None or not real.n or sim.k is None or not sim.n:
        return None
    return Stratum(first=(real.k, real.n), second=(sim.k, sim.n))


def direction(low: float | None, high: float | None) -> str:
    """Say what an interval of the bias settles: optimistic, pessimistic, or neither."""
    if low is None or high is None:
        return ""
    return "optimistic" if low > 0 else "pessimistic" if high < 0 else ""
