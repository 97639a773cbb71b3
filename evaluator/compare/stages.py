"""Where trials are lost: the stage funnel, success over control steps, kinds of failure."""

from collections import Counter
from collections.abc import Sequence

from bridge.episode.reader import Episode
from evaluator.compare.known_task import known_task, recorded_task
from evaluator.compare.measure import RATE_COLUMNS, proportion
from evaluator.compare.rows import TrialRow
from evaluator.measurements import STAGE
from evaluator.result import Cell, Exclusion, Measurement, Table
from evaluator.statistics.funnel import (
    CurvePoint,
    StageCount,
    failure_taxonomy,
    funnel,
    success_curve,
)
from evaluator.statistics.intervals import wilson

NOT_LABELLED, NO_STAGE = "stage not labelled", "no stage, but the task"
"""Stand for the stage of a failure of which nobody named one."""
Trial = tuple[TrialRow, tuple[tuple[str, bool | None], ...]]


def stages_of(row: TrialRow) -> tuple[tuple[str, bool | None], ...]:
    """Return how each stage of a trial ended.

    A trial counted in sub-tasks k of n stands for k passed and the next one failed: sub-tasks are
    done in order and the first failure ends the trial.
    """
    if row.stages:
        return row.stages
    if row.unit != "subtask" or row.k is None or not row.n:
        return ()
    ended = [True] * row.k + [False] * (row.k < row.n) + [None] * max(0, row.n - row.k - 1)
    return tuple((f"subtask_{place}", answer) for place, answer in enumerate(ended, start=1))


def stage_results(
    rows: Sequence[TrialRow],
) -> tuple[list[Measurement], tuple[Table, ...], list[Exclusion]]:
    """Measure each stage of each task and condition, and success up to each control step."""
    groups: dict[tuple[str, str], list[Trial]] = {}
    for row in rows:
        stages = stages_of(row)
        if stages and row.count == 1:
            groups.setdefault((row.task, row.condition), []).append((row, stages))
    measurements: list[Measurement] = []
    left_out: list[Exclusion] = []
    funnel_rows: list[tuple[str | int | None, ...]] = []
    curve_rows: list[tuple[Cell, ...]] = []
    for (task, condition), trials in groups.items():
        names = [name for name, _ in trials[0][1]]
        alike = [trial for trial in trials if [name for name, _ in trial[1]] == names]
        left_out += [
            Exclusion(
                episode=row.episode,
                scope="stage funnel",
                reason=f"its stages differ from those of {trials[0][0].episode}",
            )
            for row, stages in trials
            if [name for name, _ in stages] != names
        ]
        ended = [[answer for _, answer in stages] for _, stages in alike]
        found = funnel(ended, names)
        episodes = [row.episode for row, _ in alike]
        measurements += [_measure(task, condition, stage, episodes) for stage in found]
        words = condition.replace("_", " ")
        funnel_rows += [
            (task, words, s.name, s.reached, s.passed, s.unknown or None) for s in found
        ]
        curves = (("trials so far", _survival(found)), *_objects(alike[0][0], names, ended))
        curve_rows += [
            (task, words, counted, p.step, *_band(p)) for counted, points in curves for p in points
        ]
    return measurements, _tables(funnel_rows, curve_rows), left_out


def _measure(task: str, condition: str, stage: StageCount, episodes: list[str]) -> Measurement:
    return proportion(
        STAGE.of(task=task, condition=condition, stage=stage.name),
        stage.passed,
        stage.reached - stage.unknown,
        counted="trial",
        reason_if_undefined="no trial reached it, or none is labelled",
        episodes=episodes,
    )


def _survival(stages: Sequence[StageCount]) -> list[CurvePoint]:
    """Trials in which every control step up to this one succeeded; a stage is a control step.

    Trials whose ending is unknown somewhere on the way cannot be counted as either.
    """
    trials, points = stages[0].reached, []
    for step, stage in enumerate(stages, start=1):
        trials -= stage.unknown
        points.append(CurvePoint(step=step, done=stage.passed, n=trials))
    return points


