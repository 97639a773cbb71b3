"""Cubes in bins of their colours, and planners that see them with the eyes of the gate."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from standin_plans import planned

from bridge.data_files import dataset_file
from bridge.geometry import se3
from bridge.sources.standin.cell import StandinCell, TruthLog
from bridge.sources.standin.cell_file import CellFile, draw_hidden, load_cell
from bridge.sources.standin.destination import destination_of
from bridge.sources.standin.gate_sight import GateSight
from bridge.sources.standin.kinematics import tool_down
from bridge.sources.standin.operator import Operator, execute_plan, label_trial
from bridge.sources.standin.settings import SessionConfig
from bridge.sources.standin.streams import Streams
from bridge.task.plan import Plan
from bridge.task.predicate import Rollout, evaluate_success
from bridge.task.task_file import Task, load_task
from bridge.wire.errors import NoReplyError

FROZEN = {
    # SHA-256 of the files that were there before: what was recorded with them names their hash.
    ("cells", "lab"): "6d372fd7101387df",
    ("cells", "lab_mixed"): "d7e9e3e7f1aaca7f",
    ("cells", "standin"): "5ea62810956d071b",
    ("cells", "standin_toys"): "86202f6783135dfa",
    ("cells", "standin_toys_steady"): "0ef80d4f758d2c69",
    ("tasks", "cube_into_box"): "ca150252dc659ee9",
    ("tasks", "five_ducks_into_basket"): "07e88730503c952e",
    ("tasks", "heavy_block_into_box"): "4b0c0d139a99f23e",
    ("tasks", "push_cube_to_mark"): "a20309ef41406cda",
    ("tasks", "slippery_block_into_box"): "771a828e739cafb6",
    ("tasks", "sloth_into_basket"): "f65db801f314e38d",
    ("tasks", "sloth_over_rim"): "b74724cd53fce2c1",
    ("tasks", "stack_two_cubes"): "86f3f31876d484e5",
}
TASKS = ("sort_by_colour", "cube_beside_cube", "clear_then_place", "cube_on_block")
SEED = 9_000_000


@pytest.mark.parametrize("folder", ["cells", "tasks"])
def test_older_files_are_what_they_were(folder: str) -> None:
    for kind, name in FROZEN:
        if kind == folder:
            data = dataset_file(kind, name).read_bytes()
            assert hashlib.sha256(data).hexdigest()[:16] == FROZEN[kind, name], name


def predicted(plan: Plan, starts: dict[str, np.ndarray]) -> Rollout:
    """The start, then what the plan says where everything comes to lie."""
    ends = dict(starts)
    for stage in plan.stages:
        for key, pose in stage.predicted_objects.items():
            ends[key] = se3.pose_from_record(pose)
    return Rollout(
        stamps_ns=np.array([0, 10**9]),
        Ts_base_object={key: np.array([T, ends[key]]) for key, T in starts.items()},
        finger_contact={},
    )


@pytest.mark.parametrize("name", TASKS)
def test_a_plan_predicts_what_its_task_asks_for(name: str) -> None:
    task = load_task(name)
    assert load_cell(task.cell).name == "standin_cubes"
    starts = task.draw_start(np.random.default_rng(SEED))
    plan = planned(task, starts)
    assert [stage.id for stage in plan.stages] == [stage["id"] for stage in task.stages]
    begins = [stage.t_start_ns for stage in plan.stages]
    assert begins == sorted(begins)
    found = evaluate_success(task, predicted(plan, starts))
    about_poses = [each for each in found if each.kind not in ("settled", "no_finger_contact")]
    assert about_poses
    assert all(each.value is True for each in about_poses), [each.detail for each in about_poses]
    before = {key: np.array([T, T]) for key, T in starts.items()}
    still = replace(predicted(plan, starts), Ts_base_object=before)
    assert any(each.value is False for each in evaluate_success(task, still))


@pytest.mark.parametrize("yaw", [-0.6, 0.0, 0.6])
@pytest.mark.parametrize("side", ["left", "right", "in_front", "behind", None])
def test_beside_is_the_middle_of_the_gap_with_a_finger_on_either_side_of_it(
    yaw: float, side: str | None
) -> None:
    task = load_task("cube_beside_cube")
    success = list(task.success)
    success[0] = {key: value for key, value in success[0].items() if key != "direction"}
    if side:
        success[0]["direction"] = side
    task = replace(task, success=tuple(success))
    q = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    seen = {
        "cube": se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, -0.2, 0.02])),
        "other": se3.transform_from(q, np.array([0.48, 0.1, 0.02])),
    }
    place = destination_of(task, "cube", seen)
    T = place.T_base.copy()
    T[2, 3] = place.resting_m(task.objects["cube"])
    rows = {key: np.array([each, each]) for key, each in (seen | {"cube": T}).items()}
    rollout = Rollout(stamps_ns=np.array([0, 1]), Ts_base_object=rows, finger_contact={})
    found = evaluate_success(task, rollout)[0]
    assert found.value is True, found.detail
    assert "seen from above is 20 mm" in found.detail
    for taken in (-1.0, 0.4, 2.5):
        closing = tool_down(np.zeros(3), place.turned_to(taken))[:2, 1]
        assert abs(float(closing @ (T - seen["other"])[:2, 3])) < 1e-9
        assert abs(place.turned_to(taken) - taken) <= np.pi / 2 + 1e-9


def test_what_stands_in_the_way_is_put_to_its_mark_before_the_cube_is_touched() -> None:
    task = load_task("clear_then_place")
    starts = task.draw_start(np.random.default_rng(SEED))
    plan = planned(task, starts)
    mark = task.mark_of("block")
    assert mark is not None
    stages = {stage.id: stage for stage in plan.stages}
    put = se3.pose_from_record(stages["clear"].predicted_objects["block"])
    assert put[:2, 3] == pytest.approx(mark, abs=1e-9)
    assert stages["clear"].t_end_ns <= stages["grasp_cube"].t_start_ns
    # The cube's underside passes lower than the block is high, and where that stood.
    carry = stages["carry_cube"]
    way = np.array([w.p_m for w in plan.tau if carry.t_start_ns <= w.t_ns <= carry.t_end_ns])
    cube, block = task.objects["cube"], task.objects["block"]
    underside = way[:, 2].max() - cube.grasp_m[2] - cube.size_m[2] / 2
    assert underside < block.size_m[2] - 0.01
    aside = np.linalg.norm(way[:, :2] - starts["block"][:2, 3], axis=1).min()
    assert aside < (cube.size_m[0] + block.size_m[1]) / 2


@pytest.mark.parametrize(("cleared", "result"), [(True, "success"), (False, "failure")])
@pytest.mark.usefixtures("unchecked")
def test_a_plan_that_leaves_the_block_runs_into_it_and_fails(
    make_session: Callable[..., Any], cleared: bool, result: str
) -> None:
    whole, file = load_task("clear_then_place"), load_cell("standin_cubes")
    task = whole
    if not cleared:
        only = [stage for stage in task.stages if "block" not in stage.values()]
        mine = [spec for spec in task.success if spec["object"] == "cube"]
        task = replace(task, manipulated=("cube",), stages=tuple(only), success=tuple(mine))
    cell = StandinCell(
        file,
        task,
        draw_hidden(file, SEED, task),
        Streams(make_session(), "standin"),
        rate_hz=0.0,
        scale=0.25,
        seed=SEED,
        start_ns=0,
    )
    cell.reset(task.draw_start(np.random.default_rng(SEED)))
    cell.wait(0.2)
    plan = planned(task, cell.world.Ts_base_object())
    cell.truth = TruthLog()
    execute_plan(cell, plan)
    moved_m = np.linalg.norm(np.ptp(np.array(cell.truth.poses["block"])[:, :2, 3], axis=0))
    assert moved_m > 0.01
    outcome = label_trial(whole, cell.truth, executed=True)
    assert outcome.result == result, outcome.detail


def record(object_id: str, T: np.ndarray | None) -> dict[str, Any]:
    return {
        "schema_version": 1,
        "stamp_ns": 5,
        "object": object_id,
        "found": T is not None,
        "T_base_object": None if T is None else se3.pose_record(T),
        "covariance": None,
        "symmetry": "cube",
        "confidence": 1.0 if T is not None else 0.0,
        "method": "test",
        "reason": None if T is not None else "behind the arm",
    }


def answer(found: bool | None, reason: str | None = None, *objects: dict[str, Any]) -> bytes:
    reply = {"schema_version": 1, "stamp_ns": 5, "found": found, "reason": reason}
    return json.dumps({**reply, "objects": list(objects)}).encode()


def session_with(make_session: Callable[..., Any], reply: bytes | None) -> Any:
    """A wire whose gate answers where the objects are, or does not."""

    class Sees(make_session):  # type: ignore[misc]
        def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
            if key == "lab/gate/localise":
                self.asked.append(json.loads(payload)["task"])
                if reply is None:
                    raise NoReplyError(key=key, timeout_s=timeout_s)
                return reply
            return bytes(super().query(key, payload, timeout_s=timeout_s))

    return Sees()


def trial(lab: CellFile, task: Task, session: Any, **settings: Any) -> Any:
    """One trial without replanning, and the plans it published."""
    cell = StandinCell(
        lab,
        task,
        replace(draw_hidden(lab, SEED, task), latency_s=0.0),
        Streams(session, "lab"),
        rate_hz=0.0,
        seed=SEED,
        start_ns=0,
    )
    values = {"trials": 1, "conditions": ("without_replanning",), "scan": False, **settings}
    operator = Operator(cell, session, SessionConfig(cell="lab", seed=9000, **values))
    operator.trials()
    return operator.results[0][1], [Plan.from_json(item.data) for item in session.of("/lab/plan")]


@pytest.mark.usefixtures("unchecked")
def test_the_plan_is_made_from_the_gates_record_and_nothing_else(
    lab: CellFile, push: Task, make_session: Callable[..., Any]
) -> None:
    """The gate is 100 mm wrong here: so is the plan, and its cube stays where it is."""
    told = push.draw_start(np.random.default_rng(SEED))["cube"]
    told[0, 3] += 0.10
    session = session_with(make_session, answer(True, None, record("cube", told)))
    outcome, (plan,) = trial(lab, push, session)
    assert session.asked == ["push_cube_to_mark"]
    assert plan.grounding_source == "gst localisation v1 of the gate"
    assert plan.keypoints_m[0] == pytest.approx(told[:3, 3])
    assert outcome.result == "failure"
    assert "moved 0 mm" in outcome.detail


@pytest.mark.parametrize("reply", [None, b"nonsense", answer(None, "no usable frames")])
def test_without_a_look_the_trial_is_void(
    lab: CellFile, push: Task, make_session: Callable[..., Any], reply: bytes | None
) -> None:
    outcome, plans = trial(lab, push, session_with(make_session, reply))
    assert plans == []
    assert outcome.result == "unknown"
    assert "nothing executed, no localisation (" in outcome.detail


def test_an_object_that_is_not_found_is_a_failure_to_plan(
    lab: CellFile, push: Task, make_session: Callable[..., Any]
) -> None:
    reply = answer(False, "cube: behind the arm", record("cube", None))
    outcome, plans = trial(lab, push, session_with(make_session, reply))
    assert plans == []
    assert outcome.result == "failure"
    assert "nothing executed, object not found: cube: behind the arm" in outcome.detail


def test_what_the_gate_may_answer_is_read_with_three_values(push: Task) -> None:
    T = push.draw_start(np.random.default_rng(SEED))["cube"]
    good = GateSight.from_json(answer(True, None, record("cube", T)), push)
    assert se3.pose_from_record(good.records[0]["T_base_object"]) == pytest.approx(T)
    broken = [
        b"",
        b"[]",
        b"{}",
        answer(True, None),
        answer(True, None, record("mug", T)),
        answer(True, None, record("cube", None)),
        answer(True, None, record("cube", T)).replace(b'"p_m": [', b'"p_m": [1e999, '),
    ]
    for data in broken:
        assert GateSight.from_json(data, push).found is None, data
    assert GateSight.from_json(answer(False, "x"), push).found is False
