"""What holds however often somebody looked: rates as they come in, and when to stop."""

import math
from collections.abc import Sequence

from evaluator.compare.gains import StartPair
from evaluator.compare.measure import measured
from evaluator.compare.rows import TrialRow, in_order
from evaluator.compare.success import Key, group_rows, names_of, of_group
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import REPLANNING_EVIDENCE, SEQUENCE
from evaluator.result import Cell, Interval, Measurement, Table
from evaluator.statistics.sequential import capital_log, sequence_of, stop_or_continue

ALPHA = 0.05
GOAL = 0.5
"""Under no effect an improved and a worsened pair are equally likely."""
MOST = 1e300
"""A thousand pairs that all improved are evidence beyond what a float holds."""
MOST_LOG = math.log(MOST)


def sequences(rows: Sequence[TrialRow], pairs: Sequence[StartPair]) -> list[Measurement]:
    """Say what holds however often one looked: each group's rate, and whether pairs improve."""
    measurements = []
    for key, members in group_rows(rows).items():
        known = in_order([row for row in members if row.recorded is not None])
        if known:
            measurements.append(_sequence(key, known))
    if pairs:
        measurements.append(_evidence(pairs))
    return measurements


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
    """Say for each group whether its recorded rate is settled against a goal; none without one."""
    if goal is None:
        return ()
    lines: list[tuple[Cell, ...]] = []
    for (task, condition, policy), members in group_rows(rows).items():
        known = in_order([row for row in members if row.recorded is not None])
        if not known:
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
