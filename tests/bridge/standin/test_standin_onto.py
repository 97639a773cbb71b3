"""The scripted planner puts an object where its predicate says: onto another, or by pushing it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from standin_hidden import nominal_hidden
from standin_plans import planned

import bridge.task
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.cell_file import CellFile, draw_hidden
from bridge.sources.standin.destination import ON_CLEARANCE_M
from bridge.sources.standin.operator import execute_plan, label_trial
from bridge.sources.standin.planner import (
    NO_ERROR,
)
from bridge.sources.standin.session import run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.sources.standin.streams import Streams
from bridge.task.plan import Plan
from bridge.task.predicate import Rollout, evaluate_success
from bridge.task.task_file import Task, TaskFile
from bridge.terminal import Output
from evaluator.metrics.geometric_rule import judge_by_geometry

FILE = TaskFile.read(Path(str(bridge.task.__file__)).parent / "template.toml")


@pytest.fixture(scope="module")
def onto() -> Task:
    return FILE.task()


def let_go_m(plan: Plan, stage_id: str) -> np.ndarray:
    """Where the tool is when the hand opens in a stage."""
    (stage,) = (stage for stage in plan.stages if stage.id == stage_id)
    inside = [w for w in plan.tau if stage.t_start_ns <= w.t_ns <= stage.t_end_ns]
    return np.array(next(w for w in inside if w.g == 0).p_m)


def test_it_lets_go_just_above_the_top_and_predicts_that_the_predicate_holds(onto: Task) -> None:
    starts = onto.draw_start(np.random.default_rng(9_000_000))
    plan = planned(onto, starts)
    top_m = starts["block"][2, 3] + onto.objects["block"].size_m[2] / 2
    grip_above_bottom = onto.objects["cube"].grasp_m[2] + onto.objects["cube"].size_m[2] / 2
    low = let_go_m(plan, "place")
    assert low[2] == pytest.approx(top_m + grip_above_bottom + ON_CLEARANCE_M, abs=1e-9)
    assert low[:2] == pytest.approx(starts["block"][:2, 3], abs=1e-9)
    predicted = se3.pose_from_record(plan.stages[-1].predicted_objects["cube"])
    rollout = Rollout(
        stamps_ns=np.array([0]),
        Ts_base_object={"cube": predicted[None], "block": starts["block"][None]},
        finger_contact={},
    )
    assert evaluate_success(onto, rollout)[0].value is True
    assert plan.stages[-1].terminal[0]["kind"] == "on"


def test_a_stack_is_planned_from_where_its_lower_part_then_lies(onto: Task) -> None:
    small = {"id": "small", "size_m": (0.03, 0.03, 0.03), "symmetry": "none"}
    stages = [
        {**stage, "id": f"{stage['id']}_{name}", verb: name}
        for name in ("cube", "small")
        for stage, verb in zip(onto.stages, ("grasp", "release"), strict=True)
    ]
    stack = replace(
        onto,
        objects=onto.objects | {"small": replace(onto.objects["cube"], **small)},
        manipulated=("cube", "small"),
        stages=tuple(stages),
        success=(*onto.success, {"kind": "on", "object": "small", "support": "cube"}),
    )
    starts = onto.draw_start(np.random.default_rng(1))
    starts["small"] = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.45, 0.0, 0.015]))
    plan = planned(stack, starts)
    places = {
        key: se3.pose_from_record(pose)
        for stage in plan.stages
        for key, pose in stage.predicted_objects.items()
    }
    assert places["cube"][2, 3] == pytest.approx(0.05 + 0.02, abs=1e-9)
    assert places["small"][:3, 3] == pytest.approx(places["cube"][:3, 3] + [0, 0, 0.035], abs=1e-9)


def test_what_nobody_says_where_to_put_is_not_planned(onto: Task) -> None:
    nowhere = replace(onto, success=onto.success[1:])
    with pytest.raises(UsageError, match="what cube is to be inside or on"):
        planned(nowhere, onto.draw_start(np.random.default_rng(1)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("release_m", "result"), [((0.0, 0.0), "success"), ((0.0, 0.11), "failure")]
)
@pytest.mark.usefixtures("unchecked")
def test_the_cell_and_its_label_agree_with_where_it_was_put(
    make_session: Callable[..., Any],
    cell_file: CellFile,
    onto: Task,
    release_m: tuple[float, float],
    result: str,
) -> None:
    cell = StandinCell(
        cell_file,
        onto,
        draw_hidden(cell_file, 9_000_000),
        Streams(make_session(), "standin"),
        rate_hz=0.0,
        scale=0.25,
        seed=9_000_000,
        start_ns=1_700_000_000_000_000_000,
    )
    starts = onto.draw_start(np.random.default_rng(9_000_000))
    cell.reset(starts)
    error = replace(NO_ERROR, release_m=release_m)
    plan = planned(onto, starts, error, kinematics=cell.kinematics, joints_start_rad=cell.home_rad)
    execute_plan(cell, plan)
    outcome = label_trial(onto, cell.truth, executed=True)
    assert outcome.result == result, outcome.detail
    assert [stage["result"] for stage in outcome.stages] == ["success", result]


def test_every_start_sends_the_task_file_to_the_recorder(
    make_session: Callable[..., Any], tmp_path: Path
) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(FILE.data.replace(b'name = "NAME"', b'name = "mine"'))
    session = make_session()
    config = SessionConfig(
        seed=9000, task=str(path), trials=1, rate_hz=0.0, image_scale=0.25, scan=False,
        conditions=("without_replanning",),
    )  # fmt: skip
    summary = run_session(session, config, Output(quiet=True), start_ns=1_700_000_000_000_000_000)
    (request,) = [request for verb, request in session.control if verb == "start"]
    assert request["task_file"] == path.read_text()
    assert request["info"]["task"] == summary["task"] == "mine"


SEED = 9_000_000


@pytest.mark.parametrize("seed", range(SEED, SEED + 5))
def test_the_push_is_level_straight_even_and_closed(push: Task, seed: int) -> None:
    starts = push.draw_start(np.random.default_rng(seed))
    plan = planned(push, starts)
    (stage,) = plan.stages
    assert (stage.push, stage.grasp, stage.release) == ("cube", None, None)
    p, t_s = plan.positions_m(), plan.times_ns() * 1e-9
    low = np.flatnonzero(np.isclose(p[:, 2], p[:, 2].min(), atol=1e-6))
    assert all(plan.tau[k].g == 1 for k in range(1, low[-1]))
    mark, start = np.array([0.46, 0.10]), starts["cube"][:2, 3]
    along = (mark - start) / np.linalg.norm(mark - start)
    off = (p[low, :2] - start) @ np.array([-along[1], along[0]])
    assert np.abs(off).max() < 1e-6
    speeds = np.diff(p[low, :2] @ along) / np.diff(t_s[low])
    assert speeds.max() == pytest.approx(0.30, rel=0.03)
    forward = speeds[speeds > 0.01]
    assert np.mean(np.isclose(forward, speeds.max(), rtol=0.03)) > 0.6
    predicted = se3.pose_from_record(stage.predicted_objects["cube"])
    assert predicted[:2, 3] == pytest.approx(mark, abs=1e-6)


def test_without_a_mark_or_beside_it_nothing_is_planned(push: Task) -> None:
    starts = push.draw_start(np.random.default_rng(SEED))
    with pytest.raises(UsageError, match="where cube is to be pushed"):
        planned(replace(push, success=push.success[1:]), starts)
    starts["cube"][:2, 3] = 0.46, 0.09
    with pytest.raises(UsageError, match="too near"):
        planned(push, starts)


def test_geometry_carries_the_cube_in_front_of_the_fingers(push: Task) -> None:
    starts = push.draw_start(np.random.default_rng(SEED))
    plan = planned(push, starts)
    assert judge_by_geometry(plan, push, starts).value is True
    beside = {"cube": starts["cube"].copy()}
    beside["cube"][0, 3] += 0.05  # fingers of 10 mm beside a cube of 25 mm to each side
    missed = judge_by_geometry(plan, push, beside)
    assert missed.value is False
    assert "moved 0 mm" in missed.detail
    short = replace(plan, tau=plan.tau[: len(plan.tau) // 2])
    assert judge_by_geometry(short, push, starts).value is False


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "result"), [(0.5, "success"), (0.06, "failure")])
@pytest.mark.usefixtures("unchecked")
def test_friction_decides_whether_the_cube_stops_at_the_mark(
    push: Task,
    make_session: Callable[..., Any],
    cell_file: CellFile,
    friction: float,
    result: str,
) -> None:
    hidden = replace(nominal_hidden(cell_file), object_friction=friction)
    cell = StandinCell(
        cell_file,
        push,
        hidden,
        Streams(make_session(), "standin"),
        rate_hz=0.0,
        seed=SEED,
        start_ns=0,
    )
    starts = push.draw_start(np.random.default_rng(SEED))
    cell.reset(starts)
    execute_plan(cell, planned(push, starts))
    outcome = label_trial(push, cell.truth, executed=True)
    assert outcome.result == result, outcome.detail
    assert outcome.stages == ({"id": "push", "result": result},)
