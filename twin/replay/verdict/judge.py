"""The terminal factor of I(tau), what each predicate found, and the reason a verdict gives."""

from collections.abc import Iterable
from typing import Any

from bridge.task.predicate import (
    ALLOWED_CONTACTS,
    PredicateResult,
    Rollout,
    all_hold,
    already_true_at_start,
    evaluate_contacts,
    evaluate_success,
)
from bridge.task.task_file import Task
from bridge.task.verdict import Factor, Verdict
from twin.replay.config import ReplayConfig
from twin.replay.failure import Failure, factor_from
from twin.replay.follow.dynamics import Burst
from twin.replay.place.scene import ReplayScene
from twin.replay.verdict.result import ReplayResult

HELD_BEFORE = "the goal held before anything moved"
MANY = 8
"""Of more findings than this, those that hold are not worth reading one by one."""


def terminal_factor(
    result: ReplayResult,
    scene: ReplayScene,
    config: ReplayConfig,
    *,
    unreachable_ns: int | None,
    burst: Burst | None,
) -> Factor:
    """Judge the settled state at the end.

    A soft body that burst, or is turned inside out, makes it false whatever the task asks: the
    middle of a burst body may well lie in the basket.
    """
    if config.mode == "kinematic":
        return Factor(value=None, detail="a kinematic replay does not move objects")
    if burst is not None:
        detail = f"{burst.object_id}: {burst.found}"
        bodies = (burst.object_id,)
        failure = Failure(t_ns=burst.t_ns, cause="exploded", bodies=bodies, detail=detail)
        return factor_from([failure])
    if unreachable_ns is not None:
        detail = f"the trajectory cannot be executed beyond {unreachable_ns * 1e-9:.2f} s"
        return Factor(value=None, detail=detail)
    end_ns = int(result.stamps_ns[-1])
    for name, found in result.broken.items():
        failure = Failure(t_ns=end_ns, cause="shape", bodies=(name,), detail=f"{name} {found}")
        return factor_from([failure])
    findings = evaluate_success(scene.task, result.rollout())
    value = all_hold(findings)
    if value is True:
        return Factor(value=True, detail=_why_true(findings))
    if value is None:
        return Factor(value=None, detail=_why_open(findings, scene))
    index = next(i for i, finding in enumerate(findings) if finding.value is False)
    spec = scene.task.success[index]
    return Factor(
        value=False,
        first_t_ns=end_ns,
        cause=findings[index].kind,
        bodies=tuple(spec[key] for key in ("object", "container") if key in spec),
        detail=_once(finding.detail for finding in findings if finding.value is False),
    )


def _why_true(findings: list[PredicateResult]) -> str:
    if len(findings) > MANY:
        return "every object is where it belongs"
    return _once(finding.detail for finding in findings)


def _why_open(findings: list[PredicateResult], scene: ReplayScene) -> str:
    """What was not localised is said in the words of the clearance, which is open for it too."""
    if not findings:
        return "the task asks for nothing"
    lost = scene.missing()
    told = []
    for spec, finding in zip(scene.task.success, findings, strict=True):
        if spec.get("object") in lost or spec.get("container") in lost:
            told.append(scene.describe_missing())
        elif finding.value is None:
            told.append(finding.detail)
    return _once(told)


def _once(sentences: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(sentences))


def findings_of(task: Task, rollout: Rollout, side: str, *, tolerance_m: float = 0.0) -> list[Any]:
    """What each predicate says of a recorded or replayed rollout, as the verdict keeps it.

    The predicate on contacts is asked whether or not the task lists it.

    Args:
        task: Its predicates.
        rollout: Recorded or replayed states.
        side: ``recorded`` or ``replayed``.
        tolerance_m: Depth up to which contacts do not count, where the task does not say.
    """
    findings = evaluate_success(task, rollout)
    if not any(finding.kind == ALLOWED_CONTACTS for finding in findings):
        findings.append(evaluate_contacts(task, rollout, tolerance_m=tolerance_m))
    return [
        {
            "side": side,
            "kind": finding.kind,
            "object": finding.object_id,
            "value": finding.value,
            "detail": finding.detail,
        }
        for finding in findings
    ]


def warnings_of(scene: ReplayScene, result: ReplayResult) -> tuple[str, ...]:
    """What does not change the verdict but should be known."""
    warnings = []
    if already_true_at_start(scene.task, result.rollout()):
        warnings.append(HELD_BEFORE)
    return tuple(warnings)


def reason_of(verdict: Verdict) -> str | None:
    """One sentence: the first factor that fails, or what is open, or the first warning."""
    name = verdict.first_failing
    if name is not None:
        factor: Factor = getattr(verdict, name)
        return f"{name}: {factor.cause}: {factor.detail}"
    if verdict.accepted is None:
        names: dict[str | None, list[str]] = {}
        for name in ("ik", "clearance", "terminal"):
            factor = getattr(verdict, name)
            if factor.value is None:
                names.setdefault(factor.detail, []).append(name)
        undecided = [f"{' and '.join(open_for)}: {why}" for why, open_for in names.items()]
        return "undecided: " + "; ".join(undecided)
    return verdict.warnings[0] if verdict.warnings else None
