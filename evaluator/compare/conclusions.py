"""What an evaluation means, task by task: bias, worth of a yes, whether the ranking is settled.

And what it could not have seen: the smallest difference that so many trials would show.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from evaluator.compare.agreement import usable_groups
from evaluator.compare.measure import ends
from evaluator.compare.model import model_of
from evaluator.compare.rows import RateGroup, TrialRow
from evaluator.compare.success import trials_in
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Cell, Interval, Table
from evaluator.statistics.differences import (
    mean_of_intervals,
    newcombe_difference,
    tango_points,
)
from evaluator.statistics.hierarchical import estimate
from evaluator.statistics.power import detectable_rate, trials_needed

MOST_TASKS = 200
"""Tasks that get a line of their own; more are a sample, and the model speaks of it."""
UNREACHABLE = 5000
"""Trials beyond which nobody asks."""


def conclusions_table(
    groups: Sequence[RateGroup], rows: Sequence[TrialRow] = ()
) -> tuple[Table, ...]:
    """Lay out for each task what its numbers mean; none without groups that have both rates.

    The bias is the model's where there are counts and three groups, else of the pairs (Tango) or
    of both sides' own trials (Newcombe), over two groups their mean (Zou and Donner). The ranking
    is settled when the interval of the recorded difference of the best and the next leaves zero
    out.
    """
    usable = usable_groups(groups)
    tasks = list(dict.fromkeys(group.task for group in usable))
    if not tasks or len(tasks) > MOST_TASKS:
        return ()
    lines = [_line(task, usable, rows) for task in tasks]
    note = (
        "Bias: sim minus recorded, mean of the task's groups. A yes: trials in which sim said "
        "success, and those that then succeeded; beside it what succeeded whatever sim said. "
        "Ranked: whether the recorded trials settle which candidate is best; more trials, of the "
        "best and the next together, that would with 80 % power if the rates are as they look. "
        "Smallest: the difference of two candidates, and of sim and recorded, that so many trials "
        "would show with 80 % power (unpaired)."
    )
    return (Table.of(lines, id="conclusions", title="What it means, task by task", note=note),)


def _line(task: str, usable: Sequence[RateGroup], rows: Sequence[TrialRow]) -> dict[str, Cell]:
    members = [group for group in usable if group.task == task]
    bias, interval = _bias(task, members, usable)
    judged = [r for r in rows if r.task == task and None not in (r.sim_planned, r.recorded)]
    accepted = [row for row in judged if row.sim_planned]
    best, ranked, more = _ranking(members)
    n = [group.recorded.n for group in members if group.recorded.n]
    sim_n = [group.sim.n for group in members if group.sim.n]
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
        "recorded trials per candidate": min(n) if n else None,
        "smallest difference (pp)": _smallest(members, min(n) if n else 0),
        "smallest bias (pp)": _smallest(members, min(n + sim_n) if n and sim_n else 0),
    }


def _bias(
    task: str, members: Sequence[RateGroup], usable: Sequence[RateGroup]
) -> tuple[float, Interval | None]:
    gaps = [float((g.sim_rate or 0) - (g.recorded_rate or 0)) for g in members]
    value = 100 * sum(gaps) / len(gaps)
    try:
        model = model_of(usable)
        places = [place for place, group in enumerate(usable) if group.task == task]
        found = estimate(model.draws.gap[:, places].mean(axis=1))
    except UndefinedStatisticError:
        return value, _counted(members)
    return 100 * found.mean, found.interval(100.0)


def _counted(members: Sequence[RateGroup]) -> Interval | None:
    """The interval of the mean gap from each group's own counts, as if none shared a trial."""
    gaps = [100 * float((g.sim_rate or 0) - (g.recorded_rate or 0)) for g in members]
    found = [_of_group(group) for group in members]
    known = [each for each in found if each is not None]
    if len(known) < len(members):
        return None
    return known[0] if len(known) == 1 else mean_of_intervals(gaps, known)


def _of_group(group: RateGroup) -> Interval | None:
    if group.trial_table is not None and any(group.trial_table):
        both, only_sim, only_recorded, neither = group.trial_table
        n = both + only_sim + only_recorded + neither
        return tango_points(only_sim, only_recorded, n)[1]
    real, sim = group.recorded, group.sim
    if real.k is None or not real.n or sim.k is None or not sim.n:
        return None
    found = newcombe_difference(real.k, real.n, sim.k, sim.n)
    return replace(found, low=100 * found.low, high=100 * found.high)


def _ranking(members: Sequence[RateGroup]) -> tuple[str | None, str | None, int | None]:
    """Return the best candidate as recorded, whether that is settled, and how many more trials."""
    if len(members) < 2:
        return None, None, None
    ordered = sorted(members, key=lambda group: -(group.recorded_rate or 0))
    first, second = ordered[:2]
    name = ", ".join(part for part in (first.condition, first.policy) if part).replace("_", " ")
    if first.recorded_rate == second.recorded_rate:
        return None, "tie", None
    a, b = first.recorded, second.recorded
    if a.k is None or not a.n or b.k is None or not b.n:
        return name, "no n", None
    if newcombe_difference(b.k, b.n, a.k, a.n).low > 0:
        return name, "yes", 0
    try:
        needed = trials_needed(b.k / b.n, a.k / a.n)
    except UndefinedStatisticError:
        return name, "no", None
    more = max(0, needed - a.n) + max(0, needed - b.n)
    return name, "no", more if 0 < more < UNREACHABLE else None


def _smallest(members: Sequence[RateGroup], n: int) -> float | None:
    """The smallest difference [pp] to a rate like these that n trials on each side would show."""
    rates = [float(group.recorded_rate or 0) for group in members]
    middle = sum(rates) / len(rates)
    below = min(middle, 1 - middle)  # towards the middle there is more room
    try:
        return 100 * (detectable_rate(below, n) - below)
    except UndefinedStatisticError:
        return None


def direction(low: float | None, high: float | None) -> str:
    """Say what an interval of the bias settles: optimistic, pessimistic, or neither."""
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        return ""
    if low > 0:
        return "optimistic"
    return "pessimistic" if high < 0 else ""
