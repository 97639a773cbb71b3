"""Where trials are lost: the stage funnel, kinds of failure."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from evaluator.compare.measure import grouped, proportion
from evaluator.compare.rows import TrialRow
from evaluator.measurements import STAGE
from evaluator.result import Exclusion, Measurement, Table

NOT_LABELLED, NO_STAGE = "stage not labelled", "no stage, but the task"
"""Stand for the stage of a failure of which nobody named one."""


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


class StageCount(NamedTuple):
    """One stage of a task over all trials."""

    name: str
    reached: int
    """Trials in which every earlier stage succeeded."""
    passed: int
    """Of those, the trials in which this one succeeded too."""
    unknown: int
    """Of those, the trials in which nobody said how it ended; they go no further."""


def funnel(trials: Sequence[Sequence[bool | None]], names: Sequence[str]) -> list[StageCount]:
    """Count how far trials came, over stages in order.

    A stage after a failed one is not reached, even when it is labelled a success: a later success
    then rests on a person or on luck. Passed / (reached - unknown) is the stage's own rate.
    Of each trial ``trials`` has how each stage ended; None is unknown.
    """
    going, stages = list(trials), []
    for place, name in enumerate(names):
        answers = Counter(trial[place] for trial in going)
        stages.append(StageCount(name, len(going), answers[True], answers[None]))
        going = [trial for trial in going if trial[place]]
    return stages


def stage_results(
    rows: Sequence[TrialRow],
) -> tuple[list[Measurement], tuple[Table, ...], list[Exclusion]]:
    """Measure each stage of each task and condition."""
    staged = ((row, stages) for row in rows if (stages := stages_of(row)))
    groups = grouped(staged, lambda trial: (trial[0].task, trial[0].condition))
    measurements: list[Measurement] = []
    left_out: list[Exclusion] = []
    lines: list[tuple[str | int | None, ...]] = []
    for (task, condition), trials in groups.items():
        names = [name for name, _ in trials[0][1]]
        reason = f"its stages differ from those of {trials[0][0].episode}"
        differ = [row.episode for row, stages in trials if [name for name, _ in stages] != names]
        left_out += [Exclusion(episode=e, scope="stage funnel", reason=reason) for e in differ]
        alike = [trial for trial in trials if trial[0].episode not in differ]
        for stage in funnel([[answer for _, answer in stages] for _, stages in alike], names):
            lines.append((task, condition.replace("_", " "), *stage[:3], stage.unknown or None))
            measurements.append(
                proportion(
                    STAGE.of(task=task, condition=condition, stage=stage.name),
                    stage.passed,
                    stage.reached - stage.unknown,
                    reason_if_undefined="no trial reached it, or none is labelled",
                    episodes=[row.episode for row, _ in alike],
                )
            )
    table = Table(
        id="funnel",
        title="Stage funnel",
        columns=("task", "condition", "stage", "reached", "passed", "unknown"),
        rows=tuple(lines),
        note="Reached: every earlier stage succeeded. A stage after a failed one is not "
        "reached, even where it is labelled a success.",
    )
    return measurements, (table,) if lines else (), left_out


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
    note = "In the twin: the first clause of the acceptance indicator that is false. "
    note += "Recorded: the first stage labelled a failure."
    columns = ("side", "clause or stage", "cause", "trials")
    title = "What failed first"
    return (Table(id="failures", title=title, columns=columns, rows=tuple(lines), note=note),)


def first_failed_stage(row: TrialRow) -> str:
    """Name the first stage labelled a failure, or say that none was."""
    without = NO_STAGE if (stages := stages_of(row)) else NOT_LABELLED
    return next((name for name, answer in stages if answer is False), without)
