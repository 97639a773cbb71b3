"""Trial by trial: does what the twin said agree with what happened, and does the gate pay?"""

from collections.abc import Callable, Sequence
from functools import partial

from bridge.episode.metadata import CONTROL
from evaluator.compare.measure import ends, measured, proportion, vouched_rate
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import WITH, WITHOUT, Answer, names_of
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import (
    AGREED,
    BREAK_EVEN_PRICE,
    BRIER,
    BRIER_OF_BASE_RATE,
    BRIER_PERFECT,
    CLAUSE_REFUSED,
    CLAUSE_RIGHT,
    ECE,
    ECE_PERFECT,
    FACTOR_NPV,
    KAPPA,
    NPV,
    PHI,
    PPV,
)
from evaluator.result import Cell, Interval, Measurement, Table
from evaluator.run_reader.episodes import FACTORS, Clauses
from evaluator.statistics.calibration import (
    Perfect,
    brier_interval,
    calibration_error_interval,
    perfect_forecaster,
)
from evaluator.statistics.gate import (
    Confusion,
    break_even,
    brier,
    brier_of_base_rate,
    cost_curve,
    expected_calibration_error,
    kappa,
    phi,
    reliability_bins,
)
from evaluator.statistics.intervals import LEVEL

PLANNED, GATE = "planned in twin", "verdict before motion, not obeyed"
REFUSAL_PRICES = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0)
"""Of refusing a good plan, in bad executions, at which the gate is priced."""
CLAUSE_PRICES = (0.1, 0.5, 1.0)
"""Those at which each clause alone is priced."""


def clause_scorecard(
    rows: Sequence[TrialRow], not_obeyed: Sequence[TrialRow]
) -> tuple[list[Measurement], tuple[Table, ...]]:
    """Judge every clause of the replay's verdict, and of the gate's where it decided nothing.

    Args:
        rows: All trials; those with a known outcome and a planned replay count.
        not_obeyed: Trials whose gate verdict was recorded and not obeyed, with known outcomes.
    """
    known = [row for row in rows if row.recorded is not None]
    measurements: list[Measurement] = []
    lines: list[tuple[Cell, ...]] = []
    costs: list[tuple[Cell, ...]] = []
    for side, name, members, answer_of in (
        (PLANNED, "planned", known, _of_replay),
        (GATE, "verdict", list(not_obeyed), _of_gate),
    ):
        for clause in _clauses_in(members, answer_of):
            asked = [row for row in members if _answer(answer_of(row), clause) is not None]
            counts = _confusion(asked, answer_of, clause)
            measurements += _measure(name, side, clause, asked, counts, answer_of)
            lines.append((side, clause, *_line(counts)))
            if name == "verdict":
                costs.append((clause, *_costs(counts)))
    return measurements, (*_clause_table(lines), *_clause_cost_table(costs))


def _of_replay(row: TrialRow) -> Clauses:
    return row.clauses


def _of_gate(row: TrialRow) -> Clauses:
    return row.gate_clauses


def _clauses_in(rows: Sequence[TrialRow], answer_of: Callable[[TrialRow], Clauses]) -> list[str]:
    """Clauses that were decided in some trial: the factors first, then predicates by name."""
    found = {name for row in rows for name, _ in answer_of(row)}
    return [*(n for n in FACTORS if n in found), *sorted(found - set(FACTORS))]


def _answer(clauses: Clauses, clause: str) -> bool | None:
    return next((value for name, value in clauses if name == clause), None)


def _confusion(
    rows: Sequence[TrialRow], answer_of: Callable[[TrialRow], Clauses], clause: str
) -> Confusion:
    return Confusion.weigh(
        (bool(_answer(answer_of(row), clause)), bool(row.recorded), row.count) for row in rows
    )


def _measure(
    name: str,
    side: str,
    clause: str,
    asked: Sequence[TrialRow],
    counts: Confusion,
    answer_of: Callable[[TrialRow], Clauses],
) -> list[Measurement]:
    refused = [row for row in asked if _answer(answer_of(row), clause) is False]
    return [
        proportion(
            quantity.of(by=name, clause=clause, name=clause, side=side),
            k,
            n,
            counted="trial",
            reason_if_undefined=f"{clause} never said no ({side})",
            episodes=names_of(episodes),
        )
        for quantity, k, n, episodes in (
            (CLAUSE_REFUSED, counts.predicted_failure, counts.n, asked),
            (CLAUSE_RIGHT, counts.true_negative, counts.predicted_failure, refused),
        )
    ]


def _line(counts: Confusion) -> tuple[Cell, ...]:
    failed = counts.false_positive + counts.true_negative
    return (
        counts.n,
        counts.predicted_failure,
        counts.true_negative,
        *_rate(counts.true_negative, counts.predicted_failure),
        counts.false_negative,
        failed,
        *_rate(counts.true_negative, failed),
        _price(counts),
    )


