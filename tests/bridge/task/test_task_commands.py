"""``task new`` writes a file that ``task check`` accepts, and both say what is wrong."""

import json
from pathlib import Path

import pytest

import robot_gst
from bridge.cli import tasks
from bridge.data_files import datasets_folder
from bridge.task.predicate import _RULES
from bridge.task.record import schema_of
from bridge.task.summary import _WORDS
from bridge.task.task_file import load_task

NAMES = sorted(path.stem for path in (datasets_folder() / "tasks").glob("*.toml"))


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_a_new_file_is_right_and_is_never_overwritten(capsys: pytest.CaptureFixture[str]) -> None:
    assert robot_gst.run(["task", "new", "cube_onto_block"]) == 0
    path = Path("cube_onto_block.toml")
    assert load_task(str(path)).name == "cube_onto_block"
    path.write_text(path.read_text().replace("the red cube", "my cube"))
    before = path.read_bytes()
    assert robot_gst.run(["task", "new", "cube_onto_block"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert robot_gst.run(["task", "check", str(path)]) == 0
    said = capsys.readouterr().out
    assert "cube rests on block" in said
    assert "1. grasp: grasps cube; may touch: cube and table, gripper and cube" in said


@pytest.mark.parametrize("name", NAMES)
def test_a_copy_differs_from_its_model_in_the_name_only(name: str) -> None:
    assert tasks.task_new("mine", like=name) == 0
    model = (datasets_folder() / "tasks" / f"{name}.toml").read_text()
    copy = Path("mine.toml").read_text()
    assert copy == model.replace(f'name = "{name}"', 'name = "mine"')
    assert tasks.task_new("again", like="mine.toml") == 0
    assert load_task("again.toml").objects == load_task(name).objects


@pytest.mark.parametrize("name", ["../evil", "a b", "", "x" * 81])
def test_a_name_that_is_no_file_name_is_refused(name: str) -> None:
    assert robot_gst.run(["task", "new", name]) == 2
    assert not list(Path().rglob("*.toml"))


def test_every_problem_of_every_file_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    tasks.task_new("a")
    text = Path("a.toml").read_text()
    Path("b.toml").write_text(text.replace("for_s", "for").replace('"block"', '"blok"'))
    capsys.readouterr()
    assert robot_gst.run(["task", "check", "a.toml", "b.toml", "none.toml", "--json"]) == 2
    first, second, third = json.loads(capsys.readouterr().out)["files"]
    assert (first["ok"], second["ok"], third["ok"]) == (True, False, False)
    assert first["task"]["instruction"] == load_task("a.toml").instruction
    assert len(second["problems"]) == 2
    assert "none.toml cannot be read" in third["problems"][0]


def test_every_predicate_and_way_can_be_said_in_words() -> None:
    forms = schema_of("task")["$defs"].items()
    kinds = {name for name, form in forms if "const" in form.get("properties", {}).get("kind", {})}
    assert set(_WORDS) == kinds >= set(_RULES)
