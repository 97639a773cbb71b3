"""Do the twin's success rates of groups follow the recorded ones, and how far off are they?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import numpy as np

from evaluator.compare.measure import measured
from evaluator.compare.model import headline_interval
from evaluator.compare.rows import RateGroup
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import (
    BIAS,
    MAE,
    MMRV_RECORDED,
    ORDER_ACCURACY,
    PEARSON_R,
    PEARSON_R_OF_CONDITION,
    PEARSON_R_REMEASURED,
    SPEARMAN,
    Quantity,
)
from evaluator.result import Cell, Interval, Measurement, Table
from evaluator.statistics import agreement
from evaluator.statistics.agreement import Number, counted_groups, fisher_interval, pearson
from evaluator.statistics.bootstrap import (
    GroupSample,
    Remeasured,
    remeasure_counts,
    remeasure_paired,
    student_interval,
)
from evaluator.statistics.coverage import vouch

SEED = 0
"""Resampling is seeded: the same groups give the same interval."""
MIN_CLUSTERS = 4


def usable_groups(groups: Sequence[RateGroup]) -> list[RateGroup]:
    """Return the groups with both rates."""
    return [c for c in groups if c.recorded_rate is not None and c.sim_rate is not None]


def sides(groups: Sequence[RateGroup]) -> tuple[list[Fraction], list[Fraction]]:
    """Return recorded and sim rates of usable groups."""
    recorded = [c.recorded_rate for c in groups if c.recorded_rate is not None]
    return recorded, [c.sim_rate for c in groups if c.sim_rate is not None]


@dataclass(frozen=True, kw_only=True)
class Found:
    """An interval, or the reason why there is none."""

    interval: Interval | None
    reason: str
    key: str
    """Its name in ``coverage.HOLDS_FROM``."""
    num_units: int
    """Groups or clusters of groups: what coverage depends on."""


class GroupIntervals:
    """The intervals of some groups: what belongs together is found once."""

    def __init__(self, groups: Sequence[RateGroup]) -> None:
        """Prepare; both rates of each group are known."""
        self._groups = list(groups)
        self.num_groups = len(self._groups)
        self._recorded, self._sim = sides(groups)
        self._clusters, self.num_units, self.unit = clusters_of(groups)

    @property
    def kind(self) -> str:
        """Points where groups are independent, else clusters."""
        return "points" if self.unit == "groups" else "clusters"

    def model(self, statistic: str) -> Interval | None:
        """Return the interval of the model of all counts, which goes before all others."""
        return headline_interval(statistic, self._groups)

    def of(self, statistic: str) -> Found:
        """Return Fisher's interval of r, Student's of the bias, and the jackknife's of others."""
        interval, reason, key = None, "", f"jackknife-{self.kind}:{statistic}"
        is_fisher = (statistic, self.kind) == ("pearson", "points")
        try:
            if is_fisher:
                key = "fisher-z"
                interval = fisher_interval(pearson(self._recorded, self._sim), self.num_groups)
            elif statistic == "bias" and (means := self._means()):
                key = "student-t:bias"
                interval = student_interval(means)
            else:
                clusters = None if self.kind == "points" else self._clusters
                sample = GroupSample(recorded=self._recorded, sim=self._sim, clusters=clusters)
                interval = sample.interval(statistic)
        except UndefinedStatisticError as error:
            reason = f"{self.num_units} {self.unit}: {error.reason}"
            if self.num_units < MIN_CLUSTERS:
                reason = self._too_few(is_fisher=is_fisher)
        return Found(interval=interval, reason=reason, key=key, num_units=self.num_units)

    def _means(self) -> list[Fraction]:
        """Mean gap of each unit; none where the units differ in size, for then means do too."""
        members: dict[str, list[Fraction]] = {}
        for name, recorded, sim in zip(self._clusters, self._recorded, self._sim, strict=True):
            members.setdefault(name, []).append(sim - recorded)
        if len({len(gaps) for gaps in members.values()}) != 1:
            return []
        return [sum(gaps, Fraction(0)) / len(gaps) for gaps in members.values()]

    def _too_few(self, *, is_fisher: bool) -> str:
        if self.unit == "groups":
            name = "Fisher's interval" if is_fisher else "an interval over groups"
            return f"{counted_groups(self.num_units)}; {name} needs {MIN_CLUSTERS}"
        why = "groups share tasks across conditions" if _is_shared(self._groups) else ""
        why = why or "groups share policies or tasks"
        return (
            f"{why}, and {self.num_units} {self.unit} are too few to resample ({MIN_CLUSTERS} are "
            "needed); an interval of independent groups would claim too much"
        )

    def again(self) -> Remeasured:
        """Draw the trials of every group anew."""
        rng = np.random.default_rng(SEED)
        tables = [group.trial_table for group in self._groups if group.trial_table is not None]
        if self._groups and len(tables) == len(self._groups):
            return remeasure_paired(tables, rng=rng)
        pairs = [group.pair for group in self._groups]
        sim = [(s.k, s.n) for s, _ in pairs if s.k is not None and s.n]
        recorded = [(r.k, r.n) for _, r in pairs if r.k is not None and r.n]
        if self._groups and len(sim) == len(recorded) == len(self._groups):
            return remeasure_counts(recorded, sim, rng=rng)
        raise UndefinedStatisticError(
            statistic="remeasured", reason="the number of trials of a group is not known"
        )


