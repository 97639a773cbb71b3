"""A stage that pushes: level, straight, at an even speed, closed; and the cell that does it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from standin_hidden import nominal_hidden
from standin_plans import planned

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.sources.standin.cell import CellConfig, StandinCell
from bridge.sources.standin.cell_file import CellFile
from bridge.sources.standin.operator import execute_plan, label_trial
from bridge.sources.standin.streams import Streams
from bridge.task.task_file import Task, load_task
from evaluator.metrics.geometric_rule import judge_by_geometry

SEED = 9_000_000


@pytest.fixture(scope="module")
def push() -> Task:
    return load_task("push_cube_to_mark")


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
        config=CellConfig(rate_hz=0.0),
        seed=SEED,
        start_ns=0,
    )
    starts = push.draw_start(np.random.default_rng(SEED))
    cell.reset(starts)
    execute_plan(cell, planned(push, starts))
    outcome = label_trial(push, cell.truth, executed=True)
    assert outcome.result == result, outcome.detail
    assert outcome.stages == ({"id": "push", "result": result},)
