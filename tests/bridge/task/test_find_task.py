"""Which task file counts: the episode's own, then the run's, then a shipped one."""

from pathlib import Path

import pytest

from bridge.data_files import datasets_folder
from bridge.errors import UsageError
from bridge.task import find
from bridge.task.check import TaskFileError
from bridge.task.task_file import TaskFile

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
