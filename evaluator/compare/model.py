"""One model of the gap over all groups: the headline intervals, each task's bias, the ranking.

What the model is stands in ``evaluator/statistics/hierarchical.py``. It needs counts on both sides
of every group; a printed rate without n has no place in it.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from evaluator.compare.measure import measured
from evaluator.compare.rows import RateGroup
from evaluator.compare.success import WITH, WITHOUT
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import (
    MODEL_BEST,
    MODEL_BETWEEN,
    MODEL_BIAS,
    MODEL_BIAS_OF_GROUP,
    MODEL_GAIN,
    MODEL_GAIN_OF_TASK,
    MODEL_OPPOSED,
    MODEL_R,
    MODEL_R_OTHERS,
    MODEL_WITHIN,
    Defined,
)
from evaluator.result import Interval, Measurement
from evaluator.statistics.group_likelihood import GroupCounts
from evaluator.statistics.hierarchical import (
    AgreementModel,
    Estimate,
    chosen_is_best,
    estimate,
)

HEADLINE_FROM = 4
"""Groups from which the model's interval of r and of the bias is the headline."""
CERTAIN = 0.95
WHAT = "model of agreement"


def shared_by(groups: Sequence[RateGroup]) -> list[str]:
    """Name for each group what it shares with others: its task, of one task alone its policy."""
    by_task = len({group.task for group in groups}) > 1
    return [group.task if by_task else group.policy for group in groups]


def counts_of(groups: Sequence[RateGroup]) -> tuple[GroupCounts, ...]:
    """Return what was counted in each group, paired trials apart from those without a partner."""
    found = []
    for group, shared in zip(groups, shared_by(groups), strict=True):
        sides = []
        pairs = group.trial_table or (0, 0, 0, 0)
        for side, common in (
            (group.recorded, group.recorded_common),
            (group.sim, group.sim_common),
        ):
            if side.k is None or not side.n:
                reason = f"the number of trials of {group.label} is not known"
                raise UndefinedStatisticError(statistic=WHAT, reason=reason)
            paired = (common.k or 0, common.n or 0) if group.trial_table and common else (0, 0)
            sides.append((side.k - paired[0], side.n - paired[1]))
        found.append(GroupCounts(recorded=sides[0], sim=sides[1], pairs=pairs, task=shared))
    return tuple(found)


@lru_cache(maxsize=16)
def fitted(counts: tuple[GroupCounts, ...]) -> AgreementModel:
    """Return the model of some counts; equal ones are integrated once."""
    return AgreementModel(counts)


def model_of(groups: Sequence[RateGroup]) -> AgreementModel:
    """Return the model of some groups.

    Raises:
        UndefinedStatisticError: Below three groups, or without counts.
    """
    return fitted(counts_of(groups))


def headline_interval(statistic: str, groups: Sequence[RateGroup]) -> Interval | None:
    """Return the model's interval of ``pearson`` or ``bias`` [1] over other groups like these.

    Args:
        groups: With both rates; None without counts or below four.
    """
    if statistic not in ("pearson", "bias") or len(groups) < HEADLINE_FROM:
        return None
    try:
        model = model_of(groups)
    except UndefinedStatisticError:
        return None
    found = model.pearson_others if statistic == "pearson" else model.bias_others
    return found.interval()


