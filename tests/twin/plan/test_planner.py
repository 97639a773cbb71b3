"""The planner: policies, candidates, steering, and what ``plan RUN`` leaves in a run."""

import json
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from planned_start import CUBE as FILE
from planned_start import HOME, problem_of_test, write_episode
from verdicts import verdict_of

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.task.plan import Plan
from bridge.task.plan_request import Refusal
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from dashboards.rerun_view import export_rrd, run_of
from dashboards.rerun_viewer import episode_of
from twin.plan.config import PlanConfig
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.ground.run_tasks import UnderstoodTask
from twin.plan.loop.nominal import PlanProposer
from twin.plan.loop.propose import NoPlanError, choose
from twin.plan.loop.push import ASIDE_M, push, push_choices
from twin.plan.loop.steer import tried_in
from twin.plan.loop.tau import Trajectory
from twin.plan.once import Begun, Planned, Start, plan_once, start_of
from twin.plan.problem import Problem, State
from twin.replay.config import ReplayConfig
from twin.replay.scene import ReplayScene
from twin.replay.verdict import replay_plan


def drawn(task_name: str, seed: int) -> Problem:
    task = load_task(task_name)
    Ts = task.draw_start(np.random.default_rng(seed))
    return problem_of_test(ReplayScene(task=task, Ts_base_object=Ts, urdf=ROBOT.urdf_text()))


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of_test()


def chosen(problem: Problem, round_: int, refused: tuple[Refusal, ...] = ()) -> Plan:
    return choose(
        PlanProposer(), problem, plan_id="p", seed=3, round_=round_, refused=refused, most=5
    ).plan


def refusal(plan: Plan, **factors: Factor) -> Refusal:
    return Refusal(plan=plan, verdict=verdict_of(plan.id, **factors))


def test_the_twin_accepts_the_first_plan(problem: Problem) -> None:
    plan = chosen(problem, 0)
    verdict = replay_plan(plan, problem.scene, ReplayConfig(mode="dynamic")).verdict
    assert verdict.accepted, verdict.reason
    assert Plan.from_json(plan.to_json()) == plan
    assert all(w.joints_rad is not None and w.width_m is not None for w in plan.tau)
    assert all(a.t_ns < b.t_ns for a, b in zip(plan.tau, plan.tau[1:], strict=False))
    assert plan.tau[-1].joints_rad == pytest.approx(HOME, abs=1e-6)
    widths = np.diff([w.width_m for w in plan.tau]) / np.diff([w.t_ns for w in plan.tau]) * 1e9
    assert np.abs(widths).max() <= 2 * 0.2, "two fingers, each as its joint in the URDF may"


@pytest.mark.slow
def test_the_order_of_candidates_is_that_of_a_longer_list(problem: Problem) -> None:
    """Asked for two or for one, the first is the same to the byte; no two are alike."""
    proposer = PlanProposer()
    two = list(islice(proposer.propose(problem, plan_id="p", seed=3, steer=None), 2))
    one = next(proposer.propose(problem, plan_id="p", seed=3, steer=None))
    assert one.plan.to_json() == two[0].plan.to_json()
    assert [each.rank for each in two] == [0, 1]
    assert two[0].plan.tau != two[1].plan.tau


def test_a_refused_grasp_gives_another_grasp(problem: Problem) -> None:
    first = chosen(problem, 0)
    no = refusal(first, terminal=Factor(value=False, cause="exploded", bodies=("cube",)))
    second = chosen(problem, 1, (no,))
    assert second.steered_by is not None
    assert second.steered_by.clause == "terminal.exploded"
    (one,), (other,) = tried_in(first), tried_in(second)
    away_m = np.linalg.norm(one.T_object_tcp[:3, 3] - other.T_object_tcp[:3, 3])
    turned = se3.rotation_angle_rad(one.T_object_tcp[:3, :3].T @ other.T_object_tcp[:3, :3])
    assert away_m > 0.01 or turned > np.radians(10)


@pytest.mark.slow
def test_a_refused_release_keeps_the_grasp(problem: Problem) -> None:
    first = chosen(problem, 0)
    touches = Factor(value=False, cause="contact", bodies=("cube", "box"))
    second = chosen(problem, 1, (refusal(first, clearance=touches),))
    (one,), (other,) = tried_in(first), tried_in(second)
    assert other.T_object_tcp == pytest.approx(one.T_object_tcp, abs=1e-6)
    assert one.T_base_release is not None
    assert other.T_base_release is not None
    away_m = np.linalg.norm(one.T_base_release[:3, 3] - other.T_base_release[:3, 3])
    turned = se3.rotation_angle_rad(one.T_base_release[:3, :3].T @ other.T_base_release[:3, :3])
    assert away_m > 0.01 or turned > np.radians(10)


