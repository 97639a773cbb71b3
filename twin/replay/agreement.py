"""Whether the engines agree: one trajectory replayed in each, and their verdicts side by side."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from twin.replay.config import ReplayConfig

WORDS = {True: "accepted", False: "rejected", None: "undecided"}
_DISAGREE = "engines disagree: "


def in_each_engine(
    task: Task, config: ReplayConfig, judge: Callable[[ReplayConfig], Verdict]
) -> list[Verdict]:
    """Judge in each engine asked for, the deciding one first; each says where another differs."""
    config.refuse_soft(task.soft_objects)  # UsageError: an engine that has none
    if config.mode == "kinematic" or config.engine != "both":
        return [judge(config)]
    return compared([judge(replace(config, engine=engine)) for engine in config.engines()])


def compared(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Say in each verdict on one trajectory where another engine's says something else."""
    if len({verdict.accepted for verdict in verdicts}) == 1:
        return list(verdicts)
    answers = _DISAGREE + "; ".join(
        f"{verdict.engine} {WORDS[verdict.accepted]}"
        + (f" ({verdict.reason})" if verdict.reason and not verdict.accepted else "")
        for verdict in verdicts
    )
    return [
        replace(verdict, warnings=(*verdict.warnings, answers), reason=verdict.reason or answers)
        for verdict in verdicts
    ]


def disagreement_of(verdict: Verdict) -> str | None:
    """What each engine says, where they say something else; None where they agree."""
    return next((text for text in verdict.warnings if text.startswith(_DISAGREE)), None)
