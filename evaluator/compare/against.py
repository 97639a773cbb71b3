"""Two twins, calibrations or engines held against the same recorded trials, pair by pair."""

from collections.abc import Sequence
from dataclasses import replace

from evaluator.compare.rows import TrialRow
from evaluator.errors import EvaluatorError
from evaluator.result import Cell, Table
from evaluator.statistics.differences import paired_points


def shared_trials(
    mine: Sequence[TrialRow], theirs: Sequence[TrialRow]
) -> list[tuple[TrialRow, TrialRow]]:
    """Match trials by their id, else by task, policy, condition and start.

    Only those whose outcome and both answers are known; what was recorded must agree.

    Raises:
        EvaluatorError: When no trial is in both, or one is labelled differently in both.
    """
    by_id = {row.episode: row for row in theirs}
    starts: dict[tuple[str | None, ...], list[TrialRow]] = {}
    for row in theirs:
        if row.start_id is not None:
            starts.setdefault(_start(row), []).append(row)
    found = []
    for row in mine:
        alike = starts.get(_start(row), []) if row.start_id is not None else []
        other = by_id.get(row.episode) or (alike[0] if len(alike) == 1 else None)
        if other is None:
            continue
        known = None not in (row.recorded, other.recorded)
        if known and row.recorded != other.recorded:
            message = (
                f"trial {row.episode} succeeded in one and failed in the other: two twins are "
                "compared on the same recorded trials. Correct the label, or compare each alone."
            )
            raise EvaluatorError(message)
        outcome = row.recorded if row.recorded is not None else other.recorded
        if outcome is not None and None not in (row.sim_planned, other.sim_planned):
            found.append((replace(row, recorded=outcome), other))
    if not found:
        message = (
            "No trial has an outcome and an answer of both twins: the same episode id, or the "
            "same task, policy, condition and start_id, must be in both."
        )
        raise EvaluatorError(message)
    return found


def _start(row: TrialRow) -> tuple[str | None, ...]:
    return row.task, row.policy, row.condition, row.start_id


def against_tables(
    mine: Sequence[TrialRow], theirs: Sequence[TrialRow], *, names: tuple[str, str]
) -> tuple[Table, ...]:
    """Lay out how much more often one twin is right, and which trials flip."""
    shared = shared_trials(mine, theirs)
    first, second = names if names[0] != names[1] else (f"{names[0]} (1)", f"{names[1]} (2)")
    right = [[each.sim_planned == row.recorded for each in (row, other)] for row, other in shared]
    counts = [sum(marks[side] for marks in right) for side in (0, 1)]
    improved = sum(a and not b for a, b in right)
    worsened = sum(b and not a for a, b in right)
    points, tango = paired_points(improved, worsened, len(shared))
    line: dict[str, Cell] = {
        "number": "trials in which sim and outcome agree",
        first: counts[0],
        second: counts[1],
        "trials": len(shared),
        "difference (pp)": points,
        "low": tango.low,
        "high": tango.high,
        "method": tango.method,
    }
    left = len(mine) - len(shared)
    table = Table.of(
        [line],
        id="against",
        title=f"{first} against {second} on the same {len(shared)} trials",
        note=f"Difference: {first} minus {second}, with the interval of pairs; one that holds 0 "
        f"shows no difference.{f' {left} trials of {first} are not shared.' if left else ''}",
    )
    return (table, *_flips(shared, (first, second)))


def _flips(
    shared: Sequence[tuple[TrialRow, TrialRow]], names: tuple[str, str]
) -> tuple[Table, ...]:
    """List the trials that both twins answer differently."""
    rows: list[dict[str, Cell]] = [
        {
            "episode": mine.episode,
            "task": mine.task,
            "condition": mine.condition,
            "policy": mine.policy,
            "recorded": "success" if mine.recorded else "failure",
            "right": names[0] if mine.sim_planned == mine.recorded else names[1],
            f"failing, {names[0]}": mine.failing_cause or mine.first_failing,
            f"failing, {names[1]}": theirs.failing_cause or theirs.first_failing,
        }
        for mine, theirs in shared
        if mine.sim_planned != theirs.sim_planned
    ]
    if not rows:
        return ()
    title = f"Trials that flip: {len(rows)} of {len(shared)}"
    return (Table.of(rows, id="flips", title=title),)
