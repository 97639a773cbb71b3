"""Two conditions, two policies or two engines of one run held against each other, in pairs."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from evaluator.compare.against import against_tables, settings_table
from evaluator.compare.gains import START_LIMIT_M, start_distance_m
from evaluator.compare.rows import TrialRow
from evaluator.compare.run import ReadRun
from evaluator.compare.trial import Trial
from evaluator.errors import EvaluatorError
from evaluator.result import Cell, Table
from evaluator.run_reader.episodes import DerivedIndex
from evaluator.statistics.differences import mcnemar, tango_points

Kind = Literal["condition", "policy", "engine"]
KINDS: tuple[Kind, ...] = ("condition", "policy", "engine")
COLUMNS = ("number", "difference", "low", "high", "method", "p", "pairs", "start", "task")
"""Of the tables; something of the run that is called so gets its kind before its name."""
SIDES = (("recorded", "recorded success"), ("sim_planned", "success in the twin"))


def choices(read: ReadRun) -> dict[Kind, tuple[str, ...]]:
    """Return what of a run can be held against each other: kinds that it holds at least two of."""
    found: dict[Kind, tuple[str, ...]] = {
        "condition": tuple(dict.fromkeys(row.condition for row in read.rows if row.condition)),
        "policy": tuple(dict.fromkeys(row.policy for row in read.rows if row.policy)),
        "engine": tuple(
            dict.fromkeys(engine for _, by in _by_engine(read) for engine in sorted(by))
        ),
    }
    return {kind: names for kind, names in found.items() if len(names) > 1}


def within_tables(read: ReadRun, kind: Kind, first: str, second: str) -> tuple[Table, ...]:
    """Lay out the paired differences, what flips, and which settings differ.

    Conditions and policies are paired by task and start; engines by trial.

    Args:
        first: One of ``choices``.

    Raises:
        EvaluatorError: When there is no pair, or they are not two of the run's.
    """
    known = choices(read).get(kind, ())
    if first == second or not {first, second} <= set(known):
        names = ", ".join(known) or f"fewer than two values of {kind}"
        message = f"{first!r} against {second!r}: choose two different ones of {names}."
        raise EvaluatorError(message)
    if kind == "engine":
        answers = [_answers_in(read, engine) for engine in (first, second)]
        return against_tables(
            [trial.row for trial in answers[0]],
            [trial.row for trial in answers[1]],
            names=(first, second),
            trials=(answers[0], answers[1]),
        )
    pairs, left = _pairs(read.rows, kind, first, second)
    if not pairs:
        message = (
            f"No start was tried once with {first} and once with {second} in the same task: "
            f"{left or 'no'} trials could not be paired. Compare their rates on the first page."
        )
        raise EvaluatorError(message)
    sides = tuple(
        [trial for trial in read.trials if getattr(trial.row, kind) == name]
        for name in (first, second)
    )
    mine, theirs = (f"{kind} {x}" if x in COLUMNS else x for x in (first, second))
    return (
        _differences(pairs, kind, (mine, theirs), left),
        *_flips(pairs, kind, (mine, theirs)),
        *settings_table((sides[0], sides[1]), (mine, theirs)),
    )


def _by_engine(read: ReadRun) -> list[tuple[Trial, dict[str, Trial]]]:
    """Each trial with what every engine says of it."""
    index = DerivedIndex(read.contents.derived)
    found = []
    for trial in read.trials:
        if trial.row.plan_id is None:
            continue
        files = index.by_engine(
            source=trial.row.episode, source_sha256=trial.file.sha256, plan_id=trial.row.plan_id
        )
        by: dict[str, Trial] = {}
        for engine, file in files.items():
            decided = file.facts.verdict
            row = replace(
                trial.row,
                sim_planned=None if decided is None else decided.accepted,
                p_success=None if decided is None else decided.p_success,
                first_failing=None if decided is None else decided.first_failing,
                failing_cause=None if decided is None else decided.failing_cause,
            )
            by[engine] = replace(trial, row=row, replays={**trial.replays, "planned": file})
        found.append((trial, by))
    return found


def _answers_in(read: ReadRun, engine: str) -> list[Trial]:
    return [by[engine] for _, by in _by_engine(read) if engine in by]


Pair = tuple[TrialRow, TrialRow]


def _pairs(rows: Sequence[TrialRow], kind: str, first: str, second: str) -> tuple[list[Pair], int]:
    """The same start tried once with each, and how many trials have no such partner."""
    other = "policy" if kind == "condition" else "condition"
    starts: dict[tuple[str, str, str], tuple[list[TrialRow], list[TrialRow]]] = {}
    left = 0
    for row in rows:
        name = getattr(row, kind)
        if name not in (first, second):
            continue
        if row.start_id is None:
            left += 1
            continue
        key = (row.task, getattr(row, other), row.start_id)
        starts.setdefault(key, ([], []))[name == second].append(row)
    pairs = []
    for mine, theirs in starts.values():
        distance_m = start_distance_m(mine[0], theirs[0]) if mine and theirs else None
        if len(mine) != 1 or len(theirs) != 1 or (distance_m or 0.0) > START_LIMIT_M:
            left += len(mine) + len(theirs)
        else:
            pairs.append((mine[0], theirs[0]))
    return pairs, left


def _differences(pairs: Sequence[Pair], kind: str, names: tuple[str, str], left: int) -> Table:
    lines: list[dict[str, Cell]] = []
    for side, words in SIDES:
        known = [
            (bool(getattr(mine, side)), bool(getattr(theirs, side)))
            for mine, theirs in pairs
            if None not in (getattr(mine, side), getattr(theirs, side))
        ]
        if not known:
            continue
        n = len(known)
        better = sum(mine and not theirs for mine, theirs in known)
        worse = sum(theirs and not mine for mine, theirs in known)
        points, tango = tango_points(better, worse, n)
        lines.append(
            {
                "number": words,
                names[0]: sum(mine for mine, _ in known) / n,
                names[1]: sum(theirs for _, theirs in known) / n,
                "difference": points / 100,
                "low": tango.low / 100,
                "high": tango.high / 100,
                "method": tango.method,
                "p": mcnemar((b, a) for a, b in known).p_mid if better + worse else None,
                "pairs": n,
            }
        )
    if not lines:
        message = f"No pair of {names[0]} and {names[1]} has an outcome on both sides."
        raise EvaluatorError(message)
    out = f" {left} trials have no partner of the same task and start." if left else ""
    return Table.of(
        lines,
        id="within",
        title=f"{names[0]} against {names[1]} on the same {len(pairs)} starts",
        note=f"Difference: {names[0]} minus {names[1]}, over starts tried once in each {kind} "
        f"whose objects stood at most {1000 * START_LIMIT_M:.0f} mm apart. Tango's interval of "
        f"pairs, p by McNemar's mid-p test.{out}",
    )


def _flips(pairs: Sequence[Pair], kind: str, names: tuple[str, str]) -> tuple[Table, ...]:
    """List the starts that end differently, as recorded or in the twin."""
    other = "policy" if kind == "condition" else "condition"
    rows: list[dict[str, Cell]] = [
        {
            "start": mine.start_id,
            "task": mine.task,
            other: getattr(mine, other),
            f"episode, {names[0]}": mine.episode,
            f"episode, {names[1]}": theirs.episode,
            f"recorded, {names[0]}": _word(mine.recorded),
            f"recorded, {names[1]}": _word(theirs.recorded),
            f"twin, {names[0]}": _word(mine.sim_planned),
            f"twin, {names[1]}": _word(theirs.sim_planned),
        }
        for mine, theirs in pairs
        if any(
            None not in (one, two) and one != two
            for one, two in (
                (mine.recorded, theirs.recorded),
                (mine.sim_planned, theirs.sim_planned),
            )
        )
    ]
    if not rows:
        return ()
    title = f"Starts that end differently: {len(rows)} of {len(pairs)}"
    return (Table.of(rows, id="flips", title=title),)


def _word(answer: bool | None) -> str | None:
    return None if answer is None else ("success" if answer else "failure")
