"""Does the cell change while a session is recorded? Success by the order of its trials."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from evaluator.compare.measure import ends, measured, vouched_rate
from evaluator.compare.rows import TrialRow, in_order, is_streamed
from evaluator.compare.success import names_of
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Cell, Measurement, Table
from evaluator.statistics.strata import Drift, drift
from evaluator.study_measurements import DRIFT, DRIFT_P

FEWEST = 8
"""Trials from which on their order is looked at."""
MOST_PARTS = 10
IN_PART = 4
"""Trials that one part of a session holds at least."""


def session_order(rows: Sequence[TrialRow]) -> tuple[list[Measurement], tuple[Table, ...]]:
    """Test for a drift of success over the session, and lay its parts out; nothing for few trials.

    Args:
        rows: Trials; those with a known outcome count, in the order of their recording.
    """
    known = [] if is_streamed(rows) else in_order([r for r in rows if r.recorded is not None])
    if len(known) < FEWEST:
        return [], ()
    found: Drift | None = None
    reason = ""
    try:
        found = drift(
            [bool(row.recorded) for row in known],
            [(row.task, row.policy, row.condition) for row in known],
        )
    except UndefinedStatisticError as error:
        reason = error.reason

    def change(name: str, factor: float) -> float:
        if found is None:
            raise UndefinedStatisticError(statistic="drift", reason=reason)
        return factor * float(getattr(found, name))

    measurements = [
        measured(
            defined.of(),
            lambda name=name, factor=factor: change(name, factor),  # type: ignore[misc]
            n=len(known),
            counted="trial",
            reason_without_interval="its p-value is beside it" if name == "change" else "a p-value",
            episodes=names_of(known),
        )
        for defined, name, factor in ((DRIFT, "change", 100.0), (DRIFT_P, "p", 1.0))
    ]
    return measurements, (_table(known),)


def _table(known: Sequence[TrialRow]) -> Table:
    conditions = sorted({row.condition for row in known})
    count = max(2, min(MOST_PARTS, len(known) // (IN_PART * len(conditions))))
    rows: list[dict[str, Cell]] = []
    edges = np.linspace(0, len(known), count + 1).round().astype(int).tolist()
    for first, last in pairwise(edges):
        for condition in conditions:
            part = [row for row in known[first:last] if row.condition == condition]
            k = sum(bool(row.recorded) for row in part)
            low, high = ends(vouched_rate(k, len(part), "wilson")[0]) if part else (None, None)
            rows.append(
                {
                    "trials from": first + 1,
                    "to": last,
                    "condition": condition.replace("_", " "),
                    "k": k,
                    "n": len(part),
                    "rate": k / len(part) if part else None,
                    "low": low,
                    "high": high,
                }
            )
    return Table.of(
        rows,
        id="session_order",
        title="Success by the order of the trials",
        note="Trials in the order of their recording, of a table row after row, in equal parts. "
        "95 % Wilson intervals.",
    )
