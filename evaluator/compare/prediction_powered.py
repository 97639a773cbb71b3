"""Prediction-powered estimates: the recorded rate with the twin's help, and when to stop."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from evaluator.compare.gains import StartPair
from evaluator.compare.gate import confusion_of
from evaluator.compare.measure import measured
from evaluator.compare.rows import TrialRow, in_order
from evaluator.compare.success import Key, group_rows, names_of, of_group, trials_in
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import (
    PROXY_RATE,
    RANDOM_STARTS_P,
    REPLANNING_EVIDENCE,
    SEQUENCE,
    SEQUENCE_GAIN,
    STARTS_ALIKE_P,
    TRIALS_SAVED,
)
from evaluator.result import Cell, Interval, Measurement, Table
from evaluator.statistics.gate import Confusion
from evaluator.statistics.prediction_powered import (
    applicability,
    post_stratified,
    starts_alike,
    trials_saved,
)
from evaluator.statistics.sequential import (
    capital_log,
    pairs_sequence,
    sequence_of,
    stop_or_continue,
)

NOWHERE = (
    "not computed: no object was localised before the execution in most of these trials; record "
    "or make localisations at the start"
)


@dataclass(frozen=True, kw_only=True)
class StartPositions:
    """Coordinates of the same objects, in one order, at every start that can be compared."""

    objects: tuple[str, ...]
    tried: Float64[np.ndarray, "num_tried num_coordinates"]
    others: Float64[np.ndarray, "num_others num_coordinates"]
    num_left_out: int
    """Starts at which one of the objects was not localised."""

    @property
    def words(self) -> str:
        """What was compared, for a definition."""
        out = f", {self.num_left_out} starts without all of them left out"
        return (
            f"positions of {', '.join(self.objects)} as localised before the execution "
            f"({len(self.tried)} and {len(self.others)} starts{out if self.num_left_out else ''}); "
            "turns are not compared"
        )


def start_positions(tried: Sequence[TrialRow], others: Sequence[TrialRow]) -> StartPositions:
    """Gather where objects lay; those localised in most starts count.

    Args:
        others: Trials that only the twin made.

    Raises:
        UndefinedStatisticError: When no object was localised in most of them.
    """
    rows = [*tried, *others]
    seen = Counter(name for row in rows for name in row.start_positions_m)
    objects = tuple(sorted(name for name, count in seen.items() if 2 * count > len(rows)))
    if not objects:
        raise UndefinedStatisticError(statistic="overlap of starts", reason=NOWHERE)
    sides = [_coordinates(side, objects) for side in (tried, others)]
    return StartPositions(
        objects=objects,
        tried=sides[0],
        others=sides[1],
        num_left_out=len(rows) - len(sides[0]) - len(sides[1]),
    )


def _coordinates(rows: Sequence[TrialRow], objects: Sequence[str]) -> np.ndarray:
    known = [row.start_positions_m for row in rows if set(objects) <= row.start_positions_m.keys()]
    found = [[c for name in objects for c in places[name]] for places in known]
    return np.array(found, dtype=np.float64).reshape(len(found), 3 * len(objects))


class StartOverlap:
    """Whether the twin's other starts lie where those with a robot trial do."""

    def __init__(self, tried: Sequence[TrialRow], others: Sequence[TrialRow]) -> None:
        """Take the trials of one group; nothing is computed before somebody asks."""
        self._tried = tried
        self._others = others

    @cached_property
    def _places(self) -> StartPositions:
        return start_positions(self._tried, self._others)

    @cached_property
    def _p_alike(self) -> float:
        return starts_alike(self._places.tried, self._places.others)

    def p_alike(self) -> float:
        """Return the p-value that both were drawn alike.

        Raises:
            UndefinedStatisticError: When too few starts were localised.
        """
        return self._p_alike

    def measurements(self, key: Key) -> list[Measurement]:
        """Measure the overlap, or say why it is not computed."""
        try:
            compared, num_others = f"; {self._places.words}", len(self._places.others)
        except UndefinedStatisticError:  # each measurement gives the reason
            compared, num_others = "", 0
        return [
            measured(
                of_group(quantity, key, compared=compared),
                compute,
                n=num_others,
                counted="start",
                reason_without_interval=why,
                episodes=names_of([*self._tried, *self._others]),
            )
            for quantity, compute, why in ((STARTS_ALIKE_P, self.p_alike, "a p-value"),)
        ]


