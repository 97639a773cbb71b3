"""Task files are checked strictly, by name and place; ``task new`` writes one that passes."""

import contextlib
import json
from importlib import resources
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robot_gst
from bridge.cli import tasks
from bridge.data_files import datasets_folder
from bridge.task.check import TaskFileError
from bridge.task.meshes.toys import DESIGNS
from bridge.task.predicate import _RULES
from bridge.task.record import schema_of
from bridge.task.summary import _WORDS
from bridge.task.task_file import MAX_BYTES, Task, TaskFile, load_task

SHIPPED = sorted((datasets_folder() / "tasks").glob("*.toml"))
CUBE = (datasets_folder() / "tasks" / "cube_into_box.toml").read_text()
SCHEMA = json.loads(resources.files("bridge.task").joinpath("schemas/task.schema.json").read_text())


def problems(text: str) -> tuple[str, ...]:
    with pytest.raises(TaskFileError, match=r"^my_task\.toml is not a task file") as caught:
        TaskFile(text.encode(), "my_task.toml").task()
    assert caught.value.exit_code == 2
    return caught.value.problems


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_what_is_shipped_is_right_and_named_like_its_file(path: Path) -> None:
    assert TaskFile.read(path).task().name == path.stem


@pytest.mark.parametrize(
    ("old", "new", "place", "said"),
    [
        ('container = "box"', 'contianer = "box"', "success[0]", "Did you mean 'container'?"),
        ('container = "box"', 'container = "bok"', "success[0].container", "Did you mean 'box'?"),
        ('container = "box"', 'container = "cube"', "success[0].container", "no container"),
        ('kind = "settled"', 'kind = "setled"', "success[1].kind", "Did you mean 'settled'?"),
        ("max_speed_m_s", "max_speed", "success[1]", "Did you mean 'max_speed_m_s'?"),
        ("for_s = 0.3", "for_s = -0.3", "success[1].for_s", "the minimum of 0"),
        ("for_s = 0.3", "for_s = nan", "success[1].for_s", "nan is not a number"),
        ("[0.04, 0.04, 0.04]", "[0.04, -0.04, 0.04]", "objects.cube.size_m[1]", "the minimum of 0"),
        ("[0.04, 0.04, 0.04]", "[0.04, inf, 0.04]", "objects.cube.size_m[1]", "inf is not"),
        ("[0.04, 0.04, 0.04]", "[0.04, 0.04]", "objects.cube.size_m", "less than 3 items"),
        ("[0.04, 0.04, 0.04]", '["4 cm", 1, 1]', "objects.cube.size_m[0]", "not of type"),
        ("mass_kg = 0.05", "mass_kg = true", "objects.cube.mass_kg", "not of type"),
        ("[0.40, 0.58]", "[0.58, 0.40]", "start.cube.x_m", "from 0.58 down to 0.4"),
        ("[start.cube]", "[start.cub]", "start.cub", "Did you mean 'cube'?"),
        ("[start.box]", "[start.bin]", "start", "says nothing of box"),
        ('grasp = "cube"', 'grasp = "ball"', "stages[0].grasp", "no object 'ball'"),
        ('grasp = "cube"', 'grasp = "box"', "stages[0].grasp", "not in manipulated"),
        ('grasp = "cube"', 'push = "cube"', "stages[0].push", "where cube is to be moved"),
        ('grasp = "cube"', 'grasp = "cube"\npush = "cube"', "stages[0].push", "neither grasps"),
        ('grasp = "cube"', 'grasp = "cube"\nspeed_m_s = 0.1', "stages[0].speed_m_s", "to push"),
        ('grasp = "cube"', 'push = "cube"\nspeed_m_s = 0', "stages[0].speed_m_s", "minimum of 0"),
        ('grasp = "cube"', 'grasp = "cube"\nclearance_m = 0.1', "stages[0].clearance_m", "carry"),
        ('["gripper", "cube"]]\n\n', '["griper", "cube"]]\n\n', "stages[0].allowed_contacts[1]",
         "Did you mean 'gripper'?"),
        ('grasp = "cube"', 'grasp = "cube"\npath = [{kind = "upright", obj = "cube", max_deg = 5}]',
         "stages[0].path[0]", "'max_deg'. Did you mean 'tolerance_rad'?"),
        ('grasp = "cube"', 'grasp = "cube"\npart = "handle"', "stages[0]",
         "'part'. Leave it out: grasps are sought on the whole object. Allowed: "),
        ('id = "place"', 'id = "grasp"', "stages[1].id", "already"),
        ('manipulated = ["cube"]', 'manipulated = ["box"]', "manipulated[0]", "fixed"),
        ('containers = ["box"]', 'containers = ["cube"]', "containers[0]", "no container"),
        ('shape = "open_box"', 'shape = "openbox"', "objects.box.shape", "'open_box'?"),
        ("wall_m = 0.006", "wall = 0.006", "objects.box", "Did you mean 'wall_m'?"),
        ("[objects.cube]", "[objects.gripper]", "objects.gripper", "cannot be called so"),
        ('name = "cube_into_box"', 'name = "../box"', "name", "does not match"),
        ("schema_version = 1", "schema_version = 2", "schema_version", "newer than the 1"),
        ('instruction = "', 'grip_force_N = 0\ninstruction = "', "grip_force_N", "minimum of 0"),
    ],
)  # fmt: skip
def test_an_error_says_where_it_is_and_what_was_probably_meant(
    old: str, new: str, place: str, said: str
) -> None:
    assert old in CUBE
    found = problems(CUBE.replace(old, new))
    assert any(text.startswith(f"{place}: ") and said in text for text in found), found


