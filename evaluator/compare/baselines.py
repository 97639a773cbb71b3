"""What a verdict is worth beside forecasts that need no twin, over the same trials.

Every one of them is asked of the plan that was sent: the base rate (always yes), the geometric
rule, and whatever else a row carries.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from evaluator.compare.gate import known_to, unheeded_verdict
from evaluator.compare.measure import measured, proportion
from evaluator.compare.rows import TrialRow
from evaluator.compare.states import AFTER, sent_plan
from evaluator.compare.success import Answer, answered, names_of
from evaluator.measurements import BASE_RATE, BASELINE_ACCURACY, BASELINE_GAIN
from evaluator.metrics.geometric_rule import judge_by_geometry
from evaluator.result import Measurement
from evaluator.statistics.differences import paired_points

GEOMETRIC_RULE = "geometric rule"


@dataclass(frozen=True, kw_only=True)
class RuleSummary:
    """What the geometric rule says of the plan one trial sent."""

    episode: str
    value: bool | None


def apply_rule(
    recorded: Episode, localised: Episode | None, *, plan_id: str, task: Task | None
) -> RuleSummary | None:
    """Ask the geometric rule about the plan that was sent; None where there is nothing to ask."""
    plan = sent_plan(recorded, plan_id, Plan.from_json)
    if task is None or plan is None:
        return None
    answer = judge_by_geometry(plan, task, _poses_at_start(recorded, localised, plan_id))
    return RuleSummary(episode=recorded.info.id, value=answer.value)


def with_rule(rows: Iterable[TrialRow], summaries: Sequence[RuleSummary]) -> list[TrialRow]:
    """Enter the rule's answers into the trials' rows; an open answer is left out."""
    answers = {rule.episode: rule.value for rule in summaries if rule.value is not None}
    return [
        replace(row, baselines=(*row.baselines, (GEOMETRIC_RULE, answers[row.episode])))
        if row.episode in answers
        else row
        for row in rows
    ]


def _poses_at_start(
    recorded: Episode, localised: Episode | None, plan_id: str
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """The last pose of each object found before the execution."""
    poses: dict[str, Float[np.ndarray, "4 4"]] = {}
    for record in streams.localisations(recorded if localised is None else localised):
        if (record.get("phase"), record.get("plan_id")) == (AFTER, plan_id):
            break
        pose = record.get("T_base_object")
        if record["found"] and pose is not None:
            poses[str(record["object"])] = se3.pose_from_record(pose)
    return poses


SIDES: tuple[tuple[str, str, Answer], ...] = (
    ("sim_planned", "planned in twin", lambda row: row.sim_planned),
    ("verdict_unheeded", "verdict before motion, not obeyed", unheeded_verdict),
)
"""Whose answers are held against forecasts without a twin."""


def baseline_results(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Hold the twin's answers against every forecast without a twin, over the same trials.

    Nothing is found where no trial has both the twin's answer and an outcome.
    """
    names = dict.fromkeys(name for row in rows for name, _ in row.baselines)
    found: list[Measurement] = []
    for by, words, answer_of in SIDES:
        known = known_to(rows, answer_of)
        if not known:
            continue
        found.append(
            answered(
                BASE_RATE.of(by=by, words=words),
                known,
                lambda row: row.recorded,
                reason_if_undefined="no trial",
            )
        )
        for name in names:
            forecasts = [(row, dict(row.baselines).get(name)) for row in known]
            both = [(row, answer) for row, answer in forecasts if answer is not None]
            found += _beside(by, words, name, both, answer_of)
    return found


def _beside(
    by: str, words: str, name: str, both: Sequence[tuple[TrialRow, bool]], answer_of: Answer
) -> list[Measurement]:
    """Measure how often one forecast is right, and how much more often the twin is."""
    right = Counter((answer_of(r) == r.recorded, other == r.recorded) for r, other in both)
    parts = {"by": by, "baseline": name, "words": words}
    episodes = names_of(row for row, _ in both)
    return [
        proportion(
            BASELINE_ACCURACY.of(**parts),
            right[True, True] + right[False, True],
            len(both),
            reason_if_undefined=f"no trial has an outcome, {words} and the forecast of: {name}",
            episodes=episodes,
        ),
        measured(
            BASELINE_GAIN.of(**parts),
            partial(paired_points, right[True, False], right[False, True], len(both)),
            n=len(both),
            counted="trial",
            episodes=episodes,
        ),
    ]
