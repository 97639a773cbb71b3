"""The gain with replanning: percentage points and relative, its tests, and what they could show."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from evaluator.compare.measure import measured
from evaluator.compare.rows import RateGroup, TrialRow
from evaluator.compare.success import WITH, WITHOUT
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import (
    BOSCHLOO,
    BOSCHLOO_POOLED,
    GAIN_POINTS,
    GAIN_POINTS_AVERAGE,
    GAIN_RELATIVE,
    GAIN_RELATIVE_AVERAGE,
    MCNEMAR,
    PAIRED_GAIN,
    START_DISTANCE,
    TRIALS_NEEDED,
)
from evaluator.result import Exclusion, Interval, Measurement
from evaluator.statistics.differences import (
    boschloo,
    guaranteed_difference,
    mcnemar,
    mean_of_intervals,
    newcombe_difference,
    tango_points,
)
from evaluator.statistics.intervals import relative_gain
from evaluator.statistics.power import (
    ALPHA,
    POWER,
    trials_needed,
)

START_LIMIT_M = 0.03
"""Paired trials whose objects started further apart than this are not the same start."""


@dataclass(frozen=True, kw_only=True)
class StartPair:
    """The same start without and with replanning."""

    before: TrialRow
    after: TrialRow
    start_distance_m: float | None
    """Largest distance between the localised objects, None where they were not localised."""


def pair_starts(rows: Sequence[TrialRow]) -> tuple[list[StartPair], list[Exclusion]]:
    """Pair trials on task, policy and start_id; what cannot be paired is listed."""
    conditions = {row.condition for row in rows}
    if not {WITHOUT, WITH} <= conditions:
        return [], []
    replanned = {(row.task, row.policy) for row in rows if row.condition == WITH}
    groups: dict[tuple[str, str, str], list[TrialRow]] = {}
    left_out = []
    for row in rows:
        if row.condition not in (WITHOUT, WITH):
            continue
        if row.study_arm and (row.task, row.policy) not in replanned:
            continue  # a policy that the study tries without replanning alone
        if row.start_id is None:
            left_out.append(_out(row, "no start_id"))
        else:
            groups.setdefault((row.task, row.policy, row.start_id), []).append(row)
    pairs = []
    for (_, _, start_id), members in groups.items():
        before = [row for row in members if row.condition == WITHOUT]
        after = [row for row in members if row.condition == WITH]
        if len(before) != 1 or len(after) != 1:
            found = f"start {start_id} has {len(before)} without and {len(after)} with replanning"
            left_out.extend(_out(row, found) for row in members)
            continue
        distance_m = start_distance_m(before[0], after[0])
        if distance_m is not None and distance_m > START_LIMIT_M:
            found = (
                f"start {start_id}: localised objects {distance_m * 1000:.0f} mm apart, "
                f"limit {START_LIMIT_M * 1000:.0f} mm"
            )
            left_out.extend(_out(row, found) for row in members)
            continue
        pairs.append(StartPair(before=before[0], after=after[0], start_distance_m=distance_m))
    return pairs, left_out


def start_distance_m(first: TrialRow, second: TrialRow) -> float | None:
    """Return the largest distance between objects localised in both trials [m]."""
    shared = first.start_positions_m.keys() & second.start_positions_m.keys()
    if not shared:
        return None
    return max(
        float(
            np.linalg.norm(
                np.subtract(first.start_positions_m[name], second.start_positions_m[name])
            )
        )
        for name in shared
    )


def start_distances(pairs: Sequence[StartPair]) -> list[Measurement]:
    """Measure how far apart paired starts were, where both were localised."""
    known = [pair for pair in pairs if pair.start_distance_m is not None]
    distances = [pair.start_distance_m for pair in known if pair.start_distance_m is not None]
    unknown = len(pairs) - len(known)
    return [
        measured(
            START_DISTANCE[name].of(
                limit_mm=START_LIMIT_M * 1000, unknown=unknown, count=len(pairs)
            ),
            partial(_summary_m, summary, distances),
            n=len(known),
            counted="pair",
            reason_without_interval="the limit is what counts",
            episodes=[r.episode for pair in known for r in (pair.before, pair.after)],
        )
        for name, summary in (("mean", np.mean), ("max", np.max))
    ]


def _summary_m(summary: Callable[..., np.floating[Any]], distances: Sequence[float]) -> float:
    if not distances:
        raise UndefinedStatisticError(
            statistic="start distance", reason="no pair of starts was localised in both trials"
        )
    return float(summary(distances))


def paired_gain(pairs: Sequence[StartPair]) -> list[Measurement]:
    """Test the change with replanning on paired starts; only discordant pairs inform."""
    measurements = []
    for side in ("recorded", "sim_planned"):
        known = [
            pair
            for pair in pairs
            if getattr(pair.before, side) is not None and getattr(pair.after, side) is not None
        ]
        answers = [(getattr(pair.before, side), getattr(pair.after, side)) for pair in known]
        improved = sum(after and not before for before, after in answers)
        worsened = sum(before and not after for before, after in answers)
        words = f"{improved} improved, {worsened} worsened of {len(known)} paired starts ({side})"
        measurements.append(_paired_points(side, known, improved, worsened, words))
        for kind, quantity in MCNEMAR.items():
            measurements.append(
                measured(
                    quantity.of(side=side, words=words),
                    lambda answers=answers, kind=kind: getattr(  # type: ignore[misc]
                        mcnemar(answers), f"p_{kind}"
                    ),
                    n=len(known),
                    counted="pair",
                    reason_without_interval="a p-value",
                    episodes=[r.episode for pair in known for r in (pair.before, pair.after)],
                )
            )
    return measurements


def _paired_points(
    side: str, known: Sequence[StartPair], improved: int, worsened: int, words: str
) -> Measurement:
    return measured(
        PAIRED_GAIN.of(side=side, words=words),
        partial(tango_points, improved, worsened, len(known)),
        n=len(known),
        counted="pair",
        episodes=[r.episode for pair in known for r in (pair.before, pair.after)],
    )


def _out(row: TrialRow, reason: str) -> Exclusion:
    return Exclusion(episode=row.episode, scope="pairing of conditions", reason=reason)


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
    def counts(self) -> tuple[int, int, int, int] | None:
        """Successes and trials before and after, None where they are not known."""
        first, second = self.before, self.after
        if first.k is None or not first.n or second.k is None or not second.n:
            return None
        return first.k, first.n, second.k, second.n

    @property
    def parts(self) -> dict[str, str]:
        """Parts of the ids."""
        return {"side": self.side, "task": self.task, "policy": self.policy}

    @property
    def words(self) -> str:
        """What was compared."""
        first, second = _shown(self.before), _shown(self.after)
        return f"{first} without and {second} with replanning"


def changes(groups: Sequence[RateGroup]) -> list[Change]:
    """Pair the groups of both conditions by task and policy."""
    found = {(c.task, c.policy, c.condition): c for c in groups}
    pairs = []
    for (task, policy, condition), before in found.items():
        after = found.get((task, policy, WITH))
        if condition != WITHOUT or after is None:
            continue
        for side in SIDES:
            first, second = getattr(before, side), getattr(after, side)
            pairs.append(Change(task=task, policy=policy, side=side, before=first, after=second))
    return pairs


def replanning_gains(groups: Sequence[RateGroup], *, method: str = "wilson") -> list[Measurement]:
    """Measure the gain with replanning per task and side: percentage points and relative."""
    pairs = changes(groups)
    measurements = [m for change in pairs for m in _gain(change, method)]
    measurements.extend(_average_gains(pairs, method))
    return measurements


def gain_tests(groups: Sequence[RateGroup]) -> list[Measurement]:
    """Test each gain as if the groups shared no starts, and say what so many trials can show."""
    pairs = changes(groups)
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
        return 100 * (_value(after) - _value(before)), _points_interval(change, method)

    arms = None if change.counts is None else (change.counts[1], change.counts[3])
    make = partial(
        measured,
        n=None if arms is None else sum(arms),
        counted=before.counted,
        episodes=(*before.episodes, *after.episodes),
    )
    return [
        make(
            GAIN_POINTS.of(**change.parts, words=change.words),
            points,
            reason_without_interval="no n",
            interval_n=arms,
        ),
        make(
            GAIN_RELATIVE.of(**change.parts, words=change.words),
            lambda: relative_gain(_value(before), _value(after)),
            reason_without_interval=A_RATIO,
        ),
    ]


def _points_interval(change: Change, method: str) -> Interval | None:
    """Interval of one gain [pp] as if no start was shared; None where trials are not counted."""
    if change.counts is None:
        return None
    guaranteed = method == "clopper-pearson"
    fraction = (guaranteed_difference if guaranteed else newcombe_difference)(*change.counts)
    return Interval(
        low=100 * fraction.low,
        high=100 * fraction.high,
        level=fraction.level,
        method=f"{fraction.method}, unpaired",
    )


def _average_points(mine: Sequence[Change], method: str) -> tuple[float, Interval | None]:
    gains = [100 * (_value(change.after) - _value(change.before)) for change in mine]
    each = [_points_interval(change, method) for change in mine]
    known = [interval for interval in each if interval is not None]
    mean = sum(gains) / len(gains)
    return mean, mean_of_intervals(gains, known) if len(known) == len(gains) else None


def _average_gains(pairs: Sequence[Change], method: str) -> list[Measurement]:
    measurements = []
    for side in SIDES:
        mine = [change for change in pairs if change.side == side]
        if len(mine) < 2:
            continue
        first = partial(_mean, [change.before for change in mine])
        second = partial(_mean, [change.after for change in mine])
        measurements += [
            measured(
                GAIN_POINTS_AVERAGE.of(side=side, count=len(mine)),
                partial(_average_points, mine, method),
                n=len(mine),
                counted="task",
                reason_without_interval="the number of trials of a task is not known",
            ),
            measured(
                GAIN_RELATIVE_AVERAGE.of(side=side, count=len(mine)),
                lambda first=first, second=second: relative_gain(first(), second()),  # type: ignore[misc]
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
    arm, parts = min(n_first, n_second), change.parts
    about = f"{change.words} ({change.side})"
    power = f"{100 * POWER:.0f} % power, two-sided at {ALPHA:g}, normal approximation"
    episodes = (*change.before.episodes, *change.after.episodes)
    make = partial(measured, n=arm, counted=change.before.counted, episodes=episodes)
    return [
        make(
            BOSCHLOO.of(**parts, about=about),
            partial(boschloo, *counts),
            reason_without_interval="a p-value",
        ),
        make(
            TRIALS_NEEDED.of(**parts, about=about, power=power),
            lambda: float(trials_needed(p_first, p_second)),
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
        BOSCHLOO_POOLED.of(side=side, count=len(mine)),
        compute,
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
