"""The loop: propose, have it judged, steer, propose again; nothing of it looks at a clock."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Protocol, runtime_checkable

from bridge.task.plan import Plan
from bridge.task.plan_request import Refusal
from bridge.task.verdict import Verdict
from twin.plan.loop.steer import Steer, steer_by
from twin.plan.problem import NoPlanError, Problem
from twin.replay.scene import ReplayScene


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One plan that a proposer offers."""

    plan: Plan
    rank: int
    cost: float
    remarks: tuple[str, ...] = ()


@runtime_checkable
class Proposer(Protocol):
    """Makes plans for a problem."""

    def propose(
        self, problem: Problem, *, plan_id: str, seed: int, steer: Steer | None
    ) -> Iterator[Candidate]:
        """Offer plans, the best first; the same arguments give the same plans."""


def refuse_lost(scene: ReplayScene) -> None:
    """Refuse to plan around objects that nobody knows the place of."""
    if lost := scene.missing():
        reasons = [f"{name}: {scene.reasons[name]}" for name in lost if name in scene.reasons]
        why = f" ({'; '.join(reasons)})" if reasons else ""
        raise NoPlanError(
            f"{', '.join(lost)} of task {scene.task.name} was not localised{why}. Show it to the "
            "cameras and look again."
        )


def choose(
    proposer: Proposer,
    problem: Problem,
    *,
    plan_id: str,
    seed: int,
    round_: int,
    refused: Sequence[Refusal],
    most: int,
) -> Candidate:
    """Return the candidate of a round: by rank, or steered by what was refused."""
    if not refused:
        offers = proposer.propose(problem, plan_id=plan_id, seed=seed, steer=None)
        ranked = list(islice(offers, round_ + 1))
        if round_ >= len(ranked):
            raise NoPlanError(
                f"there are {len(ranked)} candidates, and {round_} were tried. Ask for fewer "
                "rounds, or begin from another start."
            )
        return ranked[round_]
    steer = steer_by(refused, problem)
    known = [refusal.plan.tau for refusal in refused]
    for by, count in ((steer, most), (None, most + len(refused))):
        with suppress(NoPlanError):
            offers = proposer.propose(problem, plan_id=plan_id, seed=seed, steer=by)
            fresh = next((one for one in islice(offers, count) if one.plan.tau not in known), None)
            if fresh is not None and by is None:
                remark = f"nothing else answers {steer.clause}: the next by rank"
                return replace(fresh, remarks=(*fresh.remarks, remark))
            if fresh is not None:
                return fresh
    raise NoPlanError(
        f"every candidate was refused, the last by {steer.clause}. Begin from another start."
    )


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One candidate and what was said of it."""

    candidate: Candidate
    verdict: Verdict


def plan_and_verify(
    proposer: Proposer,
    problem: Problem,
    judge: Callable[[Plan], Verdict],
    *,
    plan_id: str,
    seed: int,
    rounds: int,
    refused: Sequence[Refusal] = (),
    task_sha256: str = "",
    grounding_source: str = "",
) -> list[Attempt]:
    """Propose and have judged until one is accepted; the last attempt is the one that counts.

    Ends at the first yes, at the first verdict that is neither yes nor no, when no candidate is
    left, or after so many rounds.
    """
    attempts: list[Attempt] = []
    for round_ in range(rounds):
        try:
            candidate = choose(
                proposer,
                problem,
                plan_id=plan_id,
                seed=seed,
                round_=round_,
                refused=refused,
                most=rounds,
            )
        except NoPlanError:
            if not attempts:
                raise
            break
        parent = attempts[-1].candidate.plan.id if attempts else None
        plan = replace(
            candidate.plan,
            id=f"{plan_id}.{round_}",
            parent_id=parent,
            round=round_,
            task_sha256=task_sha256,
            grounding_source=grounding_source,
        )
        candidate = replace(candidate, plan=plan)
        verdict = judge(plan)
        attempts.append(Attempt(candidate=candidate, verdict=verdict))
        if verdict.accepted is not False:
            break
        refused = (*refused, Refusal(plan=plan, verdict=verdict))
    return attempts
