"""Where in a task the trials are lost: stage by stage."""

from collections import Counter
from collections.abc import Sequence
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
