"""Do the twin's success rates of groups follow the recorded ones, and how far off are they?"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any

from evaluator import measurements
from evaluator.cache import SummaryCache
from evaluator.compare.measure import grouped, measured, percent
from evaluator.compare.rows import RateGroup
from evaluator.compare.success import of_group
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval, Measurement
from evaluator.statistics import agreement
from evaluator.statistics.agreement import counted_groups

MODEL_FROM = 4
"""Groups from which r and the bias have an interval."""
SAYS_NOTHING = 1.5
"""Width of an interval of r, of 2, from which on it says nothing."""
LIKELY_BLIND = 0.6


def usable_groups(groups: Sequence[RateGroup]) -> list[RateGroup]:
    """Return the groups with both rates."""
    return [c for c in groups if c.recorded_rate is not None and c.sim_rate is not None]


def sides(groups: Sequence[RateGroup]) -> tuple[list[Fraction], list[Fraction]]:
    """Return recorded and sim rates of usable groups."""
    recorded = [c.recorded_rate for c in groups if c.recorded_rate is not None]
    return recorded, [c.sim_rate for c in groups if c.sim_rate is not None]


def says_nothing(r: Measurement) -> bool:
    """Whether the interval of a correlation is too wide to say anything."""
    return r.interval is not None and r.interval.high - r.interval.low >= SAYS_NOTHING


def counts_of(groups: Sequence[RateGroup]) -> list[dict[str, Any]]:
    """Return the ``GroupCounts`` of each group, pairs apart; a rate without n is undefined."""
    found = []
    for group in groups:
        counted = []
        pairs = group.trial_table or (0, 0, 0, 0)
        both = (group.recorded, group.recorded_common), (group.sim, group.sim_common)
        for side, common in both:
            if side.k is None or not side.n:
                reason = f"the number of trials of {group.label} is not known"
                raise UndefinedStatisticError(statistic="model of agreement", reason=reason)
            paired = (common.k or 0, common.n or 0) if group.trial_table and common else (0, 0)
            counted.append((side.k - paired[0], side.n - paired[1]))
        shares = (group.task, group.policy, group.condition)
        found.append({"recorded": counted[0], "sim": counted[1], "pairs": pairs, "shares": shares})
    return found


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """What the model says of some groups; equal counts give the same, so it is kept."""

    r: Interval
    bias: Interval
    """Of rates from 0 to 1."""
    blind_share: tuple[float, Interval]
    blind_groups: tuple[float, ...]


def _fitted(groups: Sequence[RateGroup], cache: SummaryCache) -> Fitted | str:
    """Return the model of some groups with both rates, or why there is none."""
    if len(groups) < MODEL_FROM:
        return f"{counted_groups(len(groups))}; it needs {MODEL_FROM}"

    def fit() -> tuple[Fitted]:
        from evaluator.statistics import gap_model  # noqa: PLC0415  # scipy takes a moment

        model = gap_model.GapModel(groups=tuple(gap_model.GroupCounts(**each) for each in counts))
        blind = tuple(map(float, model.blind_groups))
        share = model.blind_share
        return (Fitted(r=model.r, bias=model.bias, blind_share=share, blind_groups=blind),)

    try:
        counts = counts_of(groups)
        return cache.kept_or_made(Fitted, repr(counts), fit)[0]
    except UndefinedStatisticError as error:
        return error.reason


def group_agreement(
    groups: Sequence[RateGroup], cache: SummaryCache | None = None
) -> list[Measurement]:
    """Measure over groups: r, ranks, bias, errors, MMRV, and where the twin may be blind."""
    usable = usable_groups(groups)
    cache = SummaryCache(None) if cache is None else cache
    model = _fitted(usable, cache)
    units = sorted({group.unit for group in usable})
    what = f"over groups (task x condition x policy), n = {len(usable)}"
    what += f", rates counted in different units ({', '.join(units)})" if len(units) > 1 else ""
    recorded, sim = sides(usable)
    both = {"recorded": [*recorded], "sim": [*sim]}
    make = partial(
        measured,
        n=len(usable),
        counted="group",
        episodes=[name for group in usable for name in group.episodes],
        reason_without_interval="it is of these groups; r and the bias have intervals over others",
    )
    return [
        _over_others(measurements.PEARSON_R.of(what=what), usable, model, "r"),
        *_by_condition(usable, cache),
        make(measurements.SPEARMAN.of(what=what), lambda: agreement.spearman(recorded, sim)),
        _over_others(measurements.BIAS.of(what=what), usable, model, "bias"),
        make(measurements.MAE.of(what=what), lambda: 100 * agreement.mean_absolute_error(**both)),
        make(
            measurements.MMRV_RECORDED.of(what=what), lambda: agreement.mmrv(**both, gap="recorded")
        ),
        *_blind(usable, model),
    ]


def _over_others(
    defined: measurements.Defined, groups: Sequence[RateGroup], model: Fitted | str, statistic: str
) -> Measurement:
    recorded, sim = sides(groups)
    interval = None if isinstance(model, str) else getattr(model, statistic)

    def compute() -> tuple[float, Interval | None]:
        if statistic == "r":
            return agreement.pearson(recorded, sim), interval
        return 100 * agreement.bias(recorded=recorded, sim=sim), percent(interval)

    return measured(
        defined,
        compute,
        n=len(groups),
        counted="group",
        reason_without_interval=model if isinstance(model, str) else None,
        episodes=[name for group in groups for name in group.episodes],
    )


def _by_condition(groups: Sequence[RateGroup], cache: SummaryCache) -> list[Measurement]:
    conditions = grouped(groups, lambda group: group.condition)
    found = []
    for name, mine in conditions.items() if len(conditions) > 1 else ():
        quantity, what = measurements.PEARSON_R_OF_CONDITION, f"over groups {name} only"
        defined = quantity.of(what=what, condition=name)
        found.append(_over_others(defined, mine, _fitted(mine, cache), "r"))
    return found


def _blind(groups: Sequence[RateGroup], model: Fitted | str) -> list[Measurement]:
    """In how many groups of this kind the twin is blind, and which of these probably are."""
    if isinstance(model, str):
        return []
    share = measured(
        measurements.BLIND_SHARE.of(), lambda: model.blind_share, n=len(groups), counted="group"
    )
    likely = [
        measured(
            of_group(measurements.BLIND_GROUP, (group.task, group.condition, group.policy)),
            partial(float, chance),
            n=(group.recorded.n or 0) + (group.sim.n or 0),
            counted="trial",
            reason_without_interval="a probability",
        )
        for group, chance in zip(groups, model.blind_groups, strict=True)
        if chance >= LIKELY_BLIND
    ]
    return [share, *likely]
