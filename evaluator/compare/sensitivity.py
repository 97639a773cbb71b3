"""Which starts, tags and tasks go with failure, and which with disagreement of twin and robot."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from evaluator.compare.rows import TrialRow
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Cell, Table
from evaluator.statistics.firth import firth

TRIALS_PER_TERM = 4
"""Fewest trials for each term of a joint estimate; Firth's penalty keeps even fewer finite, but
their intervals say nothing."""
MIN_TRIALS = 10
MOST_ROWS = 2000
"""Trials of the joint estimate; of more, the first are taken evenly."""
MOST_TERMS = 12
"""Terms of one joint estimate."""
LEAST_SPREAD_M = 0.005
"""Starts that lie within this are the same start."""


@dataclass(frozen=True, kw_only=True)
class Factor:
    """One term of the joint estimate: a column of numbers."""

    factor: str
    level: str
    column: Float64[np.ndarray, " trials"]
    trials: int
    """With this level; all, where it is a number."""


OUTCOMES: tuple[tuple[str, Callable[[TrialRow], bool | None]], ...] = (
    ("failure", lambda row: None if row.recorded is None else not row.recorded),
    (
        "disagreement",
        lambda row: (
            None
            if row.recorded is None or row.sim_planned is None
            else row.recorded != row.sim_planned
        ),
    ),
)


def sensitivity_table(rows: Sequence[TrialRow]) -> tuple[Table, ...]:
    """Estimate jointly what goes with failure and with disagreement; none without factors.

    Factors are tags, start positions of objects, tasks, conditions and policies, in this order, as
    many as the trials carry. Levels are held against the most frequent one of their factor.

    Args:
        rows: Trials; those of a streamed table have no starts and are left out.
    """
    kept = [row for row in rows if row.count == 1 and row.episode]
    if not any(row.tags or row.start_positions_m for row in kept):
        return ()
    lines: list[dict[str, Cell]] = []
    for name, outcome_of in OUTCOMES:
        known = [row for row in kept if outcome_of(row) is not None]
        known = known[:: max(1, -(-len(known) // MOST_ROWS))]
        lines += _lines(name, known, [bool(outcome_of(row)) for row in known])
    if not lines:
        return ()
    note = (
        "One joint estimate for each outcome: Firth's penalised logistic regression (1993). Odds "
        "ratio above 1: goes with failure, or with disagreement of sim and outcome; of a level "
        "against the most frequent one, of a start per standard deviation of where it lay. "
        "Intervals: 95 % profile of the penalised likelihood. Holm: p over all rows of the "
        "outcome, so that one of many is not found by looking often. What goes with is no cause."
    )
    return (Table.of(lines, id="sensitivity", title="What failure goes with", note=note),)


def _lines(name: str, rows: Sequence[TrialRow], happened: list[bool]) -> list[dict[str, Cell]]:
    if len(rows) < MIN_TRIALS:
        reason = f"{len(rows)} trials; a joint estimate needs {MIN_TRIALS}"
        return [_undefined(name, len(rows), sum(happened), reason)]
    factors, left = _chosen(_factors(rows), len(rows))
    if not factors:
        return [_undefined(name, len(rows), sum(happened), "no factor varies enough")]
    design = np.column_stack([np.ones(len(rows)), *(factor.column for factor in factors)])
    try:
        effects = firth(design, np.array(happened, dtype=np.float64))[1:]
    except UndefinedStatisticError as error:
        return [_undefined(name, len(rows), sum(happened), error.reason)]
    lines = [
        _line(name, factor, len(rows), sum(happened), effect.value, effect.low, effect.high)
        | {"p": effect.p, "p (Holm)": adjusted}
        for factor, effect, adjusted in zip(
            factors, effects, holm([effect.p for effect in effects]), strict=True
        )
    ]
    for factor in left:
        reason = "more terms than the trials carry, or told apart from none before it"
        lines.append(
            _undefined(name, len(rows), sum(happened), reason)
            | {"factor": factor.factor, "level": factor.level}
        )
    return lines


def _line(
    name: str,
    factor: Factor,
    n: int,
    happened: int,
    value: float,
    low: float | None,
    high: float | None,
) -> dict[str, Cell]:
    ratio = [None if end is None else float(np.exp(end)) for end in (value, low, high)]
    return {
        "outcome": name,
        "factor": factor.factor,
        "level": factor.level,
        "trials": factor.trials,
        "of": n,
        "happened": happened,
        "odds ratio": ratio[0],
        "low": ratio[1],
        "high": ratio[2],
        "p": None,
        "p (Holm)": None,
        "why undefined": None,
    }


def _undefined(name: str, n: int, happened: int, reason: str) -> dict[str, Cell]:
    none = Factor(factor="", level="", column=np.zeros(0), trials=n)
    line = _line(name, none, n, happened, 0.0, None, None)
    return line | {"odds ratio": None, "why undefined": reason}


def holm(values: Sequence[float]) -> list[float]:
    """Adjust p values for their number (Holm 1979).

    Args:
        values: Unadjusted p values.
    """
    order = np.argsort(values)
    adjusted = np.empty(len(values))
    most = 0.0
    for place, index in enumerate(order):
        most = max(most, min(1.0, (len(values) - place) * values[index]))
        adjusted[index] = most
    return [float(value) for value in adjusted]


def _factors(rows: Sequence[TrialRow]) -> list[Factor]:
    """Everything that varies: tags first, then starts, then what a trial belongs to."""
    found: list[Factor] = []
    axes = list(dict.fromkeys(axis for row in rows for axis, _ in row.tags))
    for axis in axes:
        found += _levels(axis, [dict(row.tags).get(axis, "") for row in rows])
    for name in sorted({name for row in rows for name in row.start_positions_m}):
        if not all(name in row.start_positions_m for row in rows):
            continue  # a start that is known of some trials alone
        places = np.array([row.start_positions_m[name] for row in rows])
        for axis, column in zip("xyz", places.T, strict=True):
            spread = float(column.std())
            if spread > LEAST_SPREAD_M:
                level = f"{axis}, per {1000 * spread:.0f} mm"
                scaled = (column - column.mean()) / spread
                found.append(
                    Factor(factor=f"start of {name}", level=level, column=scaled, trials=len(rows))
                )
    for kind in ("task", "condition", "policy"):
        found += _levels(kind, [getattr(row, kind) for row in rows])
    return found


def _levels(factor: str, values: Sequence[str]) -> list[Factor]:
    """A column for each level but the most frequent one."""
    counts = Counter(values)
    if len(counts) < 2:
        return []
    (reference, _), *others = counts.most_common()
    return [
        Factor(
            factor=factor,
            level=f"{level or 'none'} (against {reference or 'none'})",
            column=np.array([float(value == level) for value in values]),
            trials=count,
        )
        for level, count in others
    ]


def _chosen(factors: Sequence[Factor], n: int) -> tuple[list[Factor], list[Factor]]:
    """Take terms in order as long as the trials carry them and they are told apart."""
    kept: list[Factor] = []
    left: list[Factor] = []
    columns = [np.ones(n)]
    for factor in factors:
        tried = np.column_stack([*columns, factor.column])
        enough = tried.shape[1] * TRIALS_PER_TERM <= n and len(kept) < MOST_TERMS
        if enough and np.linalg.matrix_rank(tried) == tried.shape[1]:
            kept.append(factor)
            columns.append(factor.column)
        else:
            left.append(factor)
    return kept, left
