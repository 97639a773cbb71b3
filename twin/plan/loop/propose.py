"""The loop: propose, have it judged, steer, propose again; nothing of it looks at a clock."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from bridge.task.plan import Plan, Ranking, SteeredBy
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
        self, problem: Problem, *, plan_id: str, seed: int, count: int, steer: Steer | None
    ) -> list[Candidate]:
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
        ranked = proposer.propose(problem, plan_id=plan_id, seed=seed, count=round_ + 1, steer=None)
        if round_ >= len(ranked):
            raise NoPlanError(
                f"there are {len(ranked)} candidates, and {round_} were tried. Ask for fewer "
                "rounds, or begin from another start."
            )
        return named(ranked[round_], problem, seed=seed)
    steer = steer_by(refused, problem)
    known = [refusal.plan.tau for refusal in refused]

    def fresh_of(steer: Steer | None, counts: Sequence[int]) -> Candidate | None:
        """The first that was not refused; plans take time, so few are asked for at first."""
        for count in counts:
            try:
                found = proposer.propose(
                    problem, plan_id=plan_id, seed=seed, count=count, steer=steer
                )
            except NoPlanError:
                return None
            if fresh := next((each for each in found if each.plan.tau not in known), None):
                return fresh
        return None

    if fresh := fresh_of(steer, (1, most)):
        return named(fresh, problem, seed=seed, steer=steer)
    if fresh := fresh_of(None, (len(refused) + 1, most + len(refused))):
        remark = f"nothing else answers {steer.clause}: the next by rank"
        return named(replace(fresh, remarks=(*fresh.remarks, remark)), problem, seed=seed)
    raise NoPlanError(
        f"every candidate was refused, the last by {steer.clause}. Begin from another start."
    )


def named(
    candidate: Candidate, problem: Problem, *, seed: int, steer: Steer | None = None
) -> Candidate:
    """Write into a plan which candidate it is, what steered it and in which scene it was made."""
    by = None if steer is None else SteeredBy(clause=steer.clause, bodies=steer.bodies)
    plan = replace(
        candidate.plan,
        candidate=Ranking(rank=candidate.rank, cost=candidate.cost, seed=seed),
        steered_by=by,
        scene_hash=problem.scene.scene_hash,
    )
    return replace(candidate, plan=plan)


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