def model_results(
    groups: Sequence[RateGroup],
) -> list[Measurement]:
    """Measure everything that the model says beyond the headline."""
    if len(groups) < 2:
        return []
    try:
        model = model_of(groups)
    except UndefinedStatisticError as error:
        return [_refused(error, len(groups))]
    draws = model.draws
    measurements = [
        _of(MODEL_R.of(), estimate(draws.pearson), len(groups)),
        _of(MODEL_R_OTHERS.of(), model.pearson_others, len(groups)),
        _of(MODEL_BIAS.of(), estimate(draws.gap.mean(axis=1)), len(groups), 100.0),
    ]
    if model.in_tasks:
        tasks = len({group.task for group in groups})
        measurements += [
            _of(MODEL_WITHIN.of(), model.within, len(groups)),
            _of(MODEL_BETWEEN.of(), model.between, tasks, counted="task"),
            _share(MODEL_OPPOSED.of(), model.opposed, tasks, "task"),
        ]
    gaps = [estimate(draws.gap[:, place]) for place in range(len(groups))]
    for group, gap in zip(groups, gaps, strict=True):
        parts = {"task": group.task, "condition": group.condition, "policy": group.policy}
        measurements.append(
            _of(MODEL_BIAS_OF_GROUP.of(**parts), gap, _trials(group), 100.0, counted="trial")
        )
    return [*measurements, *_gains(groups, model), *_ranking(groups, model)]


def _of(
    defined: Defined, found: Estimate, n: int, factor: float = 1.0, *, counted: str = "group"
) -> Measurement:
    return measured(
        defined,
        lambda: (factor * found.mean, found.interval(factor)),
        n=n,
        counted=counted,
    )


def _share(defined: Defined, value: float, n: int, counted: str) -> Measurement:
    reason = "a probability"
    return measured(defined, lambda: value, n=n, counted=counted, reason_without_interval=reason)


def _refused(error: UndefinedStatisticError, num_groups: int) -> Measurement:
    def refuse() -> float:
        raise error

    return measured(MODEL_R.of(), refuse, n=num_groups, counted="group")


def _trials(group: RateGroup) -> int:
    return (group.recorded.n or 0) + (group.sim.n or 0)


def _gains(groups: Sequence[RateGroup], model: AgreementModel) -> list[Measurement]:
    """The gain with replanning per task, small groups drawn towards the others, and its mean."""
    places = {(g.task, g.policy, g.condition): at for at, g in enumerate(groups)}
    pairs = [
        (task, policy, before, places[task, policy, WITH])
        for (task, policy, condition), before in places.items()
        if condition == WITHOUT and (task, policy, WITH) in places
    ]
    found = []
    for side, rates in (("recorded", model.draws.recorded), ("sim", model.draws.sim)):
        gains = [rates[:, after] - rates[:, before] for _, _, before, after in pairs]
        for (task, policy, before, after), gain in zip(pairs, gains, strict=True):
            n = sum(getattr(groups[at], side).n or 0 for at in (before, after))
            defined = MODEL_GAIN_OF_TASK.of(side=side, task=task, policy=policy)
            found.append(_of(defined, estimate(gain), n, 100.0, counted="trial"))
        if len(pairs) > 1:
            mean = estimate(np.mean(gains, axis=0))
            found.append(_of(MODEL_GAIN.of(side=side), mean, len(pairs), 100.0, counted="task"))
    return found


def _ranking(groups: Sequence[RateGroup], model: AgreementModel) -> list[Measurement]:
    """Ask whether the twin's best is the recorded best, over the tasks that all candidates have."""
    for kind in ("policy", "condition"):
        names = list(dict.fromkeys(getattr(group, kind) for group in groups))
        if len(names) > 1:
            break
    else:
        return []
    others = "condition" if kind == "policy" else "policy"
    cells: dict[tuple[str, str], dict[str, int]] = {}
    for place, group in enumerate(groups):
        cells.setdefault((group.task, getattr(group, others)), {})[getattr(group, kind)] = place
    shared = [cell for cell in cells.values() if len(cell) == len(names)]
    if not shared:
        return []
    columns = [[cell[name] for cell in shared] for name in names]

    def over(rates: np.ndarray) -> np.ndarray:
        return np.stack([rates[:, column].mean(axis=1) for column in columns], axis=1)

    sim = [sum(groups[p].sim_rate or 0 for p in column) / len(column) for column in columns]
    picked = [place for place, rate in enumerate(sim) if rate == max(sim)]
    best = chosen_is_best(model.draws, picked, over)
    words = " or ".join(names[place] for place in picked)
    return [_share(MODEL_BEST.of(words=words), best, len(names), kind)]
