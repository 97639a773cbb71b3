"""The terminal factor of I(tau), what each predicate found, and the reason a verdict gives."""

from typing import Any

from bridge.task.predicate import (
    ALLOWED_CONTACTS,
    Finding,
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
    if value is not False:
        return Factor(value=value, detail=_told(findings, several=len(findings) > 8))
    index = next(i for i, finding in enumerate(findings) if finding.value is False)
    spec = scene.task.success[index]
    return Factor(
        value=False,
        first_t_ns=end_ns,
        cause=findings[index].kind,
        bodies=tuple(spec[key] for key in ("object", "container") if key in spec),
        detail=_told(findings, several=len(findings) > 8),
    )


def _told(findings: list[Finding], *, several: bool) -> str:
    """All findings; of many, only what is wrong or open is worth reading."""
    told = [finding for finding in findings if not several or finding.value is not True]
    return "; ".join(finding.detail for finding in told) or "every object is where it belongs"


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
        undecided = [
            f"{name}: {getattr(verdict, name).detail}"
            for name in ("ik", "clearance", "terminal")
            if getattr(verdict, name).value is None
        ]
        return "undecided: " + "; ".join(undecided)
    return verdict.warnings[0] if verdict.warnings else None
