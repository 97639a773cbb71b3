"""Do the rates of varied replays follow the recorded ones?

A nominal replay says yes or no of a trial; where a property decides that nobody measured, it says
the same of each. Varied replays say how often, by what is known: after ``calibrate --posterior``,
by what the session's own trials left.
"""

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from evaluator.compare.agreement import GroupIntervals, measure_over, sides
from evaluator.compare.model import HEADLINE_FROM, shared_by
from evaluator.compare.rows import RateGroup, TrialRow
from evaluator.compare.success import group_rows, names_of, trial_table
from evaluator.measurements import VARIED_BIAS, VARIED_MMRV, VARIED_R
from evaluator.result import Interval, Measurement
from evaluator.statistics import agreement
from evaluator.statistics.group_likelihood import GroupCounts
from evaluator.statistics.hierarchical import AgreementModel, pooled_others

REPLICATES = 4
"""Times that one varied replay of each trial is counted in the model."""
NODES = 512
"""Of each of these models; together as many as one model of many groups has."""
SEED = 0


class VariedIntervals(GroupIntervals):
    """The intervals of groups in which the twin says a share of each trial.

    Shares are no counts, and trials of a group are paired with theirs. So each trial's answer is
    drawn from its varied replays, which makes paired counts such as nominal replays do, and the
    posteriors of the model of agreement for several such draws are pooled.
    """

    def __init__(self, groups: Sequence[RateGroup], members: Sequence[Sequence[TrialRow]]) -> None:
        """Prepare; no model is fitted before it is asked for."""
        super().__init__(groups)
        self._names = shared_by(groups)
        self._members = members
        self._found: dict[str, Interval] = {}

    def model(self, statistic: str) -> Interval | None:
        """Return the pooled interval of r or bias; None below four groups."""
        if statistic not in ("pearson", "bias") or len(self._members) < HEADLINE_FROM:
            return None
        if not self._found:
            r, bias = pooled_others(
                [AgreementModel(counts, num_nodes=NODES) for counts in self._replicates()]
            )
            over = f"{REPLICATES}-varied-replays"
            self._found = {"pearson": r.interval(over=over), "bias": bias.interval(over=over)}
        return self._found[statistic]

    def _replicates(self) -> list[tuple[GroupCounts, ...]]:
        rng = np.random.default_rng(SEED)
        drawn = [drawn_answers(rows, rng) for rows in self._members]
        return [
            tuple(
                GroupCounts(
                    recorded=(0, 0),
                    sim=(0, 0),
                    pairs=trial_table(rows, answers[:, turn].tolist()),
                    task=name,
                )
                for rows, answers, name in zip(self._members, drawn, self._names, strict=True)
            )
            for turn in range(REPLICATES)
        ]


def drawn_answers(rows: Sequence[TrialRow], rng: np.random.Generator) -> np.ndarray:
    """Draw yes or no for each trial, so that each share comes out over the replicates.

    Systematic sampling: of an even share as many replicates say yes, to within one.

    Returns:
        Booleans, one row for each trial, one column for each replicate.
    """
    shares = np.array([row.sim_varied for row in rows], dtype=np.float64)
    places = rng.permuted(np.tile(np.arange(REPLICATES), (len(rows), 1)), axis=1)
    return (places + rng.random((len(rows), 1))) / REPLICATES < shares[:, None]


def varied_agreement(rows: Sequence[TrialRow], groups: Sequence[RateGroup]) -> list[Measurement]:
    """Measure r, bias and MMRV of varied replays; nothing where fewer than two groups have any."""
    by_key = {(group.task, group.condition, group.policy): group for group in groups}
    kept: list[RateGroup] = []
    members: list[list[TrialRow]] = []
    for key, mine in group_rows(rows).items():
        both = [row for row in mine if row.recorded is not None and row.sim_varied is not None]
        if both:
            kept.append(_with_varied(by_key[key], both))
            members.append(both)
    if len(kept) < 2:
        return []
    recorded, sim = sides(kept)
    intervals = VariedIntervals(kept, members)
    what = f"over groups (task x condition x policy), n = {len(kept)}"
    return [
        measure_over(
            kept, intervals, what, VARIED_R, "pearson", lambda: agreement.pearson(recorded, sim)
        ),
        measure_over(
            kept,
            intervals,
            what,
            VARIED_BIAS,
            "bias",
            lambda: agreement.bias(recorded=recorded, sim=sim),
        ),
        measure_over(
            kept,
            intervals,
            what,
            VARIED_MMRV,
            "mmrv-recorded",
            lambda: agreement.mmrv(recorded=recorded, sim=sim, gap="recorded"),
        ),
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
