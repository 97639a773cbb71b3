"""The gate's worth clause by clause: how often each refused, and how often it was right to."""

from collections.abc import Callable, Sequence

from evaluator.compare.clauses import FACTORS, Clauses
from evaluator.compare.measure import proportion, slug, vouched_rate
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import names_of
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Cell, Measurement, Table
from evaluator.statistics.gate import Confusion, break_even, cost_curve

PLANNED, GATE = "planned in twin", "verdict before motion, not obeyed"
PRICES = (0.1, 0.5, 1.0)
"""Of refusing a good plan, in bad executions, at which each clause is priced."""


def clause_worth(
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
    for side, name, members, said in (
        (PLANNED, "planned", known, _of_replay),
        (GATE, "verdict", list(not_obeyed), _of_gate),
    ):
        for clause in _clauses_in(members, said):
            asked = [row for row in members if _answer(said(row), clause) is not None]
            counts = _confusion(asked, said, clause)
            measurements += _measure(name, side, clause, asked, counts, said)
            lines.append((side, clause, *_line(counts)))
            if name == "verdict":
                costs.append((clause, *_costs(counts)))
    return measurements, (*_table(lines), *_cost_table(costs))


def _of_replay(row: TrialRow) -> Clauses:
    return row.clauses


def _of_gate(row: TrialRow) -> Clauses:
    return row.gate_clauses


def _clauses_in(rows: Sequence[TrialRow], said: Callable[[TrialRow], Clauses]) -> list[str]:
    """Clauses that were decided in some trial: the factors first, then predicates by name."""
    found = {name for row in rows for name, _ in said(row)}
    return [*(n for n in FACTORS if n in found), *sorted(found - set(FACTORS))]


def _answer(clauses: Clauses, clause: str) -> bool | None:
    return next((value for name, value in clauses if name == clause), None)


def _confusion(
    rows: Sequence[TrialRow], said: Callable[[TrialRow], Clauses], clause: str
) -> Confusion:
    return Confusion.weigh(
        (bool(_answer(said(row), clause)), bool(row.recorded), row.count) for row in rows
    )


def _measure(
    name: str,
    side: str,
    clause: str,
    asked: Sequence[TrialRow],
    counts: Confusion,
    said: Callable[[TrialRow], Clauses],
) -> list[Measurement]:
    refused = [row for row in asked if _answer(said(row), clause) is False]
    return [
        proportion(
            f"gate.clause.{name}.{slug(clause)}.{what}",
            k,
            n,
            definition=words,
            counted="trial",
            reason_if_undefined=f"{clause} never said no ({side})",
            episodes=names_of(episodes),
        )
        for what, k, n, words, episodes in (
            (
                "refused",
                counts.said_failure,
                counts.n,
                f"trials in which {clause} said no / trials in which it was decided ({side})",
                asked,
            ),
            (
                "right",
                counts.true_negative,
                counts.said_failure,
                f"trials that failed / trials in which {clause} said no ({side})",
                refused,
            ),
        )
    ]


def _line(counts: Confusion) -> tuple[Cell, ...]:
    failed = counts.false_positive + counts.true_negative
    return (
        counts.n,
        counts.said_failure,
        counts.true_negative,
        _rate(counts.true_negative, counts.said_failure),
        counts.false_negative,
        _rate(counts.true_negative, failed),
        _price(counts),
    )


def _rate(k: int, n: int) -> str | None:
    """Write a share with its interval; None where it has no denominator."""
    if not n:
        return None
    interval, _ = vouched_rate(k, n, "wilson")
    text = f"{k}/{n} = {100 * k / n:.0f} %"
    if interval is None:
        return text
    return f"{text} [{100 * interval.low:.0f}, {100 * interval.high:.0f}]"


def _price(counts: Confusion) -> Cell:
    try:
        return round(break_even(counts), 3)
    except UndefinedStatisticError:
        return "any" if counts.true_negative else None


def _costs(counts: Confusion) -> tuple[Cell, ...]:
    points = cost_curve(counts, PRICES)
    return (*(round(point.with_gate, 4) for point in points), round(points[0].without_gate, 4))


def _table(lines: Sequence[tuple[Cell, ...]]) -> tuple[Table, ...]:
    if not lines:
        return ()
    return (
        Table(
            id="gate_clauses",
            title="What each clause of the verdict is worth",
            columns=(
                "said by",
                "clause",
                "trials",
                "said no",
                "of them failed",
                "right to say no",
                "good plans refused",
                "failures it found",
                "pays up to a price of",
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


def _cost_table(costs: Sequence[tuple[Cell, ...]]) -> tuple[Table, ...]:
    if not costs:
        return ()
    prices = tuple(f"obeying it, price {price:g}" for price in PRICES)
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