def _objects(
    row: TrialRow, names: Sequence[str], ended: Sequence[Sequence[bool | None]]
) -> tuple[tuple[str, list[CurvePoint]], ...]:
    """Objects that were released where they belong, by control step, for tasks with several.

    The task file says which stages release something; of a task without one nothing is known. An
    object whose stage came and has no known ending is neither; one whose stage was not reached,
    because an earlier one failed, is not where it belongs.
    """
    known = known_task(row.task) if row.path is None else recorded_task(Episode.open(row.path))
    releasing = (
        {str(stage["id"]) for stage in known.stages if stage.get("release") or stage.get("push")}
        if known
        else ()
    )
    places = [place for place, name in enumerate(names, start=1) if name in releasing]
    if len(places) < 2:
        return ()
    done_at = [
        place if trial[place - 1] else None
        for trial in ended
        for place in places
        if trial[place - 1] is not None or False in trial[: place - 1]
    ]
    return (("objects", success_curve(done_at, len(names))),) if done_at else ()


def _band(point: CurvePoint) -> tuple[Cell, ...]:
    if not point.n:
        return (point.done, 0, None, None, None, None)
    interval = wilson(point.done, point.n)
    rate = point.done / point.n
    return (point.done, point.n, rate, interval.low, interval.high, interval.method)


def _tables(
    funnel_rows: Sequence[tuple[str | int | None, ...]],
    curve_rows: Sequence[tuple[Cell, ...]],
) -> tuple[Table, ...]:
    if not funnel_rows:
        return ()
    return (
        Table(
            id="funnel",
            title="Stage funnel",
            columns=("task", "condition", "stage", "reached", "passed", "unknown"),
            rows=tuple(funnel_rows),
            note="Reached: every earlier stage succeeded. A stage after a failed one is not "
            "reached, even where it is labelled a success.",
        ),
        Table(
            id="success_curve",
            title="Success over control steps",
            columns=("task", "condition", "counted", "control step", *RATE_COLUMNS),
            rows=tuple(curve_rows),
            note="Trials so far: every control step up to this one succeeded. Objects: released "
            "where they belong up to this step, whatever happened to the others; those of which "
            "nobody said it are left out. Brackets: 95 % "
            "Wilson intervals in percent; neighbouring steps share their trials.",
        ),
    )


def failures_table(rows: Sequence[TrialRow], word: str) -> tuple[Table, ...]:
    """Count what failed first: in the twin by clause and cause, recorded by stage.

    Args:
        rows: Trials; only failures count.
        word: What the recorded side is called: stand-in, real or recorded.
    """
    twin = failure_taxonomy(
        (row.first_failing or "unknown", row.failing_cause or "", row.count)
        for row in rows
        if row.sim_planned is False
    )
    recorded = failure_taxonomy(
        (first_failed_stage(row), "", row.count) for row in rows if row.recorded is False
    )
    lines = [("sim planned", kind.clause, kind.cause, kind.count) for kind in twin]
    lines += [(word, kind.clause, kind.cause, kind.count) for kind in recorded]
    if not lines:
        return ()
    return (
        Table(
            id="failures",
            title="What failed first",
            columns=("side", "clause or stage", "cause", "trials"),
            rows=tuple(lines),
            note="In the twin: the first clause of the acceptance indicator that is false. "
            "Recorded: the first stage labelled a failure.",
        ),
    )


def divergence_table(rows: Sequence[TrialRow]) -> tuple[Table, ...]:
    """Count where planned, executed and recorded part first, by task, control step and cause.

    Args:
        rows: Trials; those whose executed motion was not compared are passed over.
    """
    counts: Counter[tuple[str, ...]] = Counter()
    for row in rows:
        if (diverged := row.divergence) is not None:
            step = diverged.stage or "outside the steps"
            key = diverged.attribution, diverged.quantity, diverged.body, diverged.between
            where = (row.task, step, *key)
            counts[where] += row.count
    if not counts:
        return ()
    lines = sorted(counts.items(), key=lambda item: (item[0][0], -item[1], item[0]))
    return (
        Table(
            id="divergences",
            title="Where planned, executed and recorded part first",
            columns=("task", "control step", "cause", "quantity", "body", "between", "trials"),
            rows=tuple((*where, count) for where, count in lines),
            note=f"Of {sum(row.executed_replay is not None for row in rows)} trials with an "
            f"executed replay {counts.total()} part, whatever their outcome. Only the first "
            "quantity beyond its limit is counted: what follows may come from it.",
        ),
    )


def first_failed_stage(row: TrialRow) -> str:
    """Name the first stage labelled a failure, or say that none was."""
    stages = stages_of(row)
    if not stages:
        return NOT_LABELLED
    return next((name for name, answer in stages if answer is False), NO_STAGE)
