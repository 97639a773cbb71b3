"""Two twins, calibrations or engines held against the same recorded trials, pair by pair."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from evaluator.compare.notes import made_with
from evaluator.compare.rows import TrialRow
from evaluator.compare.trial import Trial
from evaluator.errors import EvaluatorError
from evaluator.result import Cell, Table
from evaluator.statistics.differences import mcnemar, tango_points

SEED, DRAWS = 0, 2000
LEVEL = 0.95
FEWEST = 8
"""Shared trials below which resampling says nothing."""
MIN_GROUPS = 3
Numbers = Float64[np.ndarray, " draws"]


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
    """Lay out how much better one twin is, which trials flip, and which settings differ.

    Args:
        trials: The trials with their replays, of runs; settings are read from those.
    """
    shared = shared_trials(mine, theirs)
    first, second = names if names[0] != names[1] else (f"{names[0]} (1)", f"{names[1]} (2)")
    rows = _differences(shared, (first, second))
    left = f" {shared.unmatched} trials of {first} are not shared." if shared.unmatched else ""
    table = Table.of(
        rows,
        id="against",
        title=f"{first} against {second} on the same {len(shared.rows)} trials",
        note=f"Difference: {first} minus {second}. Accuracy: Tango's interval of pairs, p by "
        "McNemar's mid-p test. The others: 95 % percentiles of trials drawn anew with both "
        f"answers, inside their groups; an interval that holds 0 shows no difference.{left}",
    )
    return (table, *_flips(shared, (first, second)), *_settings_table(trials, (first, second)))


def _differences(shared: SharedTrials, names: tuple[str, str]) -> list[dict[str, Cell]]:
    recorded, answers = shared.recorded, (shared.answers(0), shared.answers(1))
    right = [answers[side] == recorded for side in (0, 1)]
    n = len(recorded)
    improved, worsened = int((right[0] & ~right[1]).sum()), int((right[1] & ~right[0]).sum())
    points, tango = tango_points(improved, worsened, n)
    pairs = list(zip(right[1].tolist(), right[0].tolist(), strict=True))
    p = mcnemar(pairs).p_mid if improved + worsened else None
    rates = [float(mark.mean()) for mark in right]
    lines = [_line("accuracy", names, rates, points / 100, n)]
    lines[0]["low"], lines[0]["high"] = tango.low / 100, tango.high / 100
    lines[0]["method"], lines[0]["p"] = tango.method, p
    draws = _draws(shared)
    for name, of in _statistics(shared).items():
        everything = np.arange(n)[None, :]
        values = [float(of(everything, side)[0]) for side in (0, 1)]
        defined = all(np.isfinite(values))
        gap = values[0] - values[1] if defined else None
        line = _line(name, names, [v if np.isfinite(v) else None for v in values], gap, n)
        if gap is not None and n >= FEWEST:
            gaps: Numbers = of(draws, 0) - of(draws, 1)
            gaps = gaps[np.isfinite(gaps)]
            if len(gaps) > DRAWS // 2 and np.ptp(gaps) > 0:
                low, high = np.quantile(gaps, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
                line["low"], line["high"] = float(low), float(high)
                line["method"] = "paired bootstrap"
        lines.append(line)
    return lines


def _line(
    name: str,
    names: tuple[str, str],
    values: Sequence[float | None],
    difference: float | None,
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
        "p": None,
        "trials": n,
    }


Statistic = Callable[[Int64[np.ndarray, "draws trials"], int], Numbers]


def _statistics(shared: SharedTrials) -> Mapping[str, Statistic]:
    """PPV, Brier score and r over groups, of drawn trials and one of the twins."""
    recorded = shared.recorded.astype(float)
    answers = [shared.answers(side).astype(float) for side in (0, 1)]
    chances = [[pair[side].p_success for pair in shared.rows] for side in (0, 1)]
    keys = [(row.task, row.condition, row.policy) for row, _ in shared.rows]
    places = {key: place for place, key in enumerate(dict.fromkeys(keys))}
    group = np.array([places[key] for key in keys])

    def ppv(drawn: Int64[np.ndarray, "draws trials"], side: int) -> Numbers:
        yes, good = answers[side][drawn], recorded[drawn]
        with np.errstate(invalid="ignore"):
            return np.asarray((yes * good).sum(axis=1) / yes.sum(axis=1))

    def r(drawn: Int64[np.ndarray, "draws trials"], side: int) -> Numbers:
        means = []
        for values in (recorded, answers[side]):
            sums = [(values[drawn] * (group[drawn] == g)).sum(axis=1) for g in range(len(places))]
            counts = [(group[drawn] == g).sum(axis=1) for g in range(len(places))]
            means.append(np.array(sums) / np.array(counts))
        x, y = (m - m.mean(axis=0) for m in means)
        with np.errstate(invalid="ignore"):
            return np.asarray(
                (x * y).sum(axis=0) / np.sqrt((x * x).sum(axis=0) * (y * y).sum(axis=0))
            )

    found: dict[str, Statistic] = {"PPV": ppv}
    if all(chance is not None for side in chances for chance in side):
        stated = np.array(chances, dtype=float)

        def brier(drawn: Int64[np.ndarray, "draws trials"], side: int) -> Numbers:
            return np.asarray(((stated[side][drawn] - recorded[drawn]) ** 2).mean(axis=1))

        found["Brier score"] = brier
    if len(places) >= MIN_GROUPS:
        found["Pearson r over groups"] = r
    return found


def _draws(shared: SharedTrials) -> Int64[np.ndarray, "draws trials"]:
    """Trials drawn anew inside their groups, so that no group is lost."""
    rng = np.random.default_rng(SEED)
    keys = [(row.task, row.condition, row.policy) for row, _ in shared.rows]
    parts = []
    for key in dict.fromkeys(keys):
        members = np.array([i for i, other in enumerate(keys) if other == key])
        parts.append(members[rng.integers(len(members), size=(DRAWS, len(members)))])
    return np.concatenate(parts, axis=1)


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
