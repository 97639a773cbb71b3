"""Whether the engines agree: one trajectory replayed in each, and their verdicts side by side."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from bridge.task.task_file import Task
from bridge.task.verdict import Factor, Verdict
from twin.replay.config import ReplayConfig

_WORDS = {True: "accepted", False: "rejected", None: "undecided"}
_DISAGREE = "engines disagree: "


def in_each_engine(
    task: Task, config: ReplayConfig, judge: Callable[[ReplayConfig], Verdict]
) -> list[Verdict]:
    """Judge in each engine that is asked for; each verdict says where another one differs.

    Args:
        task: What is replayed.
        config: Which engines, and whether they must agree.
        judge: Replays with settings that name one engine.

    Returns:
        Verdicts in the order of ``config.engines()``: the first decides.

    Raises:
        UsageError: For soft objects in an engine that has none.
    """
    config.refuse_soft(task.soft_objects)
    if config.mode == "kinematic" or config.engine != "both":
        return [judge(config)]
    alone = replace(config, engines_must_agree=False)
    verdicts = [judge(replace(alone, engine=engine)) for engine in config.engines()]
    return compared(verdicts, must_agree=config.engines_must_agree)


def compared(verdicts: Sequence[Verdict], *, must_agree: bool) -> list[Verdict]:
    """Say in each verdict where the other engines say something else.

    Args:
        verdicts: On one trajectory, of different engines.
        must_agree: A disagreement leaves all of them undecided.
    """
    if must_agree:
        names = " and ".join(verdict.engine for verdict in verdicts)
        named = [replace(verdict, engine=names) for verdict in verdicts]
    else:
        named = list(verdicts)
    if len({verdict.accepted for verdict in verdicts}) == 1:
        return named
    answers = _DISAGREE + "; ".join(_saying(verdict) for verdict in verdicts)
    if must_agree:
        named = [_undecided(verdict, verdicts, answers) for verdict in named]
    return [
        replace(verdict, warnings=(*verdict.warnings, answers), reason=verdict.reason or answers)
        for verdict in named
    ]


def disagreement_of(verdict: Verdict) -> str | None:
    """What each engine says, where they say something else; None where they agree."""
    return next((text for text in verdict.warnings if text.startswith(_DISAGREE)), None)


def _saying(verdict: Verdict) -> str:
    why = f" ({verdict.reason})" if verdict.reason and not verdict.accepted else ""
    return f"{verdict.engine} {_WORDS[verdict.accepted]}{why}"


def _undecided(verdict: Verdict, verdicts: Sequence[Verdict], answers: str) -> Verdict:
    """Leave open the factors and checks on which the engines differ."""
    opened = Factor(value=None, detail=answers)
    found = [other.factors() for other in verdicts]
    names = [
        name
        for name in verdict.factors()
        if len({each[name].value if name in each else None for each in found}) > 1
    ]
    factors = {name: opened for name in names if name not in verdict.checks}
    checks = {name: opened for name in names if name in verdict.checks}
    return replace(
        verdict,
        **factors,  # type: ignore[arg-type]
        checks={**verdict.checks, **checks},
        reason=f"undecided: {' and '.join(names)}: {answers}",
    )
