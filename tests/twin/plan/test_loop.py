"""Propose, have it judged, steer: deterministic, never the same twice, ends when it should."""

from dataclasses import replace

import numpy as np
import pytest
from scripted_plans import scene_of_test

from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.plan_request import Refusal
from bridge.task.verdict import Factor, Verdict
from twin.plan.loop.propose import NoPlanError, choose, plan_and_verify
from twin.plan.loop.steer import tried_in
from twin.plan.loop.straight import GeometricProposer
from twin.plan.problem import Problem
from twin.replay.config import ReplayConfig
from twin.replay.verdict import replay_plan
from twin.robot.model import load_robot

YES = Factor(value=True)


@pytest.fixture(scope="module")
def problem() -> Problem:
    scene = scene_of_test()
    robot = load_robot(scene.urdf)
    start = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
    return Problem(scene=replace(scene, start_rad=start), robot=robot, shapes={})


def said(plan: Plan, accepted: bool | None, cause: str = "exploded", **more: object) -> Verdict:
    return Verdict(
        plan_id=plan.id,
        trajectory="planned",
        mode="dynamic",
        ik=YES,
        clearance=YES,
        terminal=Factor(value=accepted, cause=cause, bodies=("cube",)),
        engine="test",
        seed=0,
        **more,  # type: ignore[arg-type]
    )


def chosen(problem: Problem, round_: int = 0, refused: tuple[Refusal, ...] = ()) -> Plan:
    return choose(
        GeometricProposer(),
        problem,
        plan_id="p",
        seed=3,
        round_=round_,
        refused=refused,
        most=5,
    ).plan


def test_the_same_question_has_the_same_answer_to_the_byte(problem: Problem) -> None:
    assert chosen(problem).to_json() == chosen(problem).to_json()
    refused = (Refusal(plan=chosen(problem), verdict=said(chosen(problem), False)),)
    assert chosen(problem, 1, refused).to_json() == chosen(problem, 1, refused).to_json()


def test_without_verdicts_candidates_go_by_rank(problem: Problem) -> None:
    plans = [chosen(problem, round_) for round_ in range(3)]
    assert [plan.candidate.rank for plan in plans if plan.candidate] == [0, 1, 2]
    costs = [plan.candidate.cost for plan in plans if plan.candidate]
    assert costs == sorted(costs)
    assert all(plan.steered_by is None for plan in plans)
    assert len({plan.tau for plan in plans}) == 3


def test_a_refused_grasp_is_not_made_again(problem: Problem) -> None:
    refused: list[Refusal] = []
    for round_ in range(4):
        plan = chosen(problem, round_, tuple(refused))
        (tried,) = tried_in(plan)
        for before in refused:
            (other,) = tried_in(before.plan)
            away_m = np.linalg.norm(tried.T_object_tcp[:3, 3] - other.T_object_tcp[:3, 3])
            turned = se3.rotation_angle_rad(
                tried.T_object_tcp[:3, :3].T @ other.T_object_tcp[:3, :3]
            )
            assert away_m > 0.01 or turned > np.radians(10)
        assert (plan.steered_by is not None) == bool(refused)
        refused.append(Refusal(plan=plan, verdict=said(plan, False)))


def test_a_grasp_moves_towards_where_a_finger_touched(problem: Problem) -> None:
    first = chosen(problem)
    seen = {"object": "cube", "touched": True, "held": False, "p_object_m": [0.0, 0.008, 0.01]}
    no = said(first, False, "inside", grasps=(seen,))
    second = chosen(problem, 1, (Refusal(plan=first, verdict=no),))
    assert second.steered_by is not None
    assert second.steered_by.clause == "terminal.inside"
    (before,), (after,) = tried_in(first), tried_in(second)
    moved = after.T_object_tcp[:2, 3] - before.T_object_tcp[:2, 3]
    np.testing.assert_allclose(moved, [0.0, 0.008], atol=1e-6)


def test_the_loop_ends_at_the_first_yes_or_unknown_or_when_rounds_are_used_up(
    problem: Problem,
) -> None:
    def attempts(answers: list[bool | None], rounds: int = 5) -> list[bool | None]:
        left = iter(answers)
        made = plan_and_verify(
            GeometricProposer(),
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


def test_an_object_that_was_not_found_ends_with_its_name(problem: Problem) -> None:
    lost = replace(problem, scene=scene_of_test(missing=("cube",)))
    with pytest.raises(NoPlanError, match="cube of task cube_into_box was not localised"):
        chosen(lost)


@pytest.mark.slow
def test_the_first_candidate_does_the_task_in_the_twin(problem: Problem) -> None:
    config = ReplayConfig()
    verdict = replay_plan(chosen(problem), problem.scene, config, refuse_early=True).verdict
    assert verdict.accepted is True, verdict.reason
    assert verdict.grasps[0]["held"] is True
    aside = chosen(problem)
    shifted = tuple(
        replace(each, p_m=(each.p_m[0] + 0.06, each.p_m[1], each.p_m[2]), joints_rad=None)
        for each in aside.tau
    )
    missed = replay_plan(
        replace(aside, tau=shifted), replace(problem.scene, start_rad=None), config
    )
    assert missed.verdict.grasps[0]["held"] is False
