"""The operator's eye: an outcome from what really happened, by the task's hard predicates."""

from bridge.episode.metadata import Outcome
from bridge.sources.standin.cell import TruthLog
from bridge.task.predicate import all_hold, evaluate_success
from bridge.task.task_file import Task

OPERATOR = "stand-in operator"
LIFTED_M = 0.05
"""An object that rose this far at any time was grasped."""


def label_trial(task: Task, truth: TruthLog, *, executed: bool, remark: str = "") -> Outcome:
    """Say how a trial ended, as a person would from looking.

    Args:
        task: Its predicates decide.
        truth: True states of the whole trial.
        executed: Whether anything was executed.
        remark: Put in front of the detail.
    """
    rollout = truth.rollout()
    findings = evaluate_success(task, rollout)
    verdict = all_hold(findings)
    result = {True: "success", False: "failure", None: "unknown"}[verdict]
    detail = "; ".join(finding.detail for finding in findings)
    return Outcome(
        result=result,
        k=int(verdict is True),
        n=1,
        by=OPERATOR,
        detail=f"{remark}: {detail}" if remark else detail,
        stages=_stage_results(task, truth, result) if executed else (),
    )


def void_trial(reason: str) -> Outcome:
    """Outcome of a trial in which nothing was executed because nobody answered."""
    return Outcome(result="unknown", k=0, n=1, by=OPERATOR, detail=reason)


def _stage_results(task: Task, truth: TruthLog, result: str) -> tuple[dict[str, str], ...]:
    stages = []
    for stage in task.stages:
        if stage.get("grasp"):
            heights = [float(T[2, 3]) for T in truth.poses[stage["grasp"]]]
            lifted = max(heights) - heights[0] > LIFTED_M
            stages.append({"id": stage["id"], "result": "success" if lifted else "failure"})
        else:
            stages.append({"id": stage["id"], "result": result})
    return tuple(stages)
