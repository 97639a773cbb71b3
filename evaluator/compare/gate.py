"""Trial by trial: does what the twin said agree with what happened, and does the gate pay?"""

from collections.abc import Sequence
from functools import partial

from bridge.episode.metadata import CONTROL
from evaluator.compare.measure import measured, proportion
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import WITH, WITHOUT, Answer, names_of
from evaluator.measurements import (
    AGREED,
    BREAK_EVEN_PRICE,
    BRIER,
    BRIER_OF_BASE_RATE,
    BRIER_PERFECT,
    KAPPA,
    NPV,
    PHI,
    PPV,
)
from evaluator.result import Interval, Measurement, Table
from evaluator.statistics.calibration import (
    Perfect,
    brier_interval,
    perfect_forecaster,
)
from evaluator.statistics.gate import (
    Confusion,
    break_even,
    brier,
    brier_of_base_rate,
    cost_curve,
    kappa,
    phi,
)
from evaluator.statistics.intervals import LEVEL

REFUSAL_PRICES = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0)
"""Of refusing a good plan, in bad executions, at which the gate is priced."""


def agreement(rows: Sequence[TrialRow], *, method: str = "wilson") -> list[Measurement]:
    """Measure k/n agreement, phi, kappa and predictive values, of the replay and of the verdict."""
    measurements = []
    for name, answer_of, words in (
        ("sim_planned", lambda row: row.sim_planned, "planned-in-twin (dynamic, of the sent plan)"),
        ("verdict", lambda row: row.verdict, "the verdict before motion"),
        ("sim_executed", lambda row: row.sim_executed, "executed-in-twin (diagnosis only)"),
    ):
        measurements.extend(_agreement_of(rows, name, answer_of, words, method))
    if any(unheeded_verdict(row) is not None for row in rows):
        words = "the verdict before motion, recorded and not obeyed (without replanning)"
        measurements.extend(
            _agreement_of(rows, "verdict_unheeded", unheeded_verdict, words, method)
        )
    return measurements


def unheeded_verdict(row: TrialRow) -> bool | None:
    """The gate's verdict where it decided nothing: a refused plan was executed all the same.

    Only these trials can show a false refusal, and only they are not selected by the gate.
    """
    return row.verdict if row.condition in (WITHOUT, CONTROL) else None


def heeded_verdict(row: TrialRow) -> bool | None:
    """The gate's verdict where it selected the plan: refused plans were never executed."""
    return row.verdict if row.condition == WITH else None


def confusion_of(rows: Sequence[TrialRow], answer_of: Answer) -> Confusion:
    """Count what was said against what was labelled, over trials where both are known."""
    return Confusion.count(
        (answer, row.recorded)
        for row in rows
        if (answer := answer_of(row)) is not None and row.recorded is not None
    )


def _agreement_of(
    rows: Sequence[TrialRow], name: str, answer_of: Answer, words: str, method: str
) -> list[Measurement]:
    seen = [row for row in rows if answer_of(row) is not None and row.recorded is not None]
    counts = confusion_of(seen, answer_of)
    nothing = f"no trial has both {words} and a known outcome"
    make = partial(proportion, counted="trial", method=method)
    coefficient = partial(
        measured,
        n=counts.n,
        counted="trial",
        episodes=names_of(seen),
        reason_without_interval="the four counts are beside it",
    )
    return [
        make(
            AGREED.of(by=name, words=words),
            counts.agreed,
            counts.n,
            reason_if_undefined=nothing,
            episodes=names_of(seen),
        ),
        coefficient(PHI.of(by=name, words=words), lambda: phi(counts)),
        coefficient(KAPPA.of(by=name, words=words), lambda: kappa(counts)),
        make(
            PPV.of(by=name, words=words),
            counts.true_positive,
            counts.predicted_success,
            reason_if_undefined=nothing if not counts.n else "it never predicted success",
            episodes=names_of(row for row in seen if answer_of(row)),
        ),
        make(
            NPV.of(by=name, words=words),
            counts.true_negative,
            counts.predicted_failure,
            reason_if_undefined=nothing if not counts.n else "it never predicted failure",
            episodes=names_of(row for row in seen if not answer_of(row)),
        ),
    ]


def gate_scorecard(rows: Sequence[TrialRow]) -> tuple[list[Measurement], tuple[Table, ...]]:
    """Price the gate on the trials in which it was asked and not obeyed."""
    asked = [r for r in rows if unheeded_verdict(r) is not None and r.recorded is not None]
    counts = confusion_of(asked, unheeded_verdict)
    measurements = [
        measured(
            BREAK_EVEN_PRICE.of(),
            lambda: break_even(counts),
            n=counts.n,
            counted="trial",
            reason_without_interval="a ratio of two counts, both in the confusion table",
            episodes=names_of(asked),
        ),
    ]
    return measurements, _cost_table(counts) if counts.n else ()


def _cost_table(counts: Confusion) -> tuple[Table, ...]:
    return (
        Table(
            id="gate_costs",
            title="What the gate costs and avoids",
            columns=("price of refusing a good plan", "obeying the gate", "executing everything"),
            rows=tuple(
                (cost.refusal_price, round(cost.with_gate, 4), round(cost.without_gate, 4))
                for cost in cost_curve(counts, REFUSAL_PRICES)
            ),
            note=f"Mean cost per trial in bad executions, over {counts.n} trials in which the gate "
            f"was asked and not obeyed: {counts.true_negative} bad executions avoided, "
            f"{counts.false_negative} good plans refused, {counts.false_positive} bad plans let "
            "through.",
        ),
    )


def reliability(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Judge the sampled success probability against the outcomes; nothing where none was said."""
    seen = [
        (row.episode, row.p_success, row.recorded)
        for row in rows
        if row.p_success is not None and row.recorded is not None
    ]
    if not seen:
        return []
    probabilities, happened = [p for _, p, _ in seen], [outcome for _, _, outcome in seen]
    make = partial(
        measured, n=len(seen), counted="trial", episodes=[episode for episode, _, _ in seen]
    )
    ideal = perfect_forecaster(probabilities)
    measurements = [
        make(
            BRIER.of(),
            lambda: (brier(probabilities, happened), brier_interval(probabilities, happened)),
        ),
        make(BRIER_PERFECT.of(), lambda: _shown(ideal), reason_without_interval=CERTAIN),
        make(
            BRIER_OF_BASE_RATE.of(),
            lambda: brier_of_base_rate(happened),
            reason_without_interval="the outcomes' own rate; what it would be on others is unknown",
        ),
    ]
    return measurements


CERTAIN = "every stated probability is 0 or 1: a perfect forecaster shows nothing else"


def _shown(perfect: Perfect) -> float | tuple[float, Interval]:
    if perfect.low == perfect.high:
        return perfect.mean
    range_ = Interval(low=perfect.low, high=perfect.high, level=LEVEL, method="perfect-forecaster")
    return perfect.mean, range_
