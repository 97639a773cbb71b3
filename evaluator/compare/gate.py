"""Trial by trial: does what the twin said agree with what happened?"""

from collections.abc import Iterable, Sequence

from bridge.episode.metadata import CONTROL
from evaluator.compare.measure import grouped, measured
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import WITH, WITHOUT, Answer, answered, names_of
from evaluator.measurements import AGREED, NPV, PHI, PPV
from evaluator.result import Measurement
from evaluator.statistics.gate import Confusion, phi


def unheeded_verdict(row: TrialRow) -> bool | None:
    """The gate's verdict where it decided nothing: a refused plan was executed all the same.

    Only these trials can show a false refusal, and only they are not selected by the gate.
    """
    return row.verdict if row.condition in (WITHOUT, CONTROL) else None


def heeded_verdict(row: TrialRow) -> bool | None:
    """The gate's verdict where it selected the plan: refused plans were never executed."""
    return row.verdict if row.condition == WITH else None


def known_to(rows: Sequence[TrialRow], answer_of: Answer) -> list[TrialRow]:
    """Return the trials with an answer and an outcome."""
    return [row for row in rows if answer_of(row) is not None and row.recorded is not None]


def confusion_of(rows: Sequence[TrialRow], answer_of: Answer) -> Confusion:
    """Count what was said against what was labelled, over trials where both are known."""
    return Confusion.of((bool(answer_of(r)), bool(r.recorded)) for r in known_to(rows, answer_of))


def agreement(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Measure k/n agreement, phi and predictive values, of the replay and of the verdict."""
    sides: list[tuple[str, Answer, str]] = [
        ("sim_planned", lambda row: row.sim_planned, "planned-in-twin (dynamic, of the sent plan)"),
        ("verdict", lambda row: row.verdict, "the verdict before motion"),
        ("sim_executed", lambda row: row.sim_executed, "executed-in-twin (diagnosis only)"),
    ]
    told = "the verdict before motion, recorded and not obeyed (without replanning)"
    twice = "another trial of the same policy from the same start"
    rare = [("verdict_unheeded", unheeded_verdict, told), ("repeated", repeated(rows), twice)]
    sides += [side for side in rare if any(side[1](row) is not None for row in rows)]
    return [measurement for side in sides for measurement in _agreement_of(rows, *side)]


def repeated(rows: Iterable[TrialRow]) -> Answer:
    """How the trial ended that was a start's first of two: no twin knows more of the second."""
    starts = grouped(
        (row for row in rows if row.start_id and row.recorded is not None),
        lambda row: (row.cell, row.task, row.condition, row.policy, row.start_id),
    )
    twos = (two for each in starts.values() for two in zip(each[::2], each[1::2], strict=False))
    ends = {id(second): first.recorded for first, second in twos}
    return lambda row: ends.get(id(row))


def _agreement_of(
    rows: Sequence[TrialRow], name: str, answer_of: Answer, words: str
) -> list[Measurement]:
    seen = known_to(rows, answer_of)
    counts = confusion_of(seen, answer_of)
    nothing = f"no trial has both {words} and a known outcome"

    def right(row: TrialRow) -> bool:
        return answer_of(row) == row.recorded

    predictive = (
        answered(
            quantity.of(by=name, words=words),
            [row for row in seen if answer_of(row) == answer],
            right,
            reason_if_undefined=f"it never predicted {word}" if seen else nothing,
        )
        for quantity, answer, word in ((PPV, True, "success"), (NPV, False, "failure"))
    )
    coefficient = measured(
        PHI.of(by=name, words=words),
        lambda: phi(counts),
        n=counts.n,
        counted="trial",
        episodes=names_of(seen),
        reason_without_interval="the four counts are beside it",
    )
    share = answered(AGREED.of(by=name, words=words), seen, right, reason_if_undefined=nothing)
    return [share, coefficient, *predictive]