def _is_shared(groups: Sequence[RateGroup]) -> bool:
    return len({(c.task, c.policy) for c in groups}) < len(groups)


def clusters_of(groups: Sequence[RateGroup]) -> tuple[list[str], int, str]:
    """Return what each group belongs to, how many of those there are, and their name."""
    policies, tasks = [c.policy for c in groups], [c.task for c in groups]
    if not _is_shared(groups) and len(set(policies)) in (1, len(groups)):
        return [str(i) for i in range(len(groups))], len(groups), "groups"
    if len(set(policies)) >= MIN_CLUSTERS or len(set(policies)) > len(set(tasks)):
        return policies, len(set(policies)), "policies"
    conditions = [c.condition for c in groups]
    if len(set(tasks)) < MIN_CLUSTERS <= len(set(conditions)):
        return conditions, len(set(conditions)), "conditions"
    return tasks, len(set(tasks)), "tasks"


OTHERS, AGAIN = "other {} like these", "the same groups measured again"


def interval_table(
    intervals: GroupIntervals, statistics: Sequence[tuple[str, str, float]]
) -> tuple[Table, ...]:
    """Lay out both intervals of every statistic; none without groups."""
    if intervals.num_units == 0:
        return ()
    try:
        again: Remeasured | None = intervals.again()
        unknown = ""
    except UndefinedStatisticError as error:
        again, unknown = None, error.reason
    rows: list[tuple[Cell, ...]] = []
    for words, statistic, factor in statistics:
        found = intervals.of(statistic)
        kept, refusal = _vouched(found)
        others = OTHERS.format(intervals.unit)
        model = intervals.model(statistic)
        if model is not None:
            rows.append((words, OTHERS.format("groups"), *_shown(model, "", factor)))
        rows.append((words, others, *_shown(kept, refusal or found.reason, factor)))
        rows.append((words, AGAIN, *_band(again, statistic, factor, unknown, intervals)))
    return (
        Table(
            id="agreement_intervals",
            title="How certain is the agreement?",
            columns=("statistic", "over", "low", "high", "method", "reason"),
            rows=tuple(rows),
            note="95 %. Two questions: where the number would be for other groups of the same "
            "kind, and where it would fall if these were measured again with as many trials. "
            "Hierarchical: the model of all counts, which takes out the noise of counting; it is "
            "the interval of the number itself. Beside it the classic method.",
        ),
    )


def _vouched(found: Found) -> tuple[Interval | None, str]:
    if found.interval is None:
        return None, ""
    return vouch(found.interval, found.num_units, key=found.key)


def _band(
    again: Remeasured | None,
    statistic: str,
    factor: float,
    unknown: str,
    intervals: GroupIntervals,
) -> tuple[Cell, ...]:
    if again is None:
        return _shown(None, unknown, factor)
    try:
        band = again.band(statistic)
    except UndefinedStatisticError as error:
        return _shown(None, error.reason, factor)
    kept, refusal = vouch(band, intervals.num_groups, key=f"remeasurement:{statistic}")
    return _shown(kept, refusal, factor)


def _shown(interval: Interval | None, reason: str, factor: float) -> tuple[Cell, ...]:
    if interval is None:
        return None, None, None, reason
    ends = (round(factor * interval.low, 4), round(factor * interval.high, 4))
    return *ends, interval.method, None


Statistic = Callable[[], float]
TABLE: tuple[tuple[str, str, float], ...] = (
    ("Pearson r", "pearson", 1.0),
    ("Spearman rho", "spearman", 1.0),
    ("bias (pp)", "bias", 100.0),
    ("mean absolute error (pp)", "mae", 100.0),
    ("pairwise order accuracy", "order", 1.0),
    ("MMRV, recorded gap", "mmrv-recorded", 1.0),
)
"""Words, name of the statistic, and factor to the printed unit."""


