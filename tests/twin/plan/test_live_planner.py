"""A planner on the wire: what it answers, that it remembers nothing, and that there is one."""

import json
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
from foreign_scene import write_scene_of
from hostile_replies import INSIDE
from scripted_plans import scene_of_test
from test_model_client import Server, says, serving
from verdicts import verdict_of

import robot_gst
from bridge.episode.run_folder import RunFolder
from bridge.errors import InvalidRecordError
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, ROBOT, ROBOT_NAME
from bridge.robots.robot import read_robot
from bridge.sources.standin.decisions import WirePlanner
from bridge.task.find import chosen_task_file
from bridge.task.plan_request import PlanRequest, Refusal
from bridge.task.verdict import Factor
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSession, open_session
from twin.plan.config import LivePlanConfig, PlanConfig
from twin.plan.live import LivePlanner, claim_planner, serve_planner
from twin.plan.loop.nominal import PlanProposer
from twin.plan.problem import NoPlanError, Problem

FILE = chosen_task_file("cube_into_box")
HOME = (-0.263, -1.709, 1.365, -1.227, -1.571, 1.308)
QUIET = Output(quiet=True)


def request(**changes: Any) -> PlanRequest:
    records = tuple(
        {
            "schema_version": 1,
            "stamp_ns": 5,
            "object": name,
            "found": True,
            "T_base_object": se3.pose_record(T),
            "covariance": (1e-6 * np.eye(6)).ravel().tolist(),
            "method": "test",
        }
        for name, T in scene_of_test().Ts_base_object.items()
    )
    made = PlanRequest(
        task="cube_into_box",
        task_sha256=FILE.sha256,
        policy="nominal",
        start_id="cube_into_box/7",
        seed=7,
        round=0,
        robot=ROBOT_NAME,
        joint_names=ARM_JOINTS,
        joints_rad=HOME,
        objects=records,
    )
    return replace(made, **changes)


@pytest.fixture
def planner(run: RunFolder) -> LivePlanner:
    return LivePlanner(run, LivePlanConfig(), ROBOT.urdf_text)


def test_a_request_is_answered_with_a_plan_that_fits_it(planner: LivePlanner) -> None:
    asked = request()
    answer = planner.answer(asked.to_json())
    assert answer.plan is not None, answer.reason
    assert asked.why_unfit(answer.plan) == ""
    assert (answer.plan.planner, answer.plan.policy) == ("gst_planner", "nominal")
    assert answer.plan.candidate is not None
    assert answer.plan.candidate.rank == 0
    assert answer.plan.tau[0].joints_rad == pytest.approx(HOME)


def test_it_remembers_nothing(planner: LivePlanner) -> None:
    """Asked in any order, the same request has the same answer to the byte."""
    first = planner.answer(request().to_json())
    assert first.plan is not None
    exploded = Factor(value=False, cause="exploded", bodies=("cube",))
    no = verdict_of(first.plan.id, terminal=exploded)
    steered = request(round=1, refused=(Refusal(plan=first.plan, verdict=no),)).to_json()
    second = planner.answer(steered)
    assert second.plan is not None
    assert second.plan.steered_by is not None
    assert second.plan.steered_by.clause == "terminal.exploded"
    assert planner.answer(request().to_json()).to_json() == first.to_json()
    assert planner.answer(steered).to_json() == second.to_json()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"policy": "best"}, "policy 'best' is unknown. There are: nominal"),
        ({"task_sha256": "0" * 64}, "no task named 'cube_into_box' with sha256 000000000000"),
        ({"robot": "panda"}, "for robot 'panda'; the cell describes"),
        ({"objects": request().objects[:1]}, "differ in objects"),
    ],
)
def test_what_cannot_be_planned_has_a_reason(
    planner: LivePlanner, changes: dict[str, Any], words: str
) -> None:
    answer = planner.answer(request(**changes).to_json())
    assert answer.plan is None
    assert words in answer.reason


def test_a_scene_of_another_robot_is_not_planned_in(run: RunFolder) -> None:
    other = read_robot("ur10_parallel_gripper")
    write_scene_of(run, other)
    asked = request().to_json()
    for _ in range(2):
        answer = LivePlanner(run, LivePlanConfig(), ROBOT.urdf_text).answer(asked)
        assert answer.plan is None
        assert f"recorded with robot {other.name} (scan)" in answer.reason
    named = LivePlanConfig(robot=ROBOT_NAME)  # the user says that it fits
    assert LivePlanner(run, named, ROBOT.urdf_text).answer(asked).plan is not None


LOW = {"kind": "height", "a": {"object": "cube", "anchor": "top"}, "min": -0.01, "max": 0.5}
NEVER = {"kind": "height", "a": {"object": "cube", "anchor": "top"}, "min": 0.9}


def adds(constraint: dict[str, Any]) -> str:
    """A reply that wants this on the way to the box."""
    wish = {"when": "carry", "moving": "cube", "keep": constraint}
    return json.dumps({"version": 3, "goals": [INSIDE], "constraints": [wish]})


