"""Where in a task the trials are lost: stage by stage, and over control steps."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from evaluator.errors import UndefinedStatisticError


@dataclass(frozen=True, kw_only=True)
class StageCount:
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

    Args:
        trials: How each stage ended, one sequence per trial; None is unknown.
        names: The stages, in order.

    Raises:
        UndefinedStatisticError: Without trials or stages.
        ValueError: When a trial has another number of stages.
    """
    if not trials or not names:
        raise UndefinedStatisticError(
            statistic="funnel", reason="there are no trials with labelled stages"
        )
    for trial in trials:
        if len(trial) != len(names):
            message = f"a trial has {len(trial)} stages, the task {len(names)}: {', '.join(names)}"
            raise ValueError(message)
    going, stages = list(trials), []
    for place, name in enumerate(names):
        answers = Counter(trial[place] for trial in going)
        stages.append(
            StageCount(name=name, reached=len(going), passed=answers[True], unknown=answers[None])
        )
        going = [trial for trial in going if trial[place]]
    return stages


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """How many units had succeeded up to a control step."""

    step: int
    done: int
    n: int


def success_curve(done_at: Sequence[int | None], num_steps: int) -> list[CurvePoint]:
    """Count successes up to each control step, 1 .. num_steps.

    Args:
        done_at: The control step at which each unit (trial or object) had succeeded for good, None
            where it never did.
        num_steps: Control steps of the task.

    Raises:
        UndefinedStatisticError: Without units or steps.
        ValueError: For a step outside 1 .. num_steps.
    """
    if not done_at or num_steps < 1:
        raise UndefinedStatisticError(
            statistic="success curve", reason="there are no units with known control steps"
        )
    if any(step is not None and not 1 <= step <= num_steps for step in done_at):
        message = f"a control step lies outside 1 .. {num_steps}"
        raise ValueError(message)
    return [
        CurvePoint(
            step=step,
            done=sum(at is not None and at <= step for at in done_at),
            n=len(done_at),
        )
        for step in range(1, num_steps + 1)
    ]


@dataclass(frozen=True, kw_only=True)
class FailureKind:
    """Trials that failed for the same reason."""

    clause: str
    cause: str
    count: int


def failure_taxonomy(failures: Iterable[tuple[str, str, int]]) -> list[FailureKind]:
    """Count failures (clause, cause, how many trials), most frequent first."""
    counts: Counter[tuple[str, str]] = Counter()
    for clause, cause, count in failures:
        counts[clause, cause] += count
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return [FailureKind(clause=clause, cause=cause, count=n) for (clause, cause), n in ordered]