def test_all_errors_are_listed_and_not_only_the_first() -> None:
    broken = CUBE.replace("for_s = 0.3", "for_s = 0").replace('container = "box"', "box = 1")
    broken = broken.replace("x_m = [0.40, 0.58]", "x_m = [0.40, 0.58, 1]")
    places = {text.partition(":")[0] for text in problems(broken)}
    assert places == {"success[1].for_s", "success[0]", "start.cube.x_m"}


def test_a_file_as_long_as_a_book_is_refused_unread() -> None:
    assert problems(CUBE + "#" * MAX_BYTES) == ("longer than 64 KiB",)


@pytest.mark.parametrize("text", ["", "name = ", "a = [" + "[" * 5000, "\x00", "a.b.c=1\na=2"])
def test_what_is_not_toml_is_refused(text: str) -> None:
    assert len(problems(text)) >= 1


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_a_damaged_file_is_a_task_or_is_refused(data: st.DataObject) -> None:
    lines = CUBE.splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(lines) - 1))
        key = lines[at].partition("=")[0]
        values = ["1", "-1", "nan", "[]", "[[1]]", '"cube"', "{}", "true", "1979-05-27"]
        lines[at] = data.draw(st.sampled_from(["", *(f"{key}= {value}" for value in values)]))
    with contextlib.suppress(TaskFileError):
        assert isinstance(TaskFile("\n".join(lines).encode(), "x").task(), Task)


def test_nothing_lies_on_what_is_open_above() -> None:
    broken = CUBE.replace('kind = "inside"', 'kind = "on"').replace("container = ", "support = ")
    assert problems(broken)[0].startswith("success[0].support: box is open above")


def test_the_schema_knows_every_predicate_and_every_toy_and_no_other() -> None:
    kinds = SCHEMA["$defs"]["predicate"]["properties"]["kind"]["enum"]
    assert kinds == sorted(_RULES)
    for kind in kinds:
        assert SCHEMA["$defs"][kind]["properties"]["kind"]["const"] == kind
    assert SCHEMA["$defs"]["toy"]["properties"]["mesh"]["enum"] == sorted(DESIGNS)


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
