"""Propose, have it judged, steer: deterministic, never the same twice, ends when it should."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
from planned_start import problem_of_test
from scripted_plans import pick_and_place
from verdicts import verdict_of

from bridge.geometry import se3
from bridge.task.plan import Plan, Ranking, SteeredBy
from bridge.task.plan_request import Refusal
from bridge.task.verdict import Factor, Verdict
from twin.plan.loop.nominal import PlanProposer
from twin.plan.loop.propose import Candidate, choose, plan_and_verify
from twin.plan.loop.steer import Steer, tried_in
from twin.plan.problem import Problem
from twin.plan.stage.solver import alike
from twin.replay.scene import ReplayScene

YES = Factor(value=True)


class Listed:
    """Offers hand-written plans whose grasps are 2 cm apart; grasps that were refused never."""

    def __init__(self, scene: ReplayScene, count: int = 6) -> None:
        """Write them."""
        entities = {name: se3.pose_record(T) for name, T in scene.Ts_base_object.items()}
        offsets = [(0.0, 0.0, 0.02 * number) for number in range(count)]
        made = [pick_and_place(scene, grasp_offset_m=offset) for offset in offsets]
        self.plans = [replace(plan, entities=entities) for plan in made]

    def propose(
        self, problem: Problem, *, plan_id: str, seed: int, steer: Steer | None
    ) -> Iterator[Candidate]:
        fresh = [
            plan
            for plan in self.plans
            if steer is None or not steer.has_grasp_like("cube", tried_in(plan)[0].T_object_tcp)
        ]
        by = steer and SteeredBy(clause=steer.clause, bodies=steer.bodies)
        for k, plan in enumerate(fresh):
            ranking = Ranking(rank=k, cost=0.1 * k, seed=seed)
            named = replace(plan, candidate=ranking, steered_by=by)
            yield Candidate(plan=named, rank=k, cost=0.1 * k)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of_test()


@pytest.fixture(scope="module")
def listed(problem: Problem) -> Listed:
    return Listed(problem.scene)


def said(plan: Plan, accepted: bool | None, cause: str = "exploded", **more: object) -> Verdict:
    terminal = Factor(value=accepted, cause=cause, bodies=("cube",))
    return verdict_of(plan.id, terminal=terminal, **more)


def chosen(
    proposer: Listed | PlanProposer,
    problem: Problem,
    round_: int = 0,
    refused: tuple[Refusal, ...] = (),
) -> Plan:
    return choose(
        proposer, problem, plan_id="p", seed=3, round_=round_, refused=refused, most=5
    ).plan


def test_without_verdicts_candidates_go_by_rank(problem: Problem, listed: Listed) -> None:
    plans = [chosen(listed, problem, round_) for round_ in range(3)]
    assert [plan.candidate.rank for plan in plans if plan.candidate] == [0, 1, 2]
    assert all(plan.steered_by is None for plan in plans)
    assert [plan.tau for plan in plans] == [plan.tau for plan in listed.plans[:3]]


def test_what_was_refused_is_not_offered_again(problem: Problem, listed: Listed) -> None:
    refused: list[Refusal] = []
    for round_ in range(4):
        plan = chosen(listed, problem, round_, tuple(refused))
        assert plan.tau == listed.plans[round_].tau
        assert (plan.steered_by is not None) == bool(refused)
        refused.append(Refusal(plan=plan, verdict=said(plan, False)))


def test_a_grasp_that_slipped_is_followed_by_another(problem: Problem) -> None:
    planner = PlanProposer()
    first = chosen(planner, problem)
    no = said(first, False, "inside", grasps=({"object": "cube", "held": False},))
    second = chosen(planner, problem, 1, (Refusal(plan=first, verdict=no),))
    (before,), (after,) = tried_in(first), tried_in(second)
    assert not alike(before.T_object_tcp[None], after.T_object_tcp)[0]


def test_the_loop_ends_at_the_first_yes_or_unknown_or_when_rounds_are_used_up(
    problem: Problem, listed: Listed
) -> None:
    def attempts(answers: list[bool | None], rounds: int = 5) -> list[bool | None]:
        left = iter(answers)
        made = plan_and_verify(
            listed,
            problem,
            lambda plan: said(plan, next(left)),
            plan_id="p",
            seed=3,
            rounds=rounds,
        )
        ids = [each.candidate.plan.id for each in made]
        assert [each.candidate.plan.parent_id for each in made] == [None, *ids[:-1]]
        return [each.verdict.accepted for each in made]

    assert attempts([True]) == [True]
    assert attempts([False, None, True]) == [False, None]
    assert attempts([False] * 3, rounds=3) == [False] * 3