def _rate(k: int, n: int) -> tuple[Cell, ...]:
    """Return a share with its interval; unknown where it has no denominator."""
    return (k / n, *ends(vouched_rate(k, n, "wilson")[0])) if n else (None, None, None)


def _price(counts: Confusion) -> float | None:
    try:
        return round(break_even(counts), 3)
    except UndefinedStatisticError:
        return None


def _costs(counts: Confusion) -> tuple[Cell, ...]:
    points = cost_curve(counts, CLAUSE_PRICES)
    return (*(round(point.with_gate, 4) for point in points), round(points[0].without_gate, 4))


def _clause_table(lines: Sequence[tuple[Cell, ...]]) -> tuple[Table, ...]:
    if not lines:
        return ()
    return (
        Table(
            id="gate_clauses",
            title="Scorecard of each clause of the verdict",
            columns=(
                *("verdict of", "clause", "trials", "refused", "refused and failed"),
                *("right", "right low", "right high", "good plans refused"),
                *("failed", "found", "found low", "found high", "pays up to a price of"),
            ),
            rows=tuple(lines),
            note="Trials with a known outcome in which the clause was decided. A clause that says "
            "no refuses the plan, except for terminal.allowed_contacts where the task does not "
            "list it: it is asked of every rollout. Brackets: 95 % Wilson intervals in percent. "
            "Price: of refusing a good plan, in bad executions; any: it refused no good plan. "
            "In trials with replanning the gate had selected the plan, so there clauses of the "
            "planned replay have little left to refuse.",
        ),
    )


def _clause_cost_table(costs: Sequence[tuple[Cell, ...]]) -> tuple[Table, ...]:
    if not costs:
        return ()
    prices = tuple(f"obeying it, price {price:g}" for price in CLAUSE_PRICES)
    return (
        Table(
            id="gate_clause_costs",
            title="What obeying one clause alone would cost",
            columns=("clause", *prices, "executing everything"),
            rows=tuple(costs),
            note="Mean cost per trial in bad executions, over the trials in which the gate was "
            "asked and not obeyed; price: of refusing a good plan.",
        ),
    )


def agreement(rows: Sequence[TrialRow], *, method: str = "wilson") -> list[Measurement]:
    """Measure k/n agreement, phi, kappa and predictive values, of the replay and of the verdict.

    Args:
        rows: Trials; those without an answer or an outcome do not count.
        method: Interval of rates: wilson, clopper-pearson or jeffreys.
    """
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
    """Count what was said against what was labelled, over trials where both are known.

    Args:
        rows: Trials, each as often as its ``count`` says.
        answer_of: Reads what the twin said of a trial; None where it said nothing.
    """
    return Confusion.weigh(
        (answer, row.recorded, row.count)
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
    """Price the gate on the trials in which it was asked and not obeyed, and judge its clauses."""
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
        *_clauses(rows),
    ]
    by_clause, clause_tables = clause_scorecard(rows, asked)
    tables = _cost_table(counts) if counts.n else ()
    return [*measurements, *by_clause], (*clause_tables, *tables)


def _clauses(rows: Sequence[TrialRow]) -> list[Measurement]:
    """How often the trials failed that the twin called a failure for this reason."""
    measurements = []
    for clause in FACTORS:
        blamed = [
            row
            for row in rows
            if row.sim_planned is False and row.first_failing == clause and row.recorded is not None
        ]
        counts = confusion_of(blamed, lambda row: row.sim_planned)
        measurements.append(
            proportion(
                FACTOR_NPV.of(clause=clause),
                counts.true_negative,
                counts.predicted_failure,
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
        make(BRIER_PERFECT.of(), lambda: _shown(ideal[0]), reason_without_interval=CERTAIN),
        make(
            BRIER_OF_BASE_RATE.of(),
            lambda: brier_of_base_rate(happened),
            reason_without_interval="the outcomes' own rate; what it would be on others is unknown",
        ),
        make(
            ECE.of(),
            lambda: (
                expected_calibration_error(probabilities, happened),
                calibration_error_interval(probabilities, happened),
            ),
        ),
        make(ECE_PERFECT.of(), lambda: _shown(ideal[1]), reason_without_interval=CERTAIN),
    ]
    bins = reliability_bins(probabilities, happened)
    table = Table(
        id="reliability",
        title="Is the sampled success probability kept?",
        columns=("from", "to", "trials", "mean probability", "succeeded"),
        rows=tuple((b.low, b.high, b.n, round(b.mean_probability, 4), b.succeeded) for b in bins),
        note="Bins of equal width; empty ones are left out.",
    )
    return measurements, (table,)


CERTAIN = "every stated probability is 0 or 1: a perfect forecaster shows nothing else"


def _shown(perfect: Perfect) -> float | tuple[float, Interval]:
    if perfect.low == perfect.high:
        return perfect.mean
    range_ = Interval(low=perfect.low, high=perfect.high, level=LEVEL, method="perfect-forecaster")
    return perfect.mean, range_
