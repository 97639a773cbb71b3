"""Two twins, calibrations or engines held against the same recorded trials, pair by pair."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from evaluator.compare.notes import made_with
from evaluator.compare.rows import TrialRow
from evaluator.compare.trial import Trial
from evaluator.errors import EvaluatorError, UndefinedStatisticError
from evaluator.result import Cell, Table
from evaluator.statistics.agreement import pearson
from evaluator.statistics.differences import paired_points
from evaluator.statistics.gate import brier


@dataclass(frozen=True, kw_only=True)
class SharedTrials:
    """What both twins say of the same recorded trials."""

    rows: tuple[tuple[TrialRow, TrialRow], ...]
    """This one's and the other's, of each trial whose outcome and both answers are known."""
    unmatched: int
    """Trials of this one that the other has not, or that lack an answer."""

    @property
    def recorded(self) -> Bool[np.ndarray, " trials"]:
        """Whether each trial succeeded."""
        return np.array([bool(row.recorded) for row, _ in self.rows])

    def answers(self, side: int) -> Bool[np.ndarray, " trials"]:
        """What one twin said: 0 for this one, 1 for the other."""
        return np.array([bool(pair[side].sim_planned) for pair in self.rows])


def shared_trials(mine: Sequence[TrialRow], theirs: Sequence[TrialRow]) -> SharedTrials:
    """Match trials by their id, else by task, policy, condition and start.

    Args:
        theirs: The same trials with the other's; what was recorded must agree.

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
    return SharedTrials(rows=tuple(found), unmatched=len(mine) - len(found))


def _start(row: TrialRow) -> tuple[str | None, ...]:
    return row.task, row.policy, row.condition, row.start_id


def against_tables(
    mine: Sequence[TrialRow],
    theirs: Sequence[TrialRow],
    *,
    names: tuple[str, str],
    trials: tuple[Sequence[Trial], Sequence[Trial]] = ((), ()),
) -> tuple[Table, ...]:
    """Lay out how much better one twin is, which trials flip, and which settings differ."""
    shared = shared_trials(mine, theirs)
    first, second = names if names[0] != names[1] else (f"{names[0]} (1)", f"{names[1]} (2)")
    rows = _differences(shared, (first, second))
    left = f" {shared.unmatched} trials of {first} are not shared." if shared.unmatched else ""
    table = Table.of(
        rows,
        id="against",
        title=f"{first} against {second} on the same {len(shared.rows)} trials",
        note=f"Difference: {first} minus {second}. Accuracy: Tango's interval of "
        f"pairs; one that holds 0 shows no difference.{left}",
    )
    return (table, *_flips(shared, (first, second)), *_settings_table(trials, (first, second)))


def _differences(shared: SharedTrials, names: tuple[str, str]) -> list[dict[str, Cell]]:
    recorded, answers = shared.recorded, (shared.answers(0), shared.answers(1))
    right = [answers[side] == recorded for side in (0, 1)]
    n = len(recorded)
    improved, worsened = int((right[0] & ~right[1]).sum()), int((right[1] & ~right[0]).sum())
    points, tango = paired_points(improved, worsened, n)
    rates = [float(mark.mean()) for mark in right]
    lines = [_line("accuracy", names, rates, points / 100, n)]
    lines[0]["low"], lines[0]["high"] = tango.low / 100, tango.high / 100
    lines[0]["method"] = tango.method
    for name, of in _statistics(shared).items():
        values = [of(side) for side in (0, 1)]
        if None not in values:
            gap = (values[0] or 0.0) - (values[1] or 0.0)
            lines.append(_line(name, names, values, gap, n))
    return lines


def _line(
    name: str,
    names: tuple[str, str],
    values: Sequence[float | None],
    difference: float,
    n: int,
) -> dict[str, Cell]:
    return {
        "number": name,
        names[0]: values[0],
        names[1]: values[1],
        "difference": difference,
        "low": None,
        "high": None,
        "method": None,
        "trials": n,
    }


def _statistics(shared: SharedTrials) -> Mapping[str, Callable[[int], float | None]]:
    """PPV, Brier score and r over groups, of one of the twins."""
    recorded = shared.recorded

    def ppv(side: int) -> float | None:
        accepted = shared.answers(side)
        return float(recorded[accepted].mean()) if accepted.any() else None

    def score(side: int) -> float | None:
        stated = [pair[side].p_success for pair in shared.rows]
        known = [p for p in stated if p is not None]
        return brier(known, recorded.tolist()) if len(known) == len(stated) else None

    def r(side: int) -> float | None:
        keys = [(row.task, row.condition, row.policy) for row, _ in shared.rows]
        groups = [np.array([key == other for other in keys]) for key in dict.fromkeys(keys)]
        real, twin = (
            [float(answers[group].mean()) for group in groups]
            for answers in (recorded, shared.answers(side))
        )
        try:
            return pearson(real, twin)
        except UndefinedStatisticError:
            return None

    return {"PPV": ppv, "Brier score": score, "Pearson r over groups": r}


def _flips(shared: SharedTrials, names: tuple[str, str]) -> tuple[Table, ...]:
    """List the trials that both twins answer differently."""
    rows: list[dict[str, Cell]] = [
        {
            "episode": mine.episode,
            "task": mine.task,
            "condition": mine.condition,
            "policy": mine.policy,
            "recorded": _word(mine.recorded),
            names[0]: _word(mine.sim_planned),
            names[1]: _word(theirs.sim_planned),
            "right": names[0] if mine.sim_planned == mine.recorded else names[1],
            f"failing, {names[0]}": mine.failing_cause or mine.first_failing,
            f"failing, {names[1]}": theirs.failing_cause or theirs.first_failing,
        }
        for mine, theirs in shared.rows
        if mine.sim_planned != theirs.sim_planned
    ]
    if not rows:
        return ()
    title = f"Trials that flip: {len(rows)} of {len(shared.rows)}"
    return (Table.of(rows, id="flips", title=title),)


def _word(answer: bool | None) -> str | None:
    return None if answer is None else ("success" if answer else "failure")


def _settings_table(
    trials: tuple[Sequence[Trial], Sequence[Trial]], names: tuple[str, str]
) -> tuple[Table, ...]:
    """List the settings in which the replays of both differ; nothing where none does."""
    found = [_settings_of(each) for each in trials]
    rows: list[dict[str, Cell]] = [
        {"setting": name, names[0]: found[0].get(name), names[1]: found[1].get(name)}
        for name in sorted(found[0].keys() | found[1].keys())
        if found[0].get(name) != found[1].get(name)
    ]
    if not rows:
        return ()
    title = f"Settings of the replays that differ: {len(rows)}"
    return (Table.of(rows, id="against_settings", title=title),)


def _settings_of(trials: Sequence[Trial]) -> dict[str, str]:
    """Each setting of the planned replays that count, with all its values."""
    values: dict[str, dict[str, None]] = {}
    for trial in trials:
        file = trial.replays.get("planned")
        if file is None:
            continue
        made = {"engine": file.derived.engine, "scene": (file.derived.scene_hash or "")[:12]}
        if file.derived.calibration_id:
            made["calibration"] = file.derived.calibration_id
        for name, value in (made | made_with(file)).items():
            values.setdefault(name, {})[str(value)] = None
    return {name: ", ".join(found) for name, found in values.items()}