ALPHA = 0.05
GOAL = 0.5
"""Under no effect an improved and a worsened pair are equally likely."""
MOST = 1e300
"""A thousand pairs that all improved are evidence beyond what a float holds."""
MOST_LOG = math.log(MOST)


def assisted_rates(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Estimate each group's recorded rate from its robot trials and the starts only the twin has.

    Groups without a start of the twin's own are left out: there the twin adds nothing.
    """
    measurements = []
    for key, members in group_rows(rows).items():
        known = [row for row in members if row.sim_planned is not None]
        paired = [row for row in known if row.recorded is not None]
        alone = [row for row in known if row.recorded is None]
        if alone and paired:
            measurements += _assisted_rate(key, paired, alone)
    return measurements


@dataclass(frozen=True)
class _Assisted:
    """One group's rate by the trials in which the twin was tried, and by what it says of others."""

    counts: Confusion
    """What the twin said of the tried starts, against their outcomes."""
    alone_k: int
    """Successes among the starts that only the twin has."""
    alone_n: int
    overlap: StartOverlap

    def p_random(self) -> float:
        return applicability(
            self.counts.predicted_success, self.counts.n, self.alone_k, self.alone_n
        )

    def rate(self) -> tuple[float, Interval | None]:
        self._check()
        estimate = post_stratified(self.counts, self.alone_k, self.alone_n)
        return estimate.value, estimate.interval

    def saved(self) -> float:
        self._check()
        return float(trials_saved(self.counts, self.alone_k, self.alone_n))

    def _check(self) -> None:
        """Refuse an estimate where the tried starts are unlike the others."""
        for look, words in (
            (self.p_random, "the tried starts are no random part of the twin's"),
            (self.overlap.p_alike, "the tried starts lie elsewhere than the twin's others"),
        ):
            try:
                p = look()
            except UndefinedStatisticError:
                continue  # the check is undefined and says so itself
            if p < ALPHA:
                raise UndefinedStatisticError(
                    statistic="rate from the twin", reason=f"{words} (p = {p:.3g})"
                )


def _assisted_rate(
    key: Key, paired: Sequence[TrialRow], alone: Sequence[TrialRow]
) -> list[Measurement]:
    assisted = _Assisted(
        counts=confusion_of(paired, lambda row: row.sim_planned),
        alone_k=trials_in(row for row in alone if row.sim_planned),
        alone_n=trials_in(alone),
        overlap=StartOverlap(paired, alone),
    )
    many = (
        f"{assisted.counts.n} trials with an outcome and {assisted.alone_n} starts that only the "
    )
    many += "twin has"

    measurements = [
        measured(
            of_group(quantity, key, many=many),
            compute,
            n=assisted.counts.n,
            counted="trial",
            reason_without_interval="a count or a p-value",
            episodes=names_of(paired),
        )
        for quantity, compute in (
            (PROXY_RATE, assisted.rate),
            (TRIALS_SAVED, assisted.saved),
            (RANDOM_STARTS_P, assisted.p_random),
        )
    ]
    return [*measurements, *assisted.overlap.measurements(key)]


def sequences(rows: Sequence[TrialRow], pairs: Sequence[StartPair]) -> list[Measurement]:
    """Say what holds however often somebody looked: each group's rate, and the paired gain.

    Args:
        rows: Trials of all groups; a group in which one row stands for several trials is left
            out.
        pairs: The same starts without and with replanning; none leaves the gain out.
    """
    measurements = []
    for key, members in group_rows(rows).items():
        known = in_order([row for row in members if row.recorded is not None])
        if known and all(row.count == 1 for row in known):
            measurements.append(_sequence(key, known))
    if pairs:
        measurements += [_evidence(pairs), _gain_sequence(_pairs_in_order(pairs))]
    return measurements


def _pairs_in_order(pairs: Sequence[StartPair]) -> list[StartPair]:
    """Sort pairs by when they became complete."""
    known = all(pair.before.began_ns and pair.after.began_ns for pair in pairs)
    if not known:
        return list(pairs)
    return sorted(pairs, key=lambda pair: max(pair.before.began_ns, pair.after.began_ns))


def _sequence(key: Key, known: Sequence[TrialRow]) -> Measurement:
    def compute() -> tuple[float, Interval | None]:
        sequence = sequence_of([bool(row.recorded) for row in known])
        return sequence.k / sequence.n, sequence.interval

    return measured(
        of_group(SEQUENCE, key),
        compute,
        n=len(known),
        counted="trial",
        episodes=names_of(known),
    )


def stopping_table(rows: Sequence[TrialRow], goal: float | None) -> tuple[Table, ...]:
    """Say for each group whether its recorded rate is settled against a goal; none without one.

    Args:
        rows: Trials of all groups; those without an outcome do not count.
        goal: The success rate that is asked about, 0 to 1; None makes no table.
    """
    if goal is None:
        return ()
    lines: list[tuple[Cell, ...]] = []
    for (task, condition, policy), members in group_rows(rows).items():
        known = in_order([row for row in members if row.recorded is not None])
        if not known or any(row.count > 1 for row in known):
            continue
        try:
            sequence = sequence_of([bool(row.recorded) for row in known])
        except UndefinedStatisticError as error:
            lines.append((task, condition, policy, goal, len(known), *[None] * 5, error.reason))
            continue
        advice = stop_or_continue(sequence, goal)
        found = (sequence.low, sequence.high, advice.stop, advice.answer or None)
        lines.append((task, condition, policy, goal, sequence.n, *found, advice.more_trials, None))
    return (
        Table(
            id="stopping",
            title=f"Is the success rate above or below {100 * goal:g} %?",
            columns=(
                "task",
                "condition",
                "policy",
                "goal",
                "trials",
                "low",
                "high",
                "stop",
                "answer",
                "more trials at this rate",
                "why undefined",
            ),
            rows=tuple(lines),
            note="Betting confidence sequences at 95 %: the answer holds however often one looked.",
        ),
    )


def _changes(pairs: Sequence[StartPair]) -> list[int]:
    """Per pair with two known outcomes: +1 improved, -1 worsened, 0 the same."""
    return [
        int(pair.after.recorded) - int(pair.before.recorded)
        for pair in pairs
        if pair.before.recorded is not None and pair.after.recorded is not None
    ]


def _gain_sequence(pairs: Sequence[StartPair]) -> Measurement:
    changes = _changes(pairs)

    def compute() -> tuple[float, Interval | None]:
        found = pairs_sequence(changes)
        interval = replace(found, low=100 * found.low, high=100 * found.high)
        return 100 * sum(changes) / len(changes), interval

    return measured(
        SEQUENCE_GAIN.of(),
        compute,
        n=len(changes),
        counted="pair",
        episodes=[row.episode for pair in pairs for row in (pair.before, pair.after)],
    )


def _evidence(pairs: Sequence[StartPair]) -> Measurement:
    answers = _changes(pairs)
    improved, worsened = answers.count(1), answers.count(-1)
    return measured(
        REPLANNING_EVIDENCE.of(
            improved=improved, worsened=worsened, enough=1 / ALPHA, alpha=ALPHA, most=MOST
        ),
        lambda: math.exp(min(MOST_LOG, capital_log(improved, improved + worsened, GOAL))),
        n=len(answers),
        counted="pair",
        reason_without_interval="an e-value (anytime-valid)",
    )
