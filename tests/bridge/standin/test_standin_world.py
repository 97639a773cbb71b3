"""What the physics of the stand-in cell must get right, and what it must keep apart."""

import hashlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import standin_plans

from bridge.episode.cdr.messages import JointSample
from bridge.episode.metadata import Outcome
from bridge.errors import UsageError
from bridge.robots.default import ROBOT
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.cell_file import CellFile, HiddenParameters, draw_hidden, load_cell
from bridge.sources.standin.kinematics import tool_down
from bridge.sources.standin.operator import execute_plan, label_trial
from bridge.sources.standin.planner import NO_ERROR, GraspError
from bridge.sources.standin.world import STEP_S, World
from bridge.task.plan import Plan
from bridge.task.task_file import Task


def planned(
    task: Task, starts: Any, error: GraspError, cell: StandinCell, cell_file: CellFile
) -> Plan:
    return standin_plans.planned(
        task,
        starts,
        error,
        kinematics=cell.kinematics,
        joints_start_rad=cell.home_rad,
        max_joint_speed_rad_s=cell_file.max_joint_speed_rad_s,
    )


@pytest.fixture
def attempt(
    make_session: Callable[..., Any],
    make_cell: Callable[..., StandinCell],
    starts: dict[str, np.ndarray],
    task: Task,
    cell_file: CellFile,
) -> Callable[..., tuple[Outcome, Any]]:
    def run(error: GraspError, seed: int = 9_000_000) -> tuple[Outcome, Any]:
        session = make_session()
        cell = make_cell(session, seed=seed)
        cell.reset(starts)
        execute_plan(cell, planned(task, starts, error, cell, cell_file))
        return label_trial(task, cell.truth, executed=True), session

    return run


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_a_good_grasp_puts_the_cube_into_the_box(
    attempt: Callable[..., tuple[Outcome, Any]],
) -> None:
    outcome, _ = attempt(NO_ERROR)
    assert outcome.result == "success"
    assert {stage["result"] for stage in outcome.stages} == {"success"}


@pytest.mark.slow
@pytest.mark.parametrize("axis", ["along_m", "across_m"])
@pytest.mark.usefixtures("unchecked")
def test_a_grasp_six_centimetres_off_fails(
    attempt: Callable[..., tuple[Outcome, Any]], axis: str
) -> None:
    outcome, _ = attempt(replace(NO_ERROR, **{axis: 0.06}))
    assert outcome.result == "failure"
    assert outcome.stages[0]["result"] == "failure"


@pytest.fixture
def cell(
    make_session: Callable[..., Any], make_cell: Callable[..., Any], starts: dict[str, np.ndarray]
) -> StandinCell:
    found: StandinCell = make_cell(make_session())
    found.reset(starts)
    return found


