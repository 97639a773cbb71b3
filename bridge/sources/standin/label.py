"""The operator's eye: an outcome from what really happened, by the task's hard predicates."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.metadata import Outcome
from bridge.geometry import se3
from bridge.sources.standin.cell import TruthLog
from bridge.task.predicate import all_hold, evaluate_success, objects_done
from bridge.task.task_file import Task

OPERATOR = "stand-in operator"
LIFTED_M = 0.05
"""An object that rose this far at any time was grasped."""
RESULTS = {True: "success", False: "failure", None: "unknown"}


def label_trial(task: Task, truth: TruthLog, *, executed: bool, remark: str = "") -> Outcome:
    """Say how a trial ended, as a person would from looking.

    A task with several objects is counted by object: k of n are where they belong.

    Args:
        task: Its predicates decide.
        truth: True states of the whole trial.
        executed: Whether anything was executed.
        remark: Put in front of the detail.
    """
    rollout = truth.rollout()
    findings = evaluate_success(task, rollout)
    verdict = all_hold(findings)
    done = objects_done(findings, task.manipulated)
    several = len(task.manipulated) > 1
    # With several objects only what went wrong is worth reading.
    told = [item for item in findings if not several or item.value is not True]
    detail = "; ".join(finding.detail for finding in told) or "every object is where it belongs"
    return Outcome(
        result=RESULTS[verdict],
        unit="object" if several else "trial",
        k=sum(value is True for value in done.values()) if several else int(verdict is True),
        n=len(task.manipulated),
        by=OPERATOR,
        detail=f"{remark}: {detail}" if remark else detail,
        stages=_stage_results(task, truth, done, verdict) if executed else (),
    )


def void_trial(task: Task, reason: str) -> Outcome:
    """Outcome of a trial in which nothing was executed because nobody answered."""
    count = len(task.manipulated)
    unit = "object" if count > 1 else "trial"
    return Outcome(result="unknown", unit=unit, k=0, n=count, by=OPERATOR, detail=reason)


def _stage_results(
    task: Task, truth: TruthLog, done: Mapping[str, bool | None], verdict: bool | None
) -> tuple[dict[str, str], ...]:
    return tuple(
        {"id": stage["id"], "result": RESULTS[_stage_result(stage, task, truth, done, verdict)]}
        for stage in task.stages
    )


def _stage_result(
    stage: Mapping[str, Any],
    task: Task,
    truth: TruthLog,
    done: Mapping[str, bool | None],
    verdict: bool | None,
) -> bool | None:
    if stage.get("grasp"):
        heights = [float(T[2, 3]) for T in truth.poses[stage["grasp"]]]
        return max(heights) - heights[0] > LIFTED_M
    if stage.get("carry"):
        return any(_above(truth.poses[stage["carry"]], truth, task, key) for key in task.containers)
    return done[stage["release"]] if stage.get("release") else verdict


def _above(
    Ts_base_object: list[Float[np.ndarray, "4 4"]], truth: TruthLog, task: Task, container_id: str
) -> bool:
    """Whether an object was ever over a container's cavity, higher than its rim."""
    container = task.objects[container_id]
    half = np.array(container.inner_m[:2]) / 2
    T_container_base = se3.invert(truth.poses[container_id][0])
    p = se3.apply(T_container_base, np.array([T[:3, 3] for T in Ts_base_object]))
    over = np.all(np.abs(p[:, :2]) < half, axis=1) & (p[:, 2] > container.size_m[2])
    return bool(over.any())
