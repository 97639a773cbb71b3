"""The gain with replanning as papers print it: percentage points and relative, per task."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from evaluator.compare.measure import measured
from evaluator.compare.rows import RateGroup
from evaluator.compare.success import WITH, WITHOUT
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import (
    GAIN_POINTS,
    GAIN_POINTS_AVERAGE,
    GAIN_RELATIVE,
    GAIN_RELATIVE_AVERAGE,
)
from evaluator.result import Interval, Measurement
from evaluator.statistics.differences import unpaired_points
from evaluator.statistics.intervals import relative_gain

SIDES = ("recorded", "sim")
A_RATIO = "a ratio of two rates; the interval is that of the gain in percentage points"


@dataclass(frozen=True, kw_only=True)
class Change:
    """One task and policy on one side, without and with replanning."""

    task: str
    policy: str
    side: str
    before: Measurement
    after: Measurement

    @property
    def gain(self) -> float:
        """Percentage points."""
        return 100 * (_value(self.after) - _value(self.before))

    def points(self) -> tuple[float, Interval | None]:
        """The gain, with its interval as if no start was shared where trials are counted."""
        first, second = self.before, self.after
        if first.k is None or not first.n or second.k is None or not second.n:
            return self.gain, None
        return self.gain, unpaired_points((first.k, first.n), (second.k, second.n))[1]


def replanning_gains(groups: Sequence[RateGroup]) -> list[Measurement]:
    """Measure the gain with replanning per task and side, and the mean of tasks."""
    there = {(c.task, c.policy, c.condition): c for c in groups}
    pairs = [
        Change(
            task=task,
            policy=policy,
            side=side,
            before=getattr(before, side),
            after=getattr(there[task, policy, WITH], side),
        )
        for (task, policy, condition), before in there.items()
        if condition == WITHOUT and (task, policy, WITH) in there
        for side in SIDES
    ]
    found = [m for change in pairs for m in _gain(change)]
    for side in SIDES:
        mine = [change for change in pairs if change.side == side]
        if len(mine) > 1:
            found += _average(mine, side)
    return found


def _gain(change: Change) -> list[Measurement]:
    before, after = change.before, change.after
    parts = {"side": change.side, "task": change.task, "policy": change.policy}
    parts["words"] = f"{_shown(before)} without and {_shown(after)} with replanning"
    known = before.n and after.n
    make = partial(
        measured,
        n=(before.n or 0) + (after.n or 0) if known else None,
        counted=before.counted,
        episodes=(*before.episodes, *after.episodes),
    )
    return [
        make(GAIN_POINTS.of(**parts), change.points, reason_without_interval="no n"),
        make(
            GAIN_RELATIVE.of(**parts),
            lambda: relative_gain(_value(before), _value(after)),
            reason_without_interval=A_RATIO,
        ),
    ]


def _average(mine: Sequence[Change], side: str) -> list[Measurement]:
    def mean(rates: Sequence[Measurement]) -> float:
        return sum(map(_value, rates)) / len(rates)

    def points() -> float:
        return sum(change.gain for change in mine) / len(mine)

    def relative() -> float:
        return relative_gain(mean([c.before for c in mine]), mean([c.after for c in mine]))

    parts = {"side": side, "count": len(mine)}
    why = "a mean over these tasks; the comparison over all trials has one"
    make = partial(measured, n=len(mine), counted="task", reason_without_interval=why)
    return [
        make(GAIN_POINTS_AVERAGE.of(**parts), points),
        make(GAIN_RELATIVE_AVERAGE.of(**parts), relative),
    ]


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
