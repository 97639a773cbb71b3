"""Trial by trial: does what the twin said agree with what happened, and what is the gate worth?"""

from collections.abc import Sequence
from functools import partial

from evaluator.compare.clause_worth import clause_worth
from evaluator.compare.measure import measured, proportion
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import WITH, WITHOUT, Answer, names_of
from evaluator.result import Measurement, Table
from evaluator.statistics.gate import Confusion, break_even, cost_curve, kappa, phi
from evaluator.statistics.reliability import (
    NUM_BINS,
    brier,
    brier_of_base_rate,
    expected_calibration_error,
    reliability_bins,
)

CLAUSES = ("ik", "clearance", "terminal")
WHOSE = (
    "the probability is the planned replay's, where it has none the verdict's before motion; with "
    "replanning the twin selected these plans"
)
REFUSAL_PRICES = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0)
"""What refusing a good plan costs, in bad executions."""


def agreement(rows: Sequence[TrialRow], *, method: str = "wilson") -> list[Measurement]:
    """Measure k/n agreement, phi, kappa and predictive values, of the replay and of the verdict."""
    measurements = []
    for name, said, words in (
        ("sim_planned", lambda row: row.sim_planned, "planned-in-twin (dynamic, of the sent plan)"),
        ("verdict", lambda row: row.verdict, "the verdict before motion"),
        ("sim_executed", lambda row: row.sim_executed, "executed-in-twin (diagnosis only)"),
    ):
        measurements.extend(_agreement_of(rows, name, said, words, method))
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
    return row.verdict if row.condition == WITHOUT else None


def heeded_verdict(row: TrialRow) -> bool | None:
    """The gate's verdict where it selected the plan: refused plans were never executed."""
    return row.verdict if row.condition == WITH else None


def confusion_of(rows: Sequence[TrialRow], said: Answer) -> Confusion:
    """Count what was said against what was labelled, over trials where both are known."""
    return Confusion.weigh(
        (answer, row.recorded, row.count)
        for row in rows
        if (answer := said(row)) is not None and row.recorded is not None
    )


def _agreement_of(
    rows: Sequence[TrialRow], name: str, said: Answer, words: str, method: str
) -> list[Measurement]:
    seen = [row for row in rows if said(row) is not None and row.recorded is not None]
    counts = confusion_of(seen, said)
    nothing = f"no trial has both {words} and a known outcome"
    make = partial(proportion, counted="trial", method=method)
    coefficient = partial(
        measured,
        unit="1",
        n=counts.n,
        counted="trial",
        episodes=names_of(seen),
        reason_without_interval="the four counts are beside it",
    )
    return [
        make(
            f"agreement.{name}.rate",
            counts.agreed,
            counts.n,
            definition=f"trials where {words} and the labelled outcome say the same / trials",
            reason_if_undefined=nothing,
            episodes=names_of(seen),
        ),
        coefficient(
            f"agreement.{name}.phi",
            lambda: phi(counts),
            definition=f"phi coefficient of {words} and the labelled outcome over trials",
        ),
        coefficient(
            f"agreement.{name}.kappa",
            lambda: kappa(counts),
            definition=f"Cohen's kappa of {words} and the labelled outcome over trials",
        ),
        make(
            f"agreement.{name}.ppv",
            counts.true_positive,
            counts.said_success,
            definition=f"positive predictive value: trials that succeeded / trials where {words} "
            "said success",
            reason_if_undefined=nothing if not counts.n else "it never said success",
            episodes=names_of(row for row in seen if said(row)),
        ),
        make(
            f"agreement.{name}.npv",
            counts.true_negative,
            counts.said_failure,
            definition=f"negative predictive value: trials that failed / trials where {words} "
            "said failure",
            reason_if_undefined=nothing if not counts.n else "it never said failure",
            episodes=names_of(row for row in seen if not said(row)),
        ),
    ]


def gate_worth(rows: Sequence[TrialRow]) -> tuple[list[Measurement], tuple[Table, ...]]:
    """Price the gate on the trials in which it was asked and not obeyed, and judge its clauses."""
    asked = [r for r in rows if unheeded_verdict(r) is not None and r.recorded is not None]
    counts = confusion_of(asked, unheeded_verdict)
    measurements = [
        measured(
            "gate.break_even_price",
            lambda: break_even(counts),
            unit="1",
            definition="bad executions avoided / good plans refused, by verdicts that were not "
            "obeyed: what refusing a good plan may cost, in bad executions, for the gate to pay",
            n=counts.n,
            counted="trial",
            reason_without_interval="a ratio of two counts, both in the confusion table",
            episodes=names_of(asked),
        ),
        *_clauses(rows),
    ]
    by_clause, clause_tables = clause_worth(rows, asked)
    tables = _cost_table(counts) if counts.n else ()
    return [*measurements, *by_clause], (*clause_tables, *tables)


def _clauses(rows: Sequence[TrialRow]) -> list[Measurement]:
    """How often the trials failed that the twin called a failure for this reason."""
    measurements = []
    for clause in CLAUSES:
        blamed = [
            row
            for row in rows
            if row.sim_planned is False and row.first_failing == clause and row.recorded is not None
        ]
        counts = confusion_of(blamed, lambda row: row.sim_planned)
        measurements.append(
            proportion(
                f"gate.clause.{clause}.npv",
                counts.true_negative,
                counts.said_failure,
                definition=f"trials that failed / trials where planned-in-twin failed first in "
                f"{clause}",
                counted="trial",
                reason_if_undefined=f"no trial with a known outcome failed in {clause} first",
                episodes=names_of(blamed),
            )
        )
    return measurements


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


def reliability(rows: Sequence[TrialRow]) -> tuple[list[Measurement], tuple[Table, ...]]:
    """Judge the sampled success probability against the outcomes; nothing where none was said."""
    seen = [
        (row.episode, row.p_success, row.recorded)
        for row in rows
        if row.p_success is not None and row.recorded is not None and row.count == 1
    ]
    if not seen:
        return [], ()
    said, happened = [p for _, p, _ in seen], [outcome for _, _, outcome in seen]
    make = partial(
        measured,
        unit="1",
        n=len(seen),
        counted="trial",
        episodes=[episode for episode, _, _ in seen],
        reason_without_interval="the bins and their counts are in the reliability table",
    )
    measurements = [
        make(
            "reliability.brier",
            lambda: brier(said, happened),
            definition=f"Brier score: mean of (sampled success probability - outcome)^2; {WHOSE}",
        ),
        make(
            "reliability.brier_of_base_rate",
            lambda: brier_of_base_rate(happened),
            definition="Brier score of always saying the observed success rate; above it the "
            "probability is worth nothing",
        ),
        make(
            "reliability.ece",
            lambda: expected_calibration_error(said, happened),
            definition=f"expected calibration error: {NUM_BINS} bins of equal width, sum of "
            "n_bin / n x |mean probability - success rate|; biased upwards for few trials; "
            f"{WHOSE}",
        ),
    ]
    bins = reliability_bins(said, happened)
    table = Table(
        id="reliability",
        title="Is the sampled success probability kept?",
        columns=("from", "to", "trials", "mean probability", "succeeded"),
        rows=tuple((b.low, b.high, b.n, round(b.mean_said, 4), b.succeeded) for b in bins),
        note="Bins of equal width; empty ones are left out.",
    )
    return measurements, (table,)
