"""Task files and the hard success predicate."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.data_files import dataset_file
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task import predicate
from bridge.task.task_file import Task, load_task


@pytest.fixture
def task() -> Task:
    return load_task("cube_into_box")


def rollout(
    task: Task,
    p_box_cube: tuple[float, float, float],
    *,
    speed_m_s: float = 0.0,
    touching: bool = False,
    yaw_rad: float = 0.3,
) -> predicate.Rollout:
    steps = 50
    stamps_ns = np.arange(steps, dtype=np.int64) * 20_000_000
    q = np.array([np.cos(yaw_rad / 2), 0, 0, np.sin(yaw_rad / 2)])
    T_base_box = se3.transform_from(q, np.array([0.5, 0.2, 0.0]))
    end = se3.apply(T_base_box, np.array(p_box_cube))
    Ts_cube = np.tile(np.eye(4), (steps, 1, 1))
    Ts_cube[:, :3, 3] = end
    Ts_cube[:, 0, 3] -= speed_m_s * (stamps_ns[-1] - stamps_ns) * 1e-9
    return predicate.Rollout(
        stamps_ns=stamps_ns,
        Ts_base_object={"cube": Ts_cube, "box": np.tile(T_base_box, (steps, 1, 1))},
        finger_contact={"cube": np.full(steps, touching)},
    )


def succeeded(task: Task, state: predicate.Rollout) -> bool | None:
    return predicate.all_hold(predicate.evaluate_success(task, state))


def test_a_cube_at_rest_in_the_box_is_a_success(task: Task) -> None:
    assert succeeded(task, rollout(task, (0.02, -0.03, 0.026))) is True


@pytest.mark.parametrize("p", [(0.09, 0.0, 0.026), (0.0, 0.0, 0.08), (0.0, -0.09, 0.026)])
def test_a_cube_outside_the_cavity_is_a_failure(task: Task, p: tuple[float, float, float]) -> None:
    assert succeeded(task, rollout(task, p)) is False


def test_a_moving_cube_is_not_settled(task: Task) -> None:
    assert succeeded(task, rollout(task, (0, 0, 0.026), speed_m_s=0.1)) is False


def test_a_cube_still_held_is_not_a_success(task: Task) -> None:
    assert succeeded(task, rollout(task, (0, 0, 0.026), touching=True)) is False


def test_unknown_contact_leaves_the_verdict_open(task: Task) -> None:
    state = rollout(task, (0, 0, 0.026))
    unknown = predicate.Rollout(
        stamps_ns=state.stamps_ns, Ts_base_object=state.Ts_base_object, finger_contact={}
    )
    assert succeeded(task, unknown) is None


def test_an_object_nobody_found_leaves_the_verdict_open(task: Task) -> None:
    state = rollout(task, (0, 0, 0.026))
    blind = predicate.Rollout(
        stamps_ns=state.stamps_ns,
        Ts_base_object={"box": state.Ts_base_object["box"]},
        finger_contact={},
    )
    assert succeeded(task, blind) is None


@given(st.floats(-3, 3), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_turning_the_whole_scene_changes_nothing(yaw: float, x: float, y: float) -> None:
    task = load_task("cube_into_box")
    p = (x, y, 0.026)
    turned = succeeded(task, rollout(task, p, yaw_rad=yaw))
    assert turned == succeeded(task, rollout(task, p, yaw_rad=0.0)) or (
        abs(abs(x) - 0.075) < 1e-9 or abs(abs(y) - 0.075) < 1e-9
    )


def test_a_goal_that_holds_before_anything_moves_is_noticed(task: Task) -> None:
    assert predicate.already_true_at_start(task, rollout(task, (0, 0, 0.026)))
    assert not predicate.already_true_at_start(task, rollout(task, (0.2, 0, 0.026)))


def test_starts_are_drawn_inside_their_ranges_and_repeat_with_the_seed(task: Task) -> None:
    for seed in range(20):
        poses = task.draw_start(np.random.default_rng(seed))
        again = task.draw_start(np.random.default_rng(seed))
        for object_id, T in poses.items():
            np.testing.assert_array_equal(T, again[object_id])
            limits = task.start[object_id]
            assert limits.x_m[0] <= T[0, 3] <= limits.x_m[1]
            assert limits.y_m[0] <= T[1, 3] <= limits.y_m[1]


def test_the_panels_of_the_open_box_leave_the_cavity_free(task: Task) -> None:
    box = task.objects["box"]
    inner = np.array(box.inner_m)
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * (inner / 2 - 1e-9)
    points += [0, 0, box.wall_m + inner[2] / 2]
    for centre, extents in box.panels():
        inside = np.all(np.abs(points - centre) < extents / 2 - 1e-12, axis=1)
        assert not inside.any()
    volume = sum(float(np.prod(extents)) for _, extents in box.panels())
    assert volume == pytest.approx(np.prod(box.size_m) - np.prod(inner))


def test_an_unknown_task_is_answered_with_those_that_exist() -> None:
    with pytest.raises(UsageError, match="cube_into_box"):
        load_task("juggle")


@pytest.mark.parametrize("name", ["../cells/standin", "/etc/passwd", "../../pyproject"])
def test_a_task_name_cannot_leave_its_folder(name: str) -> None:
    with pytest.raises(UsageError, match="no task named"):
        load_task(name)


def test_a_file_that_is_no_task_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "broken.toml"
    path.write_text("schema_version = 1\nname = 'x'\n")
    with pytest.raises(UsageError, match="not a task file"):
        load_task(str(path))


@pytest.mark.parametrize("force", ["0.0", "-9.0", "nan", "'strong'"])
def test_a_grip_that_is_no_force_is_refused(tmp_path: Path, force: str) -> None:
    text = dataset_file("tasks", "sloth_into_basket").read_text()
    path = tmp_path / "grip.toml"
    path.write_text(text.replace("grip_force_N = 9.0", f"grip_force_N = {force}"))
    with pytest.raises(UsageError, match="not a task file"):
        load_task(str(path))
