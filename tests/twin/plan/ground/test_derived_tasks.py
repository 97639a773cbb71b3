"""Task files made of instructions: valid, the same each time, by rules that know kinds only."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planned_start import CUBE, write_episode

import robot_gst
from bridge.data_files import datasets_folder
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.task.task_file import Task, TaskFile
from twin.plan.ground.derive import derive_task
from twin.plan.ground.grammar import ground
from twin.plan.ground.run_tasks import keep, task_files_of, understand
from twin.plan.ground.vocabulary import GroundingError, vocabulary_of

STACK = TaskFile.read(datasets_folder() / "tasks" / "stack_two_cubes.toml")


SORT = TaskFile.read(datasets_folder() / "tasks" / "sort_by_colour.toml")


def derived(text: str, *base: TaskFile) -> Task:
    words = vocabulary_of(base[0].task())
    return derive_task(ground(text, words), base).task()


def pairs(task: Task, number: int) -> set[frozenset[str]]:
    return {frozenset(pair) for pair in task.stages[number]["allowed_contacts"]}


def test_cubes_that_are_named_by_their_colour_alone_are_cubes() -> None:
    one = derived("Put the red cube into the pink box.", SORT)
    assert one.manipulated == ("red",)
    assert {(spec["kind"], spec["object"]) for spec in one.success} >= {("inside", "red")}
    whole = derived(SORT.task().instruction, SORT)
    assert set(whole.manipulated) == {"red", "yellow", "blue", "green"}
    with pytest.raises(GroundingError, match="cube"):
        derived("Put the cube into the pink box.", SORT)


def test_an_instruction_becomes_the_task_that_ships() -> None:
    task = derived("Put the red cube into the box.", CUBE)
    ships = CUBE.task()
    assert task.objects == ships.objects
    assert task.start == ships.start
    assert task.manipulated == ships.manipulated
    assert task.containers == ships.containers
    plain = [{k: v for k, v in spec.items() if k != "margin_m"} for spec in ships.success]
    assert list(task.success) == plain
    assert [set(stage) & {"grasp", "carry", "release"} for stage in task.stages] == [
        {"grasp"},
        {"carry"},
        {"release"},
    ]
    allowed = set().union(*(pairs(task, n) for n in range(3)))
    wanted = {frozenset(p) for stage in ships.stages for p in stage["allowed_contacts"]}
    assert allowed == wanted
    assert task.derived is not None
    assert task.derived["by"] == "grammar"
    assert task.derived["tasks"] == ["cube_into_box"]
    assert ships.derived is None


def test_a_stack_may_touch_what_it_stands_on_and_nothing_else() -> None:
    task = derived("Stack red on blue", STACK)
    assert pairs(task, 0) == {
        frozenset(("lower", "table")), frozenset(("cube", "table")), frozenset(("gripper", "cube"))
    }  # fmt: skip
    assert pairs(task, 1) == {frozenset(("lower", "table")), frozenset(("gripper", "cube"))}
    assert pairs(task, 2) == pairs(task, 1) | {frozenset(("cube", "lower"))}


def test_the_same_instruction_gives_the_same_bytes_and_another_one_another_name() -> None:
    words = vocabulary_of(CUBE.task())
    first, again = (derive_task(ground("Put the cube in the box", words), [CUBE]) for _ in range(2))
    assert first.data == again.data
    other = derive_task(ground("Put the cube into the box", words), [CUBE])
    assert other.task().name != first.task().name


TEXTS = (
    "put the cube left of the box",
    "move the cube 10 cm to the right",
    "take the cube out of the box and put it on the table",
    "put the cube behind the box with a gap of 1 to 3 cm, upright",
)


@pytest.mark.parametrize("text", TEXTS)
def test_every_kind_of_goal_makes_a_valid_file(text: str) -> None:
    task = derived(text, CUBE)
    assert task.instruction == text
    assert {spec["kind"] for spec in task.success} >= {"settled", "no_finger_contact"}


@settings(max_examples=25, deadline=None)
@given(st.text(alphabet="aé\"\\'\n\t\x7f\x00🙂 ", max_size=20))
def test_no_words_break_the_file(odd: str) -> None:
    found = ground("put the cube into the box", vocabulary_of(CUBE.task()))
    assert derive_task(replace(found, text=f"put {odd}"), [CUBE]).task().instruction == f"put {odd}"


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    folder = RunFolder.create(tmp_path / "run")
    for name in "ab":
        write_episode(folder.episodes_dir / f"{name}.mcap")
    return folder


def test_the_objects_are_those_of_the_episodes(run: RunFolder, tmp_path: Path) -> None:
    assert [file.task().name for file in task_files_of(run)] == ["cube_into_box"]
    understood = understand(run, "put the red cube into the box")
    path = keep(run, understood)
    assert path is not None
    assert TaskFile.read(path).task().derived is not None
    assert keep(run, understood) == path
    named = understand(run, understood.file.task().name)
    assert named.grounding is None
    assert named.file.data == understood.file.data
    with pytest.raises(UsageError, match="says which objects"):
        understand(RunFolder.create(tmp_path / "other"), "put the red cube into the box")


def test_the_command_prints_what_was_understood(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["plan", str(run.path), "--task"]
    assert robot_gst.run([*command, "put the crimson block into the box", "--dry"]) == 0
    said = capsys.readouterr().out
    assert "the middle of cube is inside box" in said
    assert "'the crimson block' is cube (red cube): the only one that fits" in said
    assert "3. release: releases cube" in said
    assert not run.tasks_dir.exists()
    assert robot_gst.run([*command, "put the cube into the box", "--dry", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["grounding"]["goals"] == [{"kind": "inside", "object": "cube", "container": "box"}]
    assert data["file"] is None
    assert keep(run, understand(run, "put the cube into the box")) is not None
    assert robot_gst.run([*command, data["task"], "--dry"]) == 0
    assert robot_gst.run([*command, "cube_into_box", "--dry"]) == 0


def test_what_was_not_localised_ends_with_1_and_writes_nothing(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(run.path.rglob("*"))
    assert robot_gst.run(["plan", str(run.path), "--task", "put the cube into the box"]) == 1
    said = capsys.readouterr().err
    assert "not localised: cube" in said
    assert "record again" in said
    assert sorted(run.path.rglob("*")) == before


def test_objects_that_only_another_task_shows_are_no_part_of_the_derived_one(
    run: RunFolder,
) -> None:
    other = TaskFile.read(datasets_folder() / "tasks" / "cube_on_block.toml")
    write_episode(run.episodes_dir / "c.mcap", other, kind="trial")
    assert set(understand(run, "put the cube into the box").file.task().objects) == {"cube", "box"}
    onto = understand(run, "put the cube on the block").file.task()
    assert set(onto.objects) == set(other.task().objects)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("put the green cube into the box", "no 'the green cube' here. There is: cube"),
        ("   ", "the instruction asks for nothing"),
        ("put the box onto the cube", "nothing can move it. What can be moved: cube.\n"),
        ("put the cube into the box and take it out of the box", "Leave one of them out.\n"),
        ("juggle the cube", "nobody here can 'juggle'"),
        ("put the cube into the box; $(reboot)", "not understood"),
        ("no_such_task", "no task named"),
        ("x" * 10_000, "2000 is the most"),
        ("put " * 3_000, "2000 is the most"),
    ],
)
def test_what_is_not_understood_ends_with_2_and_writes_nothing(
    run: RunFolder, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    assert robot_gst.run(["plan", str(run.path), "--task", text]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert not run.tasks_dir.exists()