@pytest.mark.usefixtures("unchecked")
def test_the_arm_bears_what_it_carries_and_no_grasp_comes_near_its_limit(
    cell: StandinCell, starts: Any, task: Task, cell_file: CellFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Newton's second law for the cube between the fingers: force is mass times (a + g)."""
    rows, stop = list[tuple[float, ...]](), cell._stop_where_pressed

    def weighed(force_N: float) -> None:
        rows.append((force_N, *cell.world.T_base_body("cube")[:3, 3]))
        stop(force_N)

    monkeypatch.setattr(cell, "_stop_where_pressed", weighed)
    execute_plan(cell, planned(task, starts, NO_ERROR, cell, cell_file))
    force_N, place_m = np.array(rows)[:, 0], np.array(rows)[:, 1:]
    speed_m_s = np.gradient(place_m, 0.008, axis=0)
    faster = np.gradient(speed_m_s, 0.008, axis=0) + np.array([0.0, 0.0, 9.81])
    mass_kg = task.objects["cube"].mass_kg * cell.hidden.mass_scale
    ratio = (force_N / (mass_kg * np.linalg.norm(faster, axis=1)))[place_m[:, 2] > 0.2]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
    assert np.median(np.abs(ratio - 1.0)) < 0.05
    assert 0 < force_N.max() < ROBOT.contact_force_N / 4
    assert cell.stopped == ""


def test_a_press_beyond_the_robots_limit_stops_the_arm_and_fails_the_trial(
    cell: StandinCell, starts: Any, task: Task
) -> None:
    way = [cell.home_rad]
    for height_m in (0.06, -0.03):
        T_base_tcp = tool_down(np.array([0.45, 0.0, height_m]), 0.0)
        way.append(cell.kinematics.joints_for(T_base_tcp, way[-1]))
    cell.follow(np.array([0, 2_000_000_000, 4_000_000_000]), np.stack(way))
    (event,) = cell.streams._session.events()  # type: ignore[attr-defined]
    assert (event["type"], event["data"]["cause"]) == ("mark", "contact_force")
    assert ROBOT.contact_force_N < event["data"]["force_N"] < 2 * ROBOT.contact_force_N
    words = r"contact_force: the arm is pressed with \d+ N, the limit is 150 N"
    assert re.fullmatch(words, cell.stopped)
    held, stopped_ns = cell.target_rad, cell.now_ns
    cell.follow(np.array([0, 1_000_000_000]), np.stack([held, cell.home_rad]))
    cell.wait(1.0)
    assert cell.now_ns == stopped_ns + 1_000_000_000  # nothing was followed
    np.testing.assert_allclose(cell.encoders_rad, held, atol=0.005)
    label = label_trial(task, cell.truth, executed=True, remark="no", stopped=cell.stopped)
    assert (label.result, label.k) == ("failure", 0)
    assert label.detail.startswith(cell.stopped)
    cell.reset(starts)
    assert cell.stopped == ""


def test_the_same_seed_gives_the_same_joint_log_and_another_seed_another(
    make_session: Callable[..., Any],
    make_cell: Callable[..., StandinCell],
    starts: dict[str, np.ndarray],
) -> None:
    def joint_log(seed: int) -> str:
        session = make_session()
        cell = make_cell(session, seed=seed)
        cell.reset(starts)
        target = cell.home_rad + np.array([0.3, 0, 0, 0, 0, 0.2])
        cell.grip(0.0)
        cell.follow(np.array([0, 400_000_000]), np.stack([cell.home_rad, target]))
        log = b"".join(item.data for item in session.of("/joint_states"))
        assert len(session.of("/joint_states")) == 50
        return hashlib.sha256(log).hexdigest()

    assert joint_log(9_000_001) == joint_log(9_000_001)
    assert joint_log(9_000_001) != joint_log(9_000_002)


def test_encoders_are_off_by_the_hidden_offset(
    make_session: Callable[..., Any],
    make_cell: Callable[..., StandinCell],
    nominal: HiddenParameters,
    starts: dict[str, np.ndarray],
) -> None:
    offset = np.array([0.01, -0.01, 0.02, 0.0, 0.005, -0.02])
    session = make_session()
    cell = make_cell(session, hidden=replace(nominal, joint_offset_rad=offset))
    cell.reset(starts)
    cell.wait(0.4)
    said = np.mean([JointSample.from_cdr(i.data).position for i in session.of("/joint_states")], 0)
    # The servos sag less than a milliradian; encoder noise is twenty times smaller.
    np.testing.assert_allclose(said - cell.world.joints_rad, offset, atol=1e-3)
    np.testing.assert_allclose(said, cell.home_rad, atol=1e-3)


def test_a_command_acts_after_the_latency_and_not_before(
    task: Task, nominal: HiddenParameters, starts: dict[str, np.ndarray], cell_file: CellFile
) -> None:
    latency_s = 0.06
    world = World(task, replace(nominal, latency_s=latency_s))
    home = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
    world.reset(home, starts)
    for _ in range(100):
        world.step()
    before = world.joints_rad
    world.command(home + np.array([0.2, 0, 0, 0, 0, 0]), 0.085)
    moved_at = None
    for step in range(1, 101):
        world.step()
        if moved_at is None and abs(world.joints_rad[0] - before[0]) > 1e-5:
            moved_at = step * STEP_S
    assert moved_at == pytest.approx(latency_s, abs=3 * STEP_S)


def test_the_gripper_pushes_with_its_hidden_force(
    task: Task, nominal: HiddenParameters, starts: dict[str, np.ndarray]
) -> None:
    def width_error(grip_N: float) -> float:
        world = World(task, replace(nominal, grip_N=grip_N, latency_s=0.0))
        world.reset(np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308]), starts)
        world.command(np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308]), 0.0)
        for _ in range(20):
            world.step()
        return world.width_m

    assert width_error(22.0) < width_error(4.0)


def test_objects_stand_still_where_they_are_put(
    task: Task, nominal: HiddenParameters, starts: dict[str, np.ndarray]
) -> None:
    world = World(task, nominal)
    world.reset(np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308]), starts)
    for _ in range(200):
        world.step()
    for object_id, T in world.Ts_base_object().items():
        assert np.abs(T - starts[object_id]).max() < 0.001
    assert world.finger_contact() == {"cube": False, "box": False}


def test_a_seed_draws_one_laboratory_within_the_ranges_of_the_cell_file(
    cell_file: CellFile,
) -> None:
    drawn = draw_hidden(cell_file, 9_000_003)
    assert drawn.to_record() == draw_hidden(cell_file, 9_000_003).to_record()
    assert drawn.to_record() != draw_hidden(cell_file, 9_000_004).to_record()
    for name, (low, high) in cell_file.uniform.items():
        assert low <= getattr(drawn, name) <= high


def test_an_unknown_cell_lists_those_that_exist() -> None:
    with pytest.raises(UsageError, match="standin"):
        load_cell("no_such_cell")


def test_a_cell_like_another_differs_in_what_it_names_only(tmp_path: Path) -> None:
    path = tmp_path / "calm.toml"
    path.write_text(
        'name = "calm"\nlike = "standin_toys"\n'
        "[hidden.uniform]\ngrip_N = [8.0, 9.0]\n"
        "[planner.five_ducks_into_basket]\nrelease_m = 0.01\n"
    )
    calm, toys = load_cell(str(path)), load_cell("standin_toys")
    assert (calm.name, calm.uniform) == ("calm", {**toys.uniform, "grip_N": (8.0, 9.0)})
    assert calm.planner == toys.planner
    ducks = "five_ducks_into_basket"
    assert calm.noise_for(ducks) == replace(toys.noise_for(ducks), release_m=0.01)
    assert (calm.sensors, calm.normal) == (toys.sensors, toys.normal)
    assert len(calm.clutter) == len(toys.clutter)
