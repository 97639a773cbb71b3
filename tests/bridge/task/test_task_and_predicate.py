"""Task files: which one counts, what it holds, and the hard success predicate."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.data_files import datasets_folder
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task import find, predicate
from bridge.task.check import TaskFileError
from bridge.task.task_file import Task, TaskFile, load_task


@pytest.fixture
def task() -> Task:
    return load_task("cube_into_box")


def rollout(
    task: Task,
    p_box_cube: tuple[float, float, float],
    *,
    yaw_rad: float = 0.3,
) -> predicate.Rollout:
    steps = 50
    stamps_ns = np.arange(steps, dtype=np.int64) * 20_000_000
    q = np.array([np.cos(yaw_rad / 2), 0, 0, np.sin(yaw_rad / 2)])
    T_base_box = se3.transform_from(q, np.array([0.5, 0.2, 0.0]))
    end = se3.apply(T_base_box, np.array(p_box_cube))
    Ts_cube = np.tile(np.eye(4), (steps, 1, 1))
    Ts_cube[:, :3, 3] = end
    return predicate.Rollout(
        stamps_ns=stamps_ns,
        Ts_base_object={"cube": Ts_cube, "box": np.tile(T_base_box, (steps, 1, 1))},
        finger_contact={"cube": np.zeros(steps, dtype=bool)},
    )


def succeeded(task: Task, state: predicate.Rollout) -> bool | None:
    return predicate.all_hold(predicate.evaluate_success(task, state))


def test_a_cube_at_rest_in_the_box_is_a_success(task: Task) -> None:
    assert succeeded(task, rollout(task, (0.02, -0.03, 0.026))) is True


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


CUBE = (datasets_folder() / "tasks" / "cube_into_box.toml").read_bytes()
HEAVY = CUBE.replace(b"mass_kg = 0.05", b"mass_kg = 0.5")
SLOTH = (datasets_folder() / "tasks" / "sloth_into_basket.toml").read_bytes()


def sha256_of(data: bytes) -> str:
    return TaskFile(data, "").sha256


def test_the_episodes_own_file_comes_before_the_runs_and_that_before_the_shipped(
    tmp_path: Path,
) -> None:
    name = "cube_into_box"
    assert find.find_task_file(name, tasks_dir=tmp_path).data == CUBE
    (tmp_path / f"{name}.toml").write_bytes(HEAVY)
    assert find.find_task_file(name, tasks_dir=tmp_path).data == HEAVY
    assert find.find_task_file(name, tasks_dir=tmp_path).task().objects["cube"].mass_kg == 0.5
    own = CUBE + b"# mine"
    attached = find.Attached(sha256_of(own), own, "trial_1.mcap")
    assert find.find_task_file(name, tasks_dir=tmp_path, attached=attached).data == own


def test_only_the_very_text_that_was_recorded_with_will_do(tmp_path: Path) -> None:
    own = CUBE + b"# mine"
    lost = find.Attached(sha256_of(own), None, "trial_1.mcap")
    (tmp_path / "cube_into_box.toml").write_bytes(HEAVY)
    with pytest.raises(find.MissingTaskError) as caught:
        find.find_task_file("cube_into_box", tasks_dir=tmp_path, attached=lost)
    message = str(caught.value)
    assert "trial_1.mcap: carries no task.toml" in message
    assert f"another file, its sha256 is {sha256_of(HEAVY)[:12]}" in message
    find.keep_task_file(tmp_path, "cube_into_box", own)
    assert find.find_task_file("cube_into_box", tasks_dir=tmp_path, attached=lost).data == own


def test_an_attachment_of_another_hash_is_not_used(tmp_path: Path) -> None:
    swapped = find.Attached(sha256_of(CUBE + b"#"), HEAVY, "trial_1.mcap")
    with pytest.raises(find.MissingTaskError, match=r"task\.toml in trial_1\.mcap: damaged"):
        find.find_task_file("cube_into_box", tasks_dir=tmp_path, attached=swapped)


def test_a_missing_task_says_where_it_looked_what_is_there_and_what_was_meant(
    tmp_path: Path,
) -> None:
    (tmp_path / "cube_onto_block.toml").write_bytes(CUBE)
    with pytest.raises(find.MissingTaskError) as caught:
        find.find_task_file("cube_onto_blok", tasks_dir=tmp_path)
    message = str(caught.value)
    assert f"{tmp_path}: cube_onto_block. Did you mean 'cube_onto_block'?" in message
    assert "five_ducks_into_basket, heavy_block_into_box, push_cube_to_mark" in message
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("name", ["../cube_into_box", "/etc/passwd", "", ".", "a/b", "*"])
def test_a_name_never_leads_out_of_the_folders(name: str, tmp_path: Path) -> None:
    run = tmp_path / "tasks"
    run.mkdir()
    (tmp_path / "cube_into_box.toml").write_bytes(HEAVY)
    with pytest.raises(find.MissingTaskError):
        find.find_task_file(name, tasks_dir=run)


def test_a_person_may_name_a_file_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "my_task.toml"
    path.write_bytes(HEAVY)
    assert find.chosen_task_file(str(path)).data == HEAVY
    with pytest.raises(UsageError, match="cannot be read"):
        find.chosen_task_file(str(tmp_path / "none.toml"))
    with pytest.raises(TaskFileError):
        TaskFile(b"name = 1", "x").task()


def test_a_file_that_is_there_is_never_overwritten(tmp_path: Path) -> None:
    folder = tmp_path / "tasks"
    first = find.keep_task_file(folder, "t", CUBE)
    again = find.keep_task_file(folder, "t", CUBE)
    other = find.keep_task_file(folder, "t", HEAVY)
    assert (first.name, again, other.name) == ("t.toml", first, f"t.{sha256_of(HEAVY)[:12]}.toml")
    assert (first.read_bytes(), other.read_bytes()) == (CUBE, HEAVY)
    assert find.keep_task_file(folder, "t", HEAVY) == other
    assert len(list(folder.iterdir())) == 2


def test_several_tasks_have_the_objects_of_all() -> None:
    joined = find.union_of([TaskFile(CUBE, "a"), TaskFile(SLOTH, "b"), TaskFile(CUBE, "c")])
    assert joined is not None
    assert list(joined.objects) == ["cube", "box", "sloth", "basket"]
    assert set(joined.containers) == {"box", "basket"}
    assert find.union_of([]) is None


def test_one_object_with_two_definitions_is_an_error_that_names_both_files() -> None:
    with pytest.raises(UsageError, match=r"'cube' .* run/a\.toml and in run/b\.toml"):
        find.union_of([TaskFile(CUBE, "run/a.toml"), TaskFile(HEAVY, "run/b.toml")])
