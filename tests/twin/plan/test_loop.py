"""Propose, have it judged, steer: deterministic, never the same twice, ends when it should."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from planned_start import problem_of_test
from scripted_plans import pick_and_place, scene_of_test
from verdicts import verdict_of

from bridge.geometry import se3
from bridge.task.plan import Plan, Ranking, SteeredBy
from bridge.task.plan_request import Refusal
from bridge.task.verdict import Factor, Verdict
from twin.plan.loop.nominal import PlanProposer
from twin.plan.loop.propose import Candidate, choose, plan_and_verify
from twin.plan.loop.steer import Steer, steer_by, tried_in
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


PROBLEM = problem_of_test()


def verdict(name: str, cause: str, *bodies: str, grasps: tuple[dict, ...] = ()) -> Verdict:
    no = Factor(value=False, cause=cause, bodies=bodies)
    three = dict.fromkeys(("ik", "clearance", "terminal"), YES)
    checks = {"start": YES, "task": YES, "limits": YES, "audit": YES}
    (three if name in three else checks)[name] = no
    return verdict_of(checks=checks, grasps=grasps, **three)


HELD, SLID = (({"object": "cube", "held": held},) for held in (True, False))


@pytest.mark.parametrize(
    ("refusal", "change", "object_id"),
    [
        (
            verdict("clearance", "pre_grasp_penetration", "gripper_left_finger", "cube"),
            "grasp",
            "cube",
        ),
        (verdict("clearance", "deep_contact", "cube", "gripper_left_finger"), "grasp", "cube"),
        (verdict("clearance", "too_close", "cube", "box"), "release", "cube"),
        (verdict("clearance", "collision", "forearm_link", "box"), "path", None),
        (verdict("clearance", "collision", "gripper_left_finger", "box"), "path", None),
        (verdict("audit", "collision", "cube", "table"), "path", "cube"),
        (verdict("terminal", "inside", "cube", "box", grasps=HELD), "release", "cube"),
        (verdict("terminal", "inside", "cube", "box", grasps=SLID), "grasp", "cube"),
        (verdict("terminal", "inside", "cube", "box"), "release", "cube"),
        (verdict("terminal", "exploded", "cube"), "grasp", "cube"),
        (verdict("terminal", "allowed_contacts", "cube"), "path", "cube"),
        (verdict("ik", "unreachable"), "grasp", None),
        (verdict("ik", "self_collision", "forearm_link", "wrist_3_link"), "grasp", None),
        (verdict("ik", "joint_speed"), "slower", None),
        (verdict("limits", "tool_speed"), "slower", None),
        (verdict("start", "start_elsewhere", "elbow_joint"), "any", None),
    ],
)
def test_the_failing_clause_chooses_the_change(
    refusal: Verdict, change: str, object_id: str | None
) -> None:
    plan = pick_and_place(scene_of_test())
    steer = steer_by([Refusal(plan=plan, verdict=refusal)], PROBLEM)
    assert (steer.change, steer.object_id) == (change, object_id)
    name = refusal.first_failing
    assert name is not None
    assert steer.clause == f"{name}.{refusal.factors()[name].cause}"
    assert steer.bodies == refusal.factors()[name].bodies


def test_what_was_tried_is_read_from_the_plan_in_the_objects_frame() -> None:
    scene = scene_of_test()
    entities = {name: se3.pose_record(T) for name, T in scene.Ts_base_object.items()}
    plan = replace(pick_and_place(scene, grasp_offset_m=(0.0, 0.0, 0.01)), entities=entities)
    (tried,) = tried_in(plan)
    assert tried.object_id == "cube"
    np.testing.assert_allclose(tried.T_object_tcp[:3, 3], [0.0, 0.0, 0.01], atol=1e-9)
    assert tried.T_base_release is not None
    np.testing.assert_allclose(tried.T_base_release[:3, 3], [0.5, 0.19, 0.12], atol=1e-9)


@pytest.mark.parametrize(
    ("shift_m", "turn_deg", "same"),
    [(0.0, 0, True), (0.009, 9, True), (0.011, 0, False), (0, 11, False)],
)
def test_grasps_within_a_centimetre_and_ten_degrees_are_one(
    shift_m: float, turn_deg: float, same: bool
) -> None:
    scene = scene_of_test()
    entities = {name: se3.pose_record(T) for name, T in scene.Ts_base_object.items()}
    plan = replace(pick_and_place(scene), entities=entities)
    no = verdict("terminal", "exploded", "cube")
    steer = steer_by([Refusal(plan=plan, verdict=no)], PROBLEM)
    T = tried_in(plan)[0].T_object_tcp.copy()
    half = np.radians(turn_deg) / 2
    R = se3.rotation_from_quaternion(np.array([np.cos(half), 0, 0, np.sin(half)]))
    T[:3, :3] = R @ T[:3, :3]
    T[0, 3] += shift_m
    assert steer.has_grasp_like("cube", T) is same
    assert steer.has_grasp_like("box", T) is False


def test_the_measured_miss_is_what_brings_an_object_from_where_it_was_let_go_to_its_end() -> None:
    """By 3 mm along the object's x and 20 degrees; the fall does not count, only as it was held."""
    scene = scene_of_test()
    entities = {name: se3.pose_record(T) for name, T in scene.Ts_base_object.items()}
    plan = replace(pick_and_place(scene), entities=entities)
    (tried,) = tried_in(plan)
    T_meant = tried.T_base_object
    assert T_meant is not None
    half = np.radians(20.0) / 2
    T_ended = T_meant @ se3.transform_from(
        np.array([np.cos(half), 0, 0, np.sin(half)]), np.array([0.003, 0.0, 0.0])
    )
    T_ended[2, 3] -= 0.1

    def steered(T: np.ndarray, *, held: bool = True) -> Steer:
        seen = {"object": "cube", "held": held, "T_base_object": se3.pose_record(T)}
        no = verdict("terminal", "inside", "cube", "box", grasps=(seen,))
        return steer_by([Refusal(plan=plan, verdict=no)], PROBLEM)

    miss = steered(T_ended).miss
    assert miss is not None
    np.testing.assert_allclose(miss.shift_m, [0.003, 0.0, 0.0], atol=1e-9)
    assert miss.turn_rad == pytest.approx(np.radians(20.0))
    mended = miss.applied(miss.undone(T_meant)[None])[0]
    np.testing.assert_allclose(mended, T_meant, atol=1e-12)
    T_ended[0, 3] += 0.1
    assert steered(T_ended).miss is None, "it fell elsewhere"
    assert steered(T_meant, held=False).miss is None