@pytest.mark.slow
@pytest.mark.parametrize(
    "task", ["stack_two_cubes", "push_cube_to_mark", "sloth_into_basket", "slippery_block_into_box"]
)
def test_every_kind_of_task_has_a_plan(task: str) -> None:
    problem = drawn(task, 5)
    found = next(PlanProposer().propose(problem, plan_id="p", seed=5, steer=None))
    assert found.plan.policy == "nominal"
    assert [stage.id for stage in found.plan.stages] == [
        stage["id"] for stage in problem.scene.task.stages
    ]


def test_the_least_shifted_push_comes_first_and_leads_to_the_mark() -> None:
    first, *others = push_choices()
    assert first == (0.0, 0.0, (0.0, 0.0))
    assert {aside for _, aside, _ in others} == set(ASIDE_M)
    problem = drawn("push_cube_to_mark", 5)
    (key,) = problem.scene.task.manipulated
    after = push(problem, key, first, Trajectory(robot=problem.robot))
    mark = problem.scene.task.mark_of(key)
    assert after.scene.Ts_base_object[key][:2, 3] == pytest.approx(mark)


def test_what_was_not_localised_is_not_planned(problem: Problem) -> None:
    Ts = {"box": problem.scene.Ts_base_object["box"]}
    lost = replace(problem, scene=replace(problem.scene, Ts_base_object=Ts))
    with pytest.raises(NoPlanError, match="cube of task cube_into_box was not localised"):
        next(PlanProposer().propose(lost, plan_id="p", seed=0, steer=None))


@pytest.mark.parametrize("verb", ["grasp", "release"])
def test_an_object_without_its_stages_is_named_with_what_to_add(
    problem: Problem, verb: str
) -> None:
    """The task file check lets it pass: whoever only records needs no such stage."""
    task = problem.scene.task
    stages = tuple({k: v for k, v in table.items() if k != verb} for table in task.stages)
    odd = replace(problem, scene=replace(problem.scene, task=replace(task, stages=stages)))
    with pytest.raises(NoPlanError, match=f'moves cube, and no stage says {verb} = "cube". Add'):
        next(PlanProposer().propose(odd, plan_id="p", seed=0, steer=None))


@pytest.mark.parametrize(
    ("name", "p_m", "said", "to_do"),
    [
        ("cube", (0.42, 0.19, 0.02), "no path for 'lift': refused: cube and box", "Move apart"),
        ("box", (0.75, 0.75, 0.0), "no joints reach the release pose", "nearer to the arm"),
    ],
)
def test_where_nothing_moves_the_message_says_what_to_do(
    problem: Problem, name: str, p_m: tuple[float, float, float], said: str, to_do: str
) -> None:
    T = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array(p_m))
    Ts = {**problem.scene.Ts_base_object, name: T}
    odd = replace(problem, scene=replace(problem.scene, Ts_base_object=Ts))
    with pytest.raises(NoPlanError, match=said) as caught:
        next(PlanProposer().propose(odd, plan_id="p", seed=0, steer=None))
    assert to_do in str(caught.value)


def test_a_hand_that_is_closed_at_the_start_is_told_to_open_at_once(problem: Problem) -> None:
    """Nobody tells the planner how wide the hand stands: it is open all the way to the grasp."""
    plan = chosen(problem, 0)
    closing = next(i for i, waypoint in enumerate(plan.tau) if waypoint.g == 1)
    assert plan.tau[0].t_ns == 0
    assert all(w.g == 0 and (w.width_m or 0.0) > 0.04 for w in plan.tau[:closing])


def test_a_gap_of_one_millimetre_beside_an_object_is_planned(problem: Problem) -> None:
    """It is less than the 12 mm that are kept from what nobody names, and no grid has it."""
    spec = {"kind": "beside", "object": "cube", "reference": "box", "gap_m": [0.008, 0.009]}
    task = replace(problem.scene.task, success=(spec,))
    asked = replace(problem, scene=replace(problem.scene, task=task))
    found = next(PlanProposer().propose(asked, plan_id="p", seed=1, steer=None))
    Ts = {key: T[None] for key, T in problem.scene.Ts_base_object.items()}
    Ts["cube"] = se3.pose_from_record(found.plan.stages[-1].predicted_objects["cube"])[None]
    goal = compile_constraint(spec, asked)
    state = State(Ts_base_object=Ts, T_base_tcp=np.eye(4)[None], width_m=np.zeros(1))
    assert goal.violation(state)[0] <= 0, goal.explain(state)


def test_a_speed_limit_shapes_the_times_and_is_kept(problem: Problem) -> None:
    """By the straight way of the tool between waypoints, which no time law knows of."""
    slow = {"kind": "speed", "max": 0.08}
    task = problem.scene.task
    stages = tuple({**table, "path": [slow]} for table in task.stages)
    asked = replace(problem, scene=replace(problem.scene, task=replace(task, stages=stages)))
    found = next(PlanProposer().propose(asked, plan_id="p", seed=0, steer=None))
    tau = found.plan.tau
    seconds = np.diff([each.t_ns for each in tau]) * 1e-9
    speeds = np.linalg.norm(np.diff([each.p_m for each in tau], axis=0), axis=1) / seconds
    assert speeds.max() <= 0.08 * 1.01
    assert speeds.max() >= 0.08 * 0.9


