"""Do the rates of varied replays follow the recorded ones?

A nominal replay says yes or no of a trial; where a property decides that nobody measured, it says
the same of each. Varied replays say how often, by what is known: after ``calibrate --posterior``,
by what the session's own trials left.
"""

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial

from evaluator.compare.agreement import sides
from evaluator.compare.measure import measured
from evaluator.compare.rows import RateGroup, TrialRow
from evaluator.compare.success import group_rows, names_of
from evaluator.measurements import VARIED_BIAS, VARIED_MMRV, VARIED_R
from evaluator.result import Measurement
from evaluator.statistics import agreement


def varied_agreement(rows: Sequence[TrialRow], groups: Sequence[RateGroup]) -> list[Measurement]:
    """Measure r, bias and MMRV of varied replays; nothing where fewer than two groups have any."""
    by_key = {(group.task, group.condition, group.policy): group for group in groups}
    kept: list[RateGroup] = []
    for key, mine in group_rows(rows).items():
        both = [row for row in mine if row.recorded is not None and row.sim_varied is not None]
        if both:
            kept.append(_with_varied(by_key[key], both))
    if len(kept) < 2:
        return []
    recorded, sim = sides(kept)
    what = f"over groups (task x condition x policy), n = {len(kept)}"
    make = partial(
        measured,
        n=len(kept),
        counted="group",
        episodes=[name for group in kept for name in group.episodes],
        reason_without_interval="shares of trials are no counts",
    )
    rates = {"recorded": [*recorded], "sim": [*sim]}
    named = {"what": what, "resampled": ""}
    return [
        make(VARIED_R.of(**named), lambda: agreement.pearson(recorded, sim)),
        make(VARIED_BIAS.of(**named), lambda: 100 * agreement.bias(**rates)),
        make(VARIED_MMRV.of(**named), lambda: agreement.mmrv(**rates, gap="recorded")),
    ]


def _with_varied(group: RateGroup, both: Sequence[TrialRow]) -> RateGroup:
    """The group with rates over trials that have varied replays; their counts are not its own."""
    shares = [
        Fraction(row.sim_varied).limit_denominator(10**6)
        for row in both
        if row.sim_varied is not None
    ]
    return replace(
        group,
        recorded_rate=Fraction(sum(row.recorded is True for row in both), len(both)),
        sim_rate=sum(shares, Fraction(0)) / len(both),
        episodes=tuple(names_of(both)),
        recorded_common=None,
        sim_common=None,
        trial_table=None,
    )
