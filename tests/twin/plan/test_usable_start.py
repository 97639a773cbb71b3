"""Starts from which nothing can be planned say why; a trial that failed steers the next plan."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_scene import write_scan
from joint_samples import at_positions
from planned_start import CUBE, HOME, problem_of_test
from scripted_plans import pick_and_place, scene_of_test

from bridge.episode.catalogue import label_episode
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.run_folder import RunFolder
from bridge.episode.schema import EVENT, JOINT_STATE, PLAN
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.robots.robot import read_robot
from bridge.task.plan import Plan
from twin.plan import missed, once
from twin.plan.config import PlanConfig
from twin.plan.loop.nominal import PlanProposer
from twin.plan.loop.propose import NoPlanError
from twin.plan.loop.steer import steer_by, tried_in
from twin.plan.once import Start, start_of
from twin.plan.problem import Problem
from twin.plan.shapes import shapes_of
from twin.plan.usable_start import refuse_other_robot, refuse_unusable
from twin.scene.localise.result import LocalisedObject
from twin.scene.store.folder import NEEDED, SCENE_FILE, SCENE_VERSION

SURE = np.eye(6) * 1e-6
S = 1_000_000_000
Change = Callable[[Problem], Problem]


def scene_with(**changes: Any) -> Change:
    return lambda problem: replace(problem, scene=replace(problem.scene, **changes))


def placed(name: str, *p_m: float, scale: float = 1.0) -> Change:
    T = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array(p_m))
    T[:3, :3] *= scale

    def change(problem: Problem) -> Problem:
        return scene_with(Ts_base_object={**problem.scene.Ts_base_object, name: T})(problem)

    return change


def sized(name: str, x_m: float, y_m: float, z_m: float) -> Change:
    def change(problem: Problem) -> Problem:
        task = problem.scene.task
        model = replace(task.objects[name], size_m=(x_m, y_m, z_m))
        task = replace(task, objects={**task.objects, name: model})
        return replace(scene_with(task=task)(problem), shapes=shapes_of(None, task))

    return change


@pytest.fixture
def problem() -> Problem:
    return problem_of_test()


@pytest.mark.parametrize(
    ("change", "said", "to_do"),
    [
        (placed("cube", np.nan, 0, 0.02), "pose of cube is not made of numbers", "Localise"),
        (placed("box", 0.5, np.inf, 0.0), "pose of box is not made of numbers", "Localise"),
        (placed("cube", 0.5, 0, 0.02, scale=2.0), "pose of cube has a rotation", "Localise"),
        (placed("cube", 2.0, 0, 0.02), "the arm reaches no grasp", "nearer"),
        (placed("box", 0.5, 2.5, 0.0), "no joints reach the release pose", "nearer"),
        (scene_with(start_rad=HOME[:4]), "gives 4 joints, and ur5", "--robot"),
        (scene_with(start_rad=HOME + 20), "rad, beyond its limits", "Move it back"),
        (scene_with(covariances={"box": SURE * np.nan}), "covariance of box", "Localise"),
        (scene_with(covariances={"box": SURE * 900}), "box is known to 30 mm", "Localise"),
        (sized("box", 0.05, 0.05, 0.056), r"reach of cube is [0-9.]+ mm beyond box", "Clear"),
        (sized("cube", 0.2, 0.2, 0.2), "wider than the hand opens", "wider gripper"),
        (
            scene_with(start_rad=np.array([0, 0.6, 1.2, 0, 0, 0.0])),
            "starts in collision: upper_arm_link touches table",
            "Move it clear",
        ),
    ],
)
def test_a_start_that_cannot_be_used_is_refused_in_one_sentence(
    problem: Problem, change: Change, said: str, to_do: str
) -> None:
    bad = change(problem)

    def plan() -> None:
        refuse_unusable(bad)
        next(PlanProposer().propose(bad, plan_id="p", seed=0, steer=None))

    with pytest.raises(NoPlanError, match=said) as caught:
        plan()
    assert to_do in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_good_start_is_not_refused(problem: Problem) -> None:
    refuse_unusable(scene_with(covariances={"cube": SURE, "box": SURE})(problem))


Begin = Callable[[np.ndarray], Start]


@pytest.fixture
def begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Begin:
    """Where plans begin of an episode with one joint state at 5 s, whose objects all are found."""
    said: dict[str, Any] = {"confidence": 1.0, "method": "", "reason": None, "stamp_ns": 5 * S}
    found = {
        key: LocalisedObject(object_id=key, T_base_object=T, **said)
        for key, T in scene_of_test().Ts_base_object.items()
    }
    monkeypatch.setattr(once, "localise_episode", lambda *_, **__: found)
    run = RunFolder.create(tmp_path / "run")

    def start(joints_rad: np.ndarray) -> Start:
        with EpisodeWriter(run.episodes_dir / "trial.mcap") as writer:
            writer.describe(EpisodeInfo(id="trial", kind="trial"))
            cdr = at_positions(5 * S, ROBOT.joints[: len(joints_rad)], joints_rad).to_cdr()
            writer.write("/lab/joint_states", cdr, type_name=JOINT_STATE, log_time_ns=5 * S)
        return start_of(run, scene_of_test().task, PlanConfig(), ROBOT.name)

    return start


def test_plans_begin_where_the_arm_was_recorded_to_stand(begin: Begin) -> None:
    start = begin(HOME)
    np.testing.assert_array_equal(start.problem.scene.start_rad, HOME)
    assert start.arm == "as recorded"


def test_where_joints_are_lacking_plans_begin_at_the_home_posture_and_say_so(begin: Begin) -> None:
    start = begin(HOME[:5])
    assert start.problem.scene.start_rad is None
    said = "its home posture, for nobody recorded all its joints within 1 s"
    assert f"  arm: {said}" in start.lines()


def test_joints_that_were_recorded_and_are_no_numbers_are_not_taken_for_the_home_posture(
    begin: Begin,
) -> None:
    with pytest.raises(NoPlanError, match=r"joints at the start are not made of numbers\. Record"):
        begin(np.append(HOME[:5], np.nan))


def test_a_scene_of_another_robot_is_refused(run: RunFolder) -> None:
    other = read_robot("ur10_parallel_gripper")
    for name, urdf in (("scan", other.description()), ("trial", ROBOT.urdf_text())):
        write_scan(run, name, urdf)
    run.scene_dir.mkdir()

    def made_of(name: str) -> None:
        record: dict[str, Any] = {**dict.fromkeys(NEEDED, ""), "schema_version": SCENE_VERSION}
        record["sources"] = [{"id": name}]
        (run.scene_dir / SCENE_FILE).write_text(json.dumps(record))

    made_of("trial")
    refuse_other_robot(run, ROBOT)
    made_of("scan")
    with pytest.raises(NoPlanError, match=f"with robot {other.name} .*rebuild"):
        refuse_other_robot(run, ROBOT)


PROBLEM = problem_of_test()
TASK = PROBLEM.scene.task


def executed(run: RunFolder, plan: Plan, result: str) -> None:
    path = run.episodes_dir / "trial_0001.mcap"
    with EpisodeWriter(path) as writer:
        task = {"task": TASK.name, "task_sha256": CUBE.sha256}
        writer.describe(EpisodeInfo(id=path.stem, kind="trial", **task))
        writer.write("/lab/plans", plan.to_json(), type_name=PLAN, log_time_ns=S)
        for number, kind in enumerate(("execution_started", "execution_ended"), start=2):
            event = {"schema_version": 1, "type": kind, "stamp_ns": number * S, "plan_id": plan.id}
            data = json.dumps(event).encode()
            writer.write("/lab/events", data, type_name=EVENT, log_time_ns=number * S)
    label_episode(run, path.stem, Outcome(result=result))


@pytest.mark.parametrize("result", ["failure", "success"])
def test_the_next_plan_makes_up_for_a_measured_miss(
    result: str, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder.create(tmp_path_factory.mktemp("missed") / "run")
    entities = {key: se3.pose_record(T) for key, T in PROBLEM.scene.Ts_base_object.items()}
    plan = replace(pick_and_place(PROBLEM.scene), entities=entities)
    executed(run, plan, result)
    T_end = tried_in(plan)[0].T_base_object
    assert T_end is not None
    T_end[:3, 3] += (0.006, 0.0, -0.1)
    T_end[:3, :3] = T_end[:3, :3] @ se3.rotation_from_vector(np.array([0.0, np.pi / 2, 0.0]))
    seen: dict[str, object] = {}

    def localised(*_: object, **asked: object) -> dict[str, LocalisedObject]:
        seen.update(asked)
        about = {"confidence": 1.0, "method": "test", "reason": None, "stamp_ns": 4 * S}
        return {"cube": LocalisedObject(object_id="cube", T_base_object=T_end, **about)}

    monkeypatch.setattr(missed, "localise_episode", localised)
    refused = missed.missed_before(run, TASK, CUBE.sha256)
    assert missed.missed_before(run, TASK, "another") == ()
    if result == "success":
        assert refused == ()
        return
    assert (seen["after_ns"], seen["before_ns"]) == (3 * S, None)
    steer = steer_by(refused, PROBLEM)
    assert (steer.change, steer.clause) == ("release", "terminal.inside")
    assert steer.miss is not None
    assert np.linalg.norm(steer.miss.shift_m) == pytest.approx(0.006)
    assert steer.miss.turn_rad == pytest.approx(0.0, abs=1e-6)  # a cube looks the same turned