def asking(run: RunFolder, server: Server) -> LivePlanner:
    words = PlanConfig(model=server.url, model_name="stub")
    return LivePlanner(run, LivePlanConfig(), ROBOT.urdf_text, words=words)


def test_policy_model_keeps_what_the_model_adds_and_the_same_request_has_the_same_answer(
    run: RunFolder,
) -> None:
    asked = request(policy="model")
    with serving(says(adds(LOW))) as server:
        first = asking(run, server).answer(asked.to_json())
        again = asking(run, server).answer(asked.to_json())
    assert first.plan is not None, first.reason
    assert asked.why_unfit(first.plan) == ""
    assert (first.plan.planner, first.plan.policy) == ("gst_planner", "model")
    assert [LOW in stage.path for stage in first.plan.stages] == [False, True]
    assert f"; stub at {server.url} replied: {{" in first.plan.grounding_source
    assert again.to_json() == first.to_json()
    assert server.asked[0] == server.asked[1], "nothing is remembered, and nothing differs"


def test_live_replies_that_are_refused_and_what_no_plan_keeps_have_a_reason(run: RunFolder) -> None:
    class KeepsNothing(PlanProposer):
        def propose(self, problem: Problem, **more: Any) -> Any:
            if any(stage.get("path") for stage in problem.scene.task.stages):
                raise NoPlanError("no path keeps that.")
            return super().propose(problem, **more)

    asked = request(policy="model").to_json()
    with serving(says("Sure!")) as server:
        answer = asking(run, server).answer(asked)
        assert answer.plan is None
        assert "gave no answer that can be used in 3 replies" in answer.reason
        assert asking(run, server).answer(request(policy="nominal").to_json()).plan is not None
    assert len(server.asked) == 3
    with serving(says(adds(NEVER))) as server:
        words = PlanConfig(model=server.url, model_name="stub")
        planner = LivePlanner(run, LivePlanConfig(), ROBOT.urdf_text, KeepsNothing, words=words)
        answer = planner.answer(asked)
    assert answer.plan is None
    assert "no path keeps that" in answer.reason


def test_policy_model_without_a_model_has_a_reason(planner: LivePlanner) -> None:
    answer = planner.answer(request(policy="model").to_json())
    assert answer.plan is None
    assert "--live --model URL --model-name NAME" in answer.reason
    assert "model" not in planner.policies


def test_live_with_a_task_is_wrong_use(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    for option in (["--task", "cube_into_box"], ["--dry"]):
        assert robot_gst.run(["plan", str(run.path), "--live", *option]) == 2
        assert "leave --task and --dry out" in capsys.readouterr().err


def test_when_no_candidate_is_left_the_reason_says_how_many_there_were(run: RunFolder) -> None:
    class Few(PlanProposer):
        def propose(self, problem: Any, **more: Any) -> Any:
            return islice(super().propose(problem, **more), 1)

    planner = LivePlanner(run, LivePlanConfig(), ROBOT.urdf_text, Few)
    reason = planner.answer(request(round=2).to_json()).reason
    assert "there are 1 candidates, and 2 were tried" in reason


def test_before_the_cell_describes_its_robot_there_is_no_plan(run: RunFolder) -> None:
    answer = LivePlanner(run, LivePlanConfig(), lambda: None).answer(request().to_json())
    assert "no robot description has arrived" in answer.reason


def test_a_bug_is_a_reason_and_no_silence(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    class Broken:
        def propose(self, *_: Any, **__: Any) -> Any:
            raise ZeroDivisionError("oops")

    planner = LivePlanner(run, LivePlanConfig(), ROBOT.urdf_text, lambda _: Broken())
    assert "ZeroDivisionError: oops" in planner.answer(request().to_json()).reason
    assert "Traceback" in capsys.readouterr().err


def test_what_is_no_request_is_refused(planner: LivePlanner) -> None:
    with pytest.raises(InvalidRecordError):
        planner.answer(b"nonsense")


def test_a_second_planner_of_a_cell_is_refused(router: WireSession, endpoint: str) -> None:
    with open_session(WireConfig(connect=(endpoint,))) as other:
        claim_planner(router, "lab")
        with pytest.raises(NoPlanError, match="a planner answers on lab/plan already"):
            claim_planner(other, "lab")
        claim_planner(other, "lab2")


def test_a_cell_asks_over_the_wire_and_hears_plans_and_reasons(
    router: WireSession, endpoint: str, planner: LivePlanner
) -> None:
    serve_planner(router, planner, "lab", QUIET)
    with open_session(WireConfig(connect=(endpoint,))) as cell:
        asking = WirePlanner(cell, "lab", 60.0)
        assert asking.ask(request()).plan is not None
        refusal = asking.ask(request(policy="best"))
        assert (refusal.plan, refusal.heard) == (None, True)
        nobody = WirePlanner(cell, "lab2", 5.0).ask(request())
        assert (nobody.plan, nobody.heard) == (None, False)
        assert "no planner answers on lab2/plan" in nobody.reason
