"""Agreement along what was varied: lighting, pose, distractor, start region."""

from collections.abc import Sequence

from evaluator.compare.measure import (
    RATE_COLUMNS,
    ends,
    rate_row,
)
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import trials_in
from evaluator.result import Cell, Measurement, Table
from evaluator.statistics.differences import paired_points, unpaired_points
from evaluator.statistics.intervals import RATE_INTERVALS

MOST_VALUES = 40
"""Values of one axis that a table lists; an axis with more is a number, not a setting."""


def axis_tables(
    rows: Sequence[TrialRow], word: str, *, method: str = "wilson"
) -> tuple[Table, ...]:
    """Lay out, for every value of every axis, how sim and outcome agree; none without tags."""
    found: dict[str, dict[str, list[TrialRow]]] = {}
    for row in rows:
        for axis, value in row.tags:
            found.setdefault(axis, {}).setdefault(value, []).append(row)
    lines = [
        (axis, value, *_axis_line(members, method))
        for axis, values in found.items()
        if len(values) <= MOST_VALUES
        for value, members in values.items()
    ]
    if not lines:
        return ()
    columns = (
        *("axis", "value", "trials", *(f"agree {name}" for name in RATE_COLUMNS)),
        *(f"{word} rate", "sim rate", f"sim - {word} (pp)", "gap low", "gap high", "gap interval"),
    )
    note = (
        "Agreement is over trials where both sides are known. The gap is of pairs (Tango) where "
        "there are any, else of each side's own trials (score). One axis at a time: what "
        "varies together is not told apart here."
    )
    return (
        Table(
            id="axes",
            title="Agreement along each axis",
            columns=columns,
            rows=tuple(lines),
            note=note,
        ),
    )


def _axis_line(rows: Sequence[TrialRow], method: str) -> tuple[Cell, ...]:
    both = [row for row in rows if row.recorded is not None and row.sim_planned is not None]
    agree, n = trials_in(row for row in both if row.recorded == row.sim_planned), trials_in(both)
    rate = Measurement(
        id="agree",
        unit="1",
        definition="sim and outcome agree",
        value=agree / n if n else None,
        interval=RATE_INTERVALS[method](agree, n) if n else None,
        k=agree,
        n=n,
        reason_if_undefined=None if n else "no trial has both sides",
    )
    real, sim = _counts(rows, "recorded", both), _counts(rows, "sim_planned", both)
    if not (real[1] and sim[1]):
        gap: tuple[Cell, ...] = (None, None, None, None)
    elif both:
        improved = trials_in(row for row in both if row.sim_planned and not row.recorded)
        worsened = trials_in(row for row in both if row.recorded and not row.sim_planned)
        points, tango = paired_points(improved, worsened, n)
        gap = (points, tango.low, tango.high, tango.method)
    else:
        points, score = unpaired_points(real, sim)
        gap = (points, *ends(score), score.method)
    rates = [None if not n_side else k_side / n_side for k_side, n_side in (real, sim)]
    return (trials_in(rows), *rate_row(rate), *rates, *gap)


def _counts(rows: Sequence[TrialRow], side: str, both: Sequence[TrialRow]) -> tuple[int, int]:
    """Successes and trials of one side, over trials where both are known if there are any."""
    known = [row for row in both or rows if getattr(row, side) is not None]
    return trials_in(row for row in known if getattr(row, side)), trials_in(known)
