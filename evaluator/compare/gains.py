"""The gain with replanning: percentage points and relative, its tests, and what they could show."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from evaluator.compare.measure import measured, slug
from evaluator.compare.rows import RateCell
from evaluator.compare.success import WITH, WITHOUT
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Interval, Measurement
from evaluator.statistics.power import (
    ALPHA,
    POWER,
    detectable_rate,
    power_unpaired,
    trials_needed,
)
from evaluator.statistics.proportion import relative_gain
from evaluator.statistics.unpaired import boschloo, guaranteed_difference, newcombe_difference

SIDES = ("recorded", "sim")
A_RATIO = "a ratio of two rates; the interval is that of the gain in percentage points"


@dataclass(frozen=True, kw_only=True)
class Change:
    """One task and policy on one side, without and with replanning."""

    name: str
    """As the ids spell it."""
    side: str
    before: Measurement
    after: Measurement

    @property
    def counts(self) -> tuple[int, int, int, int] | None:
        """Successes and trials before and after, None where they are not known."""
        first, second = self.before, self.after
        if first.k is None or not first.n or second.k is None or not second.n:
            return None
        return first.k, first.n, second.k, second.n

    @property
    def words(self) -> str:
        """What was compared."""
        first, second = _shown(self.before), _shown(self.after)
        return f"{first} without and {second} with replanning"


def changes(cells: Sequence[RateCell]) -> list[Change]:
    """Pair the cells of both conditions by task and policy."""
    found = {(c.task, c.policy, c.condition): c for c in cells}
    pairs = []
    for (task, policy, condition), before in found.items():
        after = found.get((task, policy, WITH))
        if condition != WITHOUT or after is None:
            continue
        name = f"{slug(task)}.{slug(policy)}"
        for side in SIDES:
            first, second = getattr(before, side), getattr(after, side)
            pairs.append(Change(name=name, side=side, before=first, after=second))
    return pairs


def replanning_gains(cells: Sequence[RateCell], *, method: str = "wilson") -> list[Measurement]:
    """Measure the gain with replanning per task and side: percentage points and relative."""
    pairs = changes(cells)
    measurements = [m for change in pairs for m in _gain(change, method)]
    measurements.extend(_average_gains(pairs))
    return measurements


def gain_tests(cells: Sequence[RateCell]) -> list[Measurement]:
    """Test each gain as if the groups shared no starts, and say what so many trials can show."""
    pairs = changes(cells)
    measurements = []
    for side in SIDES:
        mine = [change for change in pairs if change.side == side]
        for change in mine:
            measurements += _tests(change)
        if len(mine) > 1:
            measurements.append(_pooled_test(mine, side))
    return measurements


def _gain(change: Change, method: str) -> list[Measurement]:
    before, after = change.before, change.after

    def points() -> tuple[float, Interval | None]:
        gain = 100 * (_value(after) - _value(before))
        if change.counts is None:
            return gain, None
        guaranteed = method == "clopper-pearson"
        fraction = (guaranteed_difference if guaranteed else newcombe_difference)(*change.counts)
        interval = Interval(
            low=100 * fraction.low,
            high=100 * fraction.high,
            level=fraction.level,
            method=f"{fraction.method}, unpaired",
        )
        return gain, interval

    arms = None if change.counts is None else (change.counts[1], change.counts[3])
    make = partial(
        measured,
        n=None if arms is None else sum(arms),
        counted=before.counted,
        episodes=(*before.episodes, *after.episodes),
    )
    return [
        make(
            f"gain.pp.{change.side}.{change.name}",
            points,
            unit="pp",
            definition=f"gain with replanning in percentage points ({change.side}): {change.words}",
            reason_without_interval="no n",
            interval_n=arms,
        ),
        make(
            f"gain.relative.{change.side}.{change.name}",
            lambda: relative_gain(_value(before), _value(after)),
            unit="1",
            definition=f"relative gain with replanning ({change.side}), (with - without) / "
            f"without: {change.words}; not percentage points",
            reason_without_interval=A_RATIO,
        ),
    ]


def _average_gains(pairs: Sequence[Change]) -> list[Measurement]:
    measurements = []
    for side in SIDES:
        mine = [change for change in pairs if change.side == side]
        if len(mine) < 2:
            continue
        first = partial(_mean, [change.before for change in mine])
        second = partial(_mean, [change.after for change in mine])
        what = f"of the unrounded mean rates of {len(mine)} tasks ({side})"
        measurements += [
            measured(
                f"gain.pp.{side}.average",
                lambda first=first, second=second: 100 * (second() - first()),  # type: ignore[misc]
                unit="pp",
                definition=f"gain with replanning in percentage points {what}",
                n=len(mine),
                counted="task",
                reason_without_interval="tasks may be counted in different units",
            ),
            measured(
                f"gain.relative.{side}.average",
                lambda first=first, second=second: relative_gain(first(), second()),  # type: ignore[misc]
                unit="1",
                definition=f"relative gain with replanning {what}; not percentage points",
                n=len(mine),
                counted="task",
                reason_without_interval="a ratio of two means over these tasks",
            ),
        ]
    return measurements


def _tests(change: Change) -> list[Measurement]:
    counts = change.counts
    if counts is None:
        return []
    k_first, n_first, k_second, n_second = counts
    p_first, p_second = k_first / n_first, k_second / n_second
    arm, name = min(n_first, n_second), f"{change.side}.{change.name}"
    about = f"{change.words} ({change.side})"
    power = f"{100 * POWER:.0f} % power, two-sided at {ALPHA:g}, normal approximation"
    episodes = (*change.before.episodes, *change.after.episodes)
    make = partial(measured, n=arm, counted=change.before.counted, episodes=episodes)
    return [
        make(
            f"unpaired.boschloo_p.{name}",
            partial(boschloo, *counts),
            unit="1",
            definition=f"two-sided p of Boschloo's exact test, starts not paired: {about}",
            reason_without_interval="a p-value",
        ),
        make(
            f"power.trials_needed.{name}",
            lambda: float(trials_needed(p_first, p_second)),
            unit="count",
            definition=f"per condition, to show a gain as large as {about} with {power}",
            reason_without_interval="a plan, not an estimate",
        ),
        make(
            f"power.this_large.{name}",
            lambda: power_unpaired(p_first, p_second, arm),
            unit="1",
            definition=f"chance that {arm} per condition show a gain as large as {about}, were it "
            f"true; two-sided at {ALPHA:g}, normal approximation",
            reason_without_interval="a plan, not an estimate",
        ),
        make(
            f"power.detectable_rate.{name}",
            lambda: detectable_rate(p_first, arm),
            unit="1",
            definition=f"smallest better rate that {arm} per condition tell from "
            f"{100 * p_first:.0f} % with {power} ({change.side})",
            reason_without_interval="a plan, not an estimate",
        ),
    ]


def _pooled_test(mine: Sequence[Change], side: str) -> Measurement:
    units = sorted({change.before.counted or "" for change in mine})
    known = [change.counts for change in mine if change.counts is not None]

    def compute() -> float:
        if len(units) > 1 or len(known) < len(mine):
            why = f"tasks are counted in different units ({', '.join(units)})"
            why = why if len(units) > 1 else "the number of trials of a task is not known"
            raise UndefinedStatisticError(statistic="pooled test", reason=why)
        first_k, first_n, second_k, second_n = (sum(column) for column in zip(*known, strict=True))
        return boschloo(first_k, first_n, second_k, second_n)

    return measured(
        f"unpaired.boschloo_p.{side}.pooled",
        compute,
        unit="1",
        definition=f"two-sided p of Boschloo's exact test over the pooled trials of {len(mine)} "
        f"tasks ({side}), starts not paired",
        n=len(mine),
        counted="task",
        reason_without_interval="a p-value",
    )


def _mean(measurements: Sequence[Measurement]) -> float:
    return sum(_value(m) for m in measurements) / len(measurements)


def _value(measurement: Measurement) -> float:
    if measurement.value is None:
        raise UndefinedStatisticError(
            statistic="gain", reason=f"a rate is undefined: {measurement.reason_if_undefined}"
        )
    return measurement.value


def _shown(measurement: Measurement) -> str:
    if measurement.value is None:
        return "undefined"
    if measurement.n is None:
        return f"{measurement.value:.3g}"
    return f"{measurement.k}/{measurement.n}"