def group_agreement(groups: Sequence[RateGroup]) -> list[Measurement]:
    """Measure over groups: r, ranks, bias, errors, MMRV."""
    usable = usable_groups(groups)
    intervals = GroupIntervals(usable)
    units = sorted({group.unit for group in usable})
    what = f"over groups (task x condition x policy), n = {len(usable)}"
    what += f", rates counted in different units ({', '.join(units)})" if len(units) > 1 else ""
    make = partial(measure_over, usable, intervals, what)
    return [
        _pearson(usable, PEARSON_R, what),
        *_pearson_by_condition(usable),
        _remeasured(usable, intervals, what),
        *_rest(usable, make),
    ]


def agreement_intervals(groups: Sequence[RateGroup]) -> tuple[Table, ...]:
    """Lay out the interval of every statistic, over other groups and over a new measurement."""
    return interval_table(GroupIntervals(usable_groups(groups)), TABLE)


def _both(groups: Sequence[RateGroup]) -> dict[str, list[Number]]:
    recorded, sim = sides(groups)
    return {"recorded": [*recorded], "sim": [*sim]}


def _episodes(groups: Sequence[RateGroup]) -> list[str]:
    return [name for group in groups for name in group.episodes]


def measure_over(
    groups: Sequence[RateGroup],
    intervals: GroupIntervals,
    what: str,
    quantity: Quantity,
    statistic: str,
    value: Statistic,
    **parts: str,
) -> Measurement:
    """Measure one statistic with its interval."""
    factor = 100.0 if quantity.unit == "pp" else 1.0
    found = intervals.of(statistic)
    model = intervals.model(statistic)

    def compute() -> tuple[float, Interval | None]:
        interval = model or found.interval
        if interval is not None and factor != 1:
            interval = Interval(
                low=factor * interval.low,
                high=factor * interval.high,
                level=interval.level,
                method=interval.method,
            )
        return factor * value(), interval

    resampled = (
        f"; interval: one of {intervals.num_units} {intervals.unit} left out at a time"
        if intervals.kind == "clusters"
        else ""
    )
    if model is not None:
        resampled = (
            "; interval: of true rates over other groups like these, all counts in one model"
        )
    return measured(
        quantity.of(what=what, resampled=resampled, **parts),
        compute,
        n=len(groups),
        counted="group",
        reason_without_interval=found.reason,
        episodes=_episodes(groups),
        interval_n=found.num_units,
        coverage_key=found.key if model is None else "",
    )


def _rest(groups: Sequence[RateGroup], make: "partial[Measurement]") -> list[Measurement]:
    """Ranks, errors and MMRV."""
    both = _both(groups)
    recorded, sim = both["recorded"], both["sim"]
    return [
        make(SPEARMAN, "spearman", lambda: agreement.spearman(recorded, sim)),
        make(BIAS, "bias", lambda: agreement.bias(**both)),
        make(MAE, "mae", lambda: agreement.mean_absolute_error(**both)),
        make(ORDER_ACCURACY, "order", lambda: agreement.order_accuracy(**both).value),
        make(MMRV_RECORDED, "mmrv-recorded", partial(agreement.mmrv, **both, gap="recorded")),
    ]


def _pearson(
    groups: Sequence[RateGroup], quantity: Quantity, what: str, **parts: str
) -> Measurement:
    recorded, sim = sides(groups)
    return measure_over(
        groups,
        GroupIntervals(groups),
        what,
        quantity,
        "pearson",
        lambda: agreement.pearson(recorded, sim),
        **parts,
    )


def _pearson_by_condition(groups: Sequence[RateGroup]) -> list[Measurement]:
    conditions = list(dict.fromkeys(group.condition for group in groups))
    if len(conditions) < 2:
        return []
    return [
        _pearson(
            [group for group in groups if group.condition == condition],
            PEARSON_R_OF_CONDITION,
            f"over groups {condition} only",
            condition=condition,
        )
        for condition in conditions
    ]


def _remeasured(groups: Sequence[RateGroup], intervals: GroupIntervals, what: str) -> Measurement:
    recorded, sim = sides(groups)

    def compute() -> tuple[float, Interval | None]:
        r = agreement.pearson(recorded, sim)
        again = intervals.again()
        try:
            return r, again.band("pearson")
        except UndefinedStatisticError:
            return r, None

    return measured(
        PEARSON_R_REMEASURED.of(what=what),
        compute,
        n=len(groups),
        counted="group",
        reason_without_interval="r is exactly 1 or -1, or no other outcome changes it",
        episodes=_episodes(groups),
    )
