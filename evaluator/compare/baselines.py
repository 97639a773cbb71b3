"""What a verdict is worth beside forecasts that need no twin, over the same trials.

Every one of them is asked of the plan that was sent: the base rate (always yes), the geometric
rule, and whatever else a row carries, such as the cell's own engine with nominal parameters.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from bridge.episode import schema, streams
from bridge.episode.reader import Episode
from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from evaluator.compare.gate import confusion_of, unheeded_verdict
from evaluator.compare.known_task import recorded_task
from evaluator.compare.labels import AFTER
from evaluator.compare.measure import ends, measured, proportion
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import Answer, names_of
from evaluator.measurements import (
    BASE_RATE,
    BASELINE_ACCURACY,
    BASELINE_GAIN,
    BASELINE_GAIN_OF_TASK,
    BASELINE_NPV,
    BASELINE_PPV,
)
from evaluator.metrics.geometric_rule import judge_by_geometry
from evaluator.result import Cell, Measurement, Table
from evaluator.statistics.differences import paired_points
from evaluator.statistics.gate import Confusion

TWIN = "twin"
ALWAYS_YES, GEOMETRIC_RULE = "always yes", "geometric rule"
ALL_TASKS = "all tasks"


@dataclass(frozen=True, kw_only=True)
class RuleSummary:
    """What the geometric rule says of the plan one trial sent."""

    episode: str
    value: bool | None
    detail: str


def apply_rule(
    recorded: Episode, localised: Episode | None, *, plan_id: str, task: Task | None = None
) -> RuleSummary | None:
    """Ask the geometric rule about the plan that was sent; None where there is nothing to ask."""
    task = recorded_task(recorded) if task is None else task
    plan = _plan(recorded, plan_id)
    if task is None or plan is None:
        return None
    answer = judge_by_geometry(plan, task, _poses_at_start(recorded, localised, plan_id))
    return RuleSummary(episode=recorded.info.id, value=answer.value, detail=answer.detail)


def with_rule(rows: Iterable[TrialRow], summaries: Sequence[RuleSummary]) -> list[TrialRow]:
    """Enter the rule's answers into the trials' rows; an open answer is left out."""
    answers = {rule.episode: rule.value for rule in summaries if rule.value is not None}
    return [
        replace(row, baselines=(*row.baselines, (GEOMETRIC_RULE, answers[row.episode])))
        if row.episode in answers
        else row
        for row in rows
    ]


def _plan(recorded: Episode, plan_id: str) -> Plan | None:
    found = (
        plan
        for message in recorded.messages(recorded.topics_of_type(schema.PLAN))
        if plan_id.encode() in message.data
        if (plan := Plan.from_json(message.data)).id == plan_id
    )
    return next(found, None)


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


def baseline_results(rows: Sequence[TrialRow]) -> tuple[list[Measurement], tuple[Table, ...]]:
    """Hold the twin's answers against every forecast without a twin, over the same trials.

    Nothing is found where no trial has both the twin's answer and an outcome.
    """
    names = list(dict.fromkeys(name for row in rows for name, _ in row.baselines))
    measurements: list[Measurement] = []
    lines: list[tuple[Cell, ...]] = []
    for by, words, answer_of in SIDES:
        known = [r for r in rows if answer_of(r) is not None and r.recorded is not None]
        if not known:
            continue
        counts = confusion_of(known, answer_of)
        lines += [
            (words, task, TWIN, *_shares(confusion_of(members, answer_of)), None, None, None)
            for task, members in _by_task(known).items()
        ]
        measurements.append(
            proportion(
                BASE_RATE.of(by=by, words=words),
                counts.succeeded,
                counts.n,
                counted="trial",
                reason_if_undefined="no trial",
                episodes=names_of(known),
            )
        )
        for name in (ALWAYS_YES, *names):
            forecast = _forecast(name)
            both = [row for row in known if forecast(row) is not None]
            measurements += _measure(by, words, name, both, answer_of)
            for task, members in _by_task(both).items():
                gain = _gain(by, words, name, task, members, answer_of)
                measurements.append(gain)
                shares = _shares(confusion_of(members, forecast))
                lines.append((words, task, name, *shares, gain.value, *ends(gain.interval)))
    return measurements, _table(lines)


def _forecast(name: str) -> Answer:
    if name == ALWAYS_YES:
        return lambda row: True
    return lambda row: dict(row.baselines).get(name)


def _by_task(rows: Sequence[TrialRow]) -> Mapping[str, Sequence[TrialRow]]:
    """Rows of all tasks, then of each where there are several."""
    tasks = sorted({row.task for row in rows})
    parts = {task: [row for row in rows if row.task == task] for task in tasks}
    return {ALL_TASKS: rows} | (parts if len(tasks) > 1 else {})


def _measure(
    by: str, words: str, name: str, rows: Sequence[TrialRow], answer_of: Answer
) -> list[Measurement]:
    counts = confusion_of(rows, _forecast(name))
    nothing = f"no trial has an outcome, {words} and the forecast of: {name}"
    return [
        proportion(
            quantity.of(by=by, baseline=name, words=words),
            k,
            n,
            counted="trial",
            reason_if_undefined=nothing if not counts.n else f"{name} never said {answer}",
            episodes=names_of(rows),
        )
        for quantity, k, n, answer in (
            (BASELINE_ACCURACY, counts.agreed, counts.n, ""),
            (BASELINE_PPV, counts.true_positive, counts.predicted_success, "yes"),
            (BASELINE_NPV, counts.true_negative, counts.predicted_failure, "no"),
        )
    ]


def _gain(
    by: str, words: str, name: str, task: str, rows: Sequence[TrialRow], answer_of: Answer
) -> Measurement:
    better, worse, n = _discordant(rows, answer_of, _forecast(name))
    quantity = BASELINE_GAIN if task == ALL_TASKS else BASELINE_GAIN_OF_TASK
    return measured(
        quantity.of(by=by, baseline=name, task=task, words=words),
        partial(paired_points, better, worse, n),
        n=n,
        counted="trial",
        episodes=names_of(rows),
    )


def _discordant(
    rows: Sequence[TrialRow], answer_of: Answer, forecast: Answer
) -> tuple[int, int, int]:
    """Trials that only the twin got right, that only the forecast got right, and all."""
    better = worse = 0
    for row in rows:
        twin, other = answer_of(row) == row.recorded, forecast(row) == row.recorded
        better += twin and not other
        worse += other and not twin
    return better, worse, len(rows)


def _shares(counts: Confusion) -> tuple[Cell, ...]:
    """Counts behind accuracy, PPV and NPV, and the outcomes."""
    return (
        *(counts.n, counts.succeeded, counts.agreed),
        *(counts.predicted_success, counts.true_positive),
        *(counts.predicted_failure, counts.true_negative),
    )


def _table(lines: Sequence[tuple[Cell, ...]]) -> tuple[Table, ...]:
    if not lines:
        return ()
    return (
        Table(
            id="gate_baselines",
            title="The twin beside forecasts that need no twin",
            columns=(
                *("asked of", "task", "forecast by", "trials", "succeeded", "right"),
                *("said yes", "yes and succeeded", "said no", "no and failed"),
                *("twin more right (pp)", "low", "high"),
            ),
            rows=tuple(lines),
            note="Trials in which the outcome, the twin's answer and the forecast are known. "
            "Always yes is right as often as trials succeed: the base rate. Geometric rule: each "
            "grasp encloses its object, which then moves with the hand, drops straight down where "
            "it is released and is where the task wants it; no physics, and no number that was "
            "fitted to outcomes. Cell's own engine: the planned replay in the engine that moves "
            "the stand-in cell (replay --engine both), from the same start. Differences are "
            "paired, with 95 % Tango intervals.",
        ),
    )
