"""Where trials are lost: the stage funnel, kinds of failure."""

from collections import Counter
from collections.abc import Sequence

from evaluator.compare.measure import proportion
from evaluator.compare.rows import TrialRow
from evaluator.measurements import STAGE
from evaluator.result import Exclusion, Measurement, Table
from evaluator.statistics.funnel import funnel

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
    """Measure each stage of each task and condition."""
    groups: dict[tuple[str, str], list[Trial]] = {}
    for row in rows:
        stages = stages_of(row)
        if stages:
            groups.setdefault((row.task, row.condition), []).append((row, stages))
    measurements: list[Measurement] = []
    left_out: list[Exclusion] = []
    funnel_rows: list[tuple[str | int | None, ...]] = []
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
        measurements += [
            proportion(
                STAGE.of(task=task, condition=condition, stage=stage.name),
                stage.passed,
                stage.reached - stage.unknown,
                counted="trial",
                reason_if_undefined="no trial reached it, or none is labelled",
                episodes=episodes,
            )
            for stage in found
        ]
        words = condition.replace("_", " ")
        funnel_rows += [
            (task, words, s.name, s.reached, s.passed, s.unknown or None) for s in found
        ]
    table = Table(
        id="funnel",
        title="Stage funnel",
        columns=("task", "condition", "stage", "reached", "passed", "unknown"),
        rows=tuple(funnel_rows),
        note="Reached: every earlier stage succeeded. A stage after a failed one is not "
        "reached, even where it is labelled a success.",
    )
    return measurements, (table,) if funnel_rows else (), left_out


def failures_table(rows: Sequence[TrialRow], word: str) -> tuple[Table, ...]:
    """Count what failed first: in the twin by clause and cause, recorded by stage."""
    twin = Counter(
        ("sim planned", row.first_failing or "unknown", row.failing_cause or "")
        for row in rows
        if row.sim_planned is False
    )
    recorded = Counter((word, first_failed_stage(row), "") for row in rows if row.recorded is False)
    lines = [
        (*kind, count)
        for counts in (twin, recorded)
        for kind, count in sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    ]
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


def first_failed_stage(row: TrialRow) -> str:
    """Name the first stage labelled a failure, or say that none was."""
    stages = stages_of(row)
    if not stages:
        return NOT_LABELLED
    return next((name for name, answer in stages if answer is False), NO_STAGE)
