"""Do paired starts improve with replanning? The same start without and with it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from evaluator.compare.measure import measured
from evaluator.compare.rows import TrialRow, is_streamed
from evaluator.compare.success import WITH, WITHOUT
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Exclusion, Interval, Measurement
from evaluator.statistics.paired import mcnemar, tango_difference
from evaluator.statistics.power import power_paired

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
    if is_streamed(rows):
        reason = "a streamed table: starts are not paired; give the paired trials as a table apart"
        return [], [Exclusion(episode="all", scope="pairing of conditions", reason=reason)]
    conditions = {row.condition for row in rows}
    if not {WITHOUT, WITH} <= conditions:
        return [], []
    groups: dict[tuple[str, str, str], list[TrialRow]] = {}
    left_out = []
    for row in rows:
        if row.condition not in (WITHOUT, WITH):
            continue
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
            f"paired.start_distance_{name}_m",
            partial(_summary_m, summary, distances),
            unit="m",
            definition=f"{name} over paired starts of the largest distance between the localised "
            f"objects of both trials; pairs beyond {START_LIMIT_M * 1000:.0f} mm are excluded, "
            f"{unknown} of {len(pairs)} pairs were not localised and are kept",
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
        measurements.append(_paired_power(side, known, improved, worsened, words))
        for kind in ("exact", "mid"):
            measurements.append(
                measured(
                    f"paired.mcnemar_p_{kind}.{side}",
                    lambda answers=answers, kind=kind: getattr(  # type: ignore[misc]
                        mcnemar(answers), f"p_{kind}"
                    ),
                    unit="1",
                    definition=f"two-sided McNemar test, {kind}"
                    f"{'-p' if kind == 'mid' else ' binomial'}: {words}",
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
    def points() -> tuple[float, Interval | None]:
        fraction = tango_difference(improved, worsened, len(known))
        interval = replace(fraction, low=100 * fraction.low, high=100 * fraction.high)
        return 100 * (improved - worsened) / len(known), interval

    return measured(
        f"paired.gain_pp.{side}",
        points,
        unit="pp",
        definition=f"gain with replanning in percentage points over paired starts: {words}",
        n=len(known),
        counted="pair",
        episodes=[r.episode for pair in known for r in (pair.before, pair.after)],
    )


def _paired_power(
    side: str, known: Sequence[StartPair], improved: int, worsened: int, words: str
) -> Measurement:
    def power() -> float:
        if not known:
            raise UndefinedStatisticError(statistic="paired power", reason="there are no pairs")
        return power_paired(improved / len(known), worsened / len(known), len(known))

    return measured(
        f"power.paired.{side}",
        power,
        unit="1",
        definition=f"chance that McNemar's exact test on {len(known)} pairs is significant at 0.05 "
        f"if these shares are true: {words}",
        n=len(known),
        counted="pair",
        reason_without_interval="a plan, not an estimate",
    )


def _out(row: TrialRow, reason: str) -> Exclusion:
    return Exclusion(episode=row.episode, scope="pairing of conditions", reason=reason)