SEEN_NS = 5_000_000_000


def verdict(plan: Plan, accepted: bool) -> Verdict:
    terminal = Factor(value=accepted, cause=None if accepted else "inside", bodies=("cube", "box"))
    nearest = {"t_ns": 0, "distance_m": 0.1, "bodies": ["gripper", "box"]}
    return verdict_of(plan.id, terminal=terminal, nearest=nearest)


def planned(run: RunFolder, answers: list[bool]) -> Planned:
    """Rounds of planning, judged as told."""
    path = run.episodes_dir / "trial_0001.mcap"
    write_episode(path, FILE, kind="trial")
    problem = problem_of_test()
    episode = Episode.open(path)
    start = Start(episode=episode, seen_ns=SEEN_NS, localised={}, problem=problem)
    left = iter(answers)
    understood = UnderstoodTask(file=FILE, grounding=None)
    config = PlanConfig(rounds=len(answers))
    begun = Begun(understood=understood, start=start)
    return plan_once(run, begun, lambda plan: verdict(plan, next(left)), config)


@pytest.fixture(scope="module")
def steered(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, Planned]:
    run = RunFolder.create(tmp_path_factory.mktemp("once") / "run")
    return run, planned(run, [False, True])


def test_the_refused_plan_stays_beside_the_accepted_one(steered: tuple[RunFolder, Planned]) -> None:
    run, done = steered
    refused, accepted = (each.candidate.plan for each in done.attempts)
    assert done.path == run.plans_dir / f"{accepted.id}.json"
    there = {path.name for path in run.plans_dir.iterdir()}
    assert there == {
        f"{refused.id}.refused.json",
        f"{accepted.id}.json",
        f"{refused.id}.replay.mcap",
        f"{accepted.id}.replay.mcap",
    }
    kept = Plan.from_json((run.plans_dir / f"{refused.id}.refused.json").read_bytes())
    assert kept == refused
    assert json.loads(done.path.read_bytes())["parent_id"] == refused.id


def test_a_plan_is_named_by_its_start(steered: tuple[RunFolder, Planned]) -> None:
    _, done = steered
    name = "cube_into_box.trial_0001.nominal.0"
    assert [each.candidate.plan.id for each in done.attempts] == [f"{name}.0", f"{name}.1"]


def test_a_replay_holds_the_plan_its_verdict_and_the_moving_arm(
    steered: tuple[RunFolder, Planned],
) -> None:
    run, done = steered
    for attempt in done.attempts:
        plan = attempt.candidate.plan
        episode = Episode.open(run.plans_dir / f"{plan.id}.replay.mcap")
        assert streams.plans(episode) == [(SEEN_NS, plan)]
        assert [each for _, each in streams.verdicts(episode)] == [attempt.verdict]
        joints = streams.joint_track(episode)
        assert joints.stamps_ns[0] == SEEN_NS
        assert np.abs(np.diff(joints.position, axis=0)).max() > 0
    assert not run.derived_dir.exists(), "evaluation reads what is there"


def test_the_view_shows_the_replay_of_a_plan(
    steered: tuple[RunFolder, Planned], tmp_path_factory: pytest.TempPathFactory
) -> None:
    _, done = steered
    assert done.path is not None
    path = episode_of(done.path)
    out = tmp_path_factory.mktemp("view") / "plan.rrd"
    shown = export_rrd(path, out, run_of(path))
    assert shown.sides == ("replayed/planned/dynamic",)
    assert not [note for note in shown.notes if "plan" in note]


def test_where_plans_begin_is_said(steered: tuple[RunFolder, Planned]) -> None:
    _, done = steered
    assert "  arm: as recorded" in done.lines()
    assert any(line.startswith("    at rest: inside holds") for line in done.explained())
    assert done.to_json()["start"]["arm"] == "as recorded"


def test_an_episode_of_an_empty_run_is_not_looked_up_in_an_empty_list(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    run = RunFolder.create(tmp_path_factory.mktemp("empty") / "run")
    with pytest.raises(UsageError, match=r"no episodes in .*\. Record some"):
        start_of(run, FILE.task(), PlanConfig(episode="trial_0001"))


def test_where_nothing_is_accepted_only_refused_plans_are_kept(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    run = RunFolder.create(tmp_path_factory.mktemp("refused") / "run")
    done = planned(run, [False])
    assert done.path is None
    assert "nothing was sent" in done.lines()[-1]
    assert [path.name for path in run.plans_dir.glob("*.json")] == [
        f"{done.last.candidate.plan.id}.refused.json"
    ]
