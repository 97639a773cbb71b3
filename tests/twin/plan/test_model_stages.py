"""``plan RUN --task --model``: a stub server on the loopback adds constraints, or does not."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path += [str(Path(__file__).parent / "ground"), str(Path(__file__).parent / "constrain")]

from hostile_replies import TASK, valid_reply
from planned_start import problem_of_test
from test_model_client import SECRET, Server, says, serving
from verdicts import verdict_of

import robot_gst
from bridge.data_files import datasets_folder
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.task.find import ATTACHMENT, MEDIA_TYPE
from bridge.task.plan import Plan
from bridge.task.task_file import TaskFile
from bridge.task.verdict import Verdict
from twin.gate import twin_process
from twin.plan import model_stages, once
from twin.plan.constrain.relations import constraint_of, predicate_of
from twin.plan.constrain.reply import read_reply
from twin.plan.constrain.schema import Vocabulary

HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
TOP = {"obj": "cube", "anchor": "top"}
LOW = {"kind": "height", "a": TOP, "min": -0.01, "max": 0.5}
NEVER = {"kind": "height", "a": TOP, "min": 0.9}
INSIDE = {"kind": "inside", "obj": "cube", "container": "box"}


def reply(*path: dict[str, Any], task: str = TASK) -> dict[str, Any]:
    """A reply that puts the cube into the box, with these constraints on the way."""
    record: dict[str, Any] = valid_reply() | {"task": task}
    for stage in record["stages"]:
        stage |= {"subgoal": [], "path": []}
    record["stages"][1] |= {"subgoal": [INSIDE], "path": list(path)}
    return record


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    """A run of one episode whose start and twin are those of the tests."""
    folder = RunFolder.create(tmp_path / "run")
    file = TaskFile.read(datasets_folder() / "tasks" / "cube_into_box.toml")
    with EpisodeWriter(folder.episodes_dir / "a.mcap") as writer:
        info = EpisodeInfo(id="a", kind="scan", task=file.task().name, task_sha256=file.sha256)
        writer.describe(info)
        writer.attach(ATTACHMENT, file.data, media_type=MEDIA_TYPE, log_time_ns=1)

    def start_of(run: RunFolder, task: Any, config: Any, robot: str = "") -> once.Start:
        problem = problem_of_test()
        problem = replace(problem, scene=replace(problem.scene, task=task))
        episode = Episode.open(run.episodes()[0])
        urdf = problem.scene.urdf
        return once.Start(episode=episode, seen_ns=1, localised={}, problem=problem, urdf=urdf)

    def judge_of(path: Path, scene: Any) -> Callable[[Plan], Verdict]:
        return lambda plan: verdict_of(plan.id)

    monkeypatch.setattr(once, "start_of", start_of)
    monkeypatch.setattr(twin_process, "judge_of", judge_of)
    return folder


def planned(
    run: RunFolder,
    server: Server,
    capsys: pytest.CaptureFixture[str],
    *more: str,
    task: str = TASK,
) -> tuple[dict[str, Any], Plan]:
    command = ["plan", str(run.path), "--task", task, "--json"]
    asked = ["--model", server.url, "--model-name", "stub", *more]
    assert robot_gst.run([*command, *asked]) == 0, capsys.readouterr().err
    data = json.loads(capsys.readouterr().out)
    return data, Plan.from_json(Path(data["plan"]).read_bytes())


def test_what_the_model_adds_joins_the_stages_and_nothing_else(
    run: RunFolder, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GST_MODEL_KEY", SECRET)
    with serving(says(json.dumps(reply(LOW)))) as server:
        data, plan = planned(run, server, capsys)
    assert SECRET in server.headers[0]["Authorization"]
    assert (data["model"]["answered_by"], data["model"]["address"]) == ("model", server.url)
    assert plan.grounding_source == "model"
    assert [LOW in stage.path for stage in plan.stages] == [False, True, True]
    task = TaskFile.read(Path(data["file"])).task()
    assert task.derived is not None
    assert task.derived["by"] == "model"
    assert [dict(item) for item in task.success] == [
        dict(item) for item in plan.stages[-1].terminal
    ]
    assert [{frozenset(pair) for pair in stage.allowed_contacts} for stage in plan.stages] == [
        {frozenset(pair) for pair in table["allowed_contacts"]} for table in task.stages
    ]
    kept = [path.read_text() for path in run.derived_dir.rglob("*") if path.is_file()]
    assert kept
    assert not any(SECRET in text for text in kept)


def understood(
    run: RunFolder, server: Server, capsys: pytest.CaptureFixture[str], words: str
) -> dict[str, Any]:
    """What ``--dry`` prints."""
    asked = ["--model", server.url, "--model-name", "stub"]
    command = ["plan", str(run.path), "--task", words, "--dry", "--json", *asked]
    assert robot_gst.run(command) == 0, capsys.readouterr().err
    assert not run.tasks_dir.exists()
    assert not run.plans_dir.exists()
    return dict(json.loads(capsys.readouterr().out))


@pytest.mark.parametrize("words", ["Leg den roten Würfel in die Kiste", "tidy the cube away"])
def test_a_model_is_asked_before_the_grammar_refuses(
    run: RunFolder, capsys: pytest.CaptureFixture[str], words: str
) -> None:
    with serving(says(json.dumps(reply(LOW, task=words)))) as server:
        data = understood(run, server, capsys, words)
    assert len(server.asked) == 1
    sent = json.loads(server.asked[0]["messages"][1]["content"])
    assert sent["instruction"] == data["instruction"] == words
    assert sent["scene"]["contacts"] is None
    assert [each["movable"] for each in sent["scene"]["objects"]] == [True, False]
    assert data["grounding"]["goals"] == [{"kind": "inside", "object": "cube", "container": "box"}]
    assert [stage.get("grasp") for stage in data["stages"]] == ["cube", None, None]
    assert data["model"]["answered_by"] == data["derived"]["by"] == "model"


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ({"kind": "height", "a": TOP, "min": 0.0}, "no subgoal says where cube is to end"),
        ({"kind": "beside", "obj": "box", "reference": "cube"}, "unknown"),
        ({"kind": "moved", "obj": "cube", "by": 9.0, "way": "left"}, "greater than the maximum"),
        ({"kind": "inside", "obj": "cube", "container": "cube"}, "unknown"),
    ],
)
def test_goals_that_cannot_be_are_left_to_the_grammar(
    run: RunFolder, capsys: pytest.CaptureFixture[str], goal: dict[str, Any], said: str
) -> None:
    record = reply()
    record["stages"][1]["subgoal"] = [goal]
    with serving(says(json.dumps(record))) as server:
        data = understood(run, server, capsys, TASK)
    assert data["model"]["answered_by"] == data["derived"]["by"] == "grammar"
    assert any(said in remark for remark in data["model"]["remarks"])
    assert data["success"][0]["kind"] == "inside"


def test_where_nobody_understands_both_say_why(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(says("Sure!")) as server:
        command = ["plan", str(run.path), "--task", "juggle the cube"]
        asked = ["--model", server.url, "--model-name", "stub"]
        assert robot_gst.run([*command, *asked]) == 2
    said = capsys.readouterr().err
    assert "nobody here can 'juggle'" in said
    assert "refused the reply (model, repaired)" in said
    assert not run.tasks_dir.exists()


PLACES = (
    {"kind": "inside", "obj": "cube", "container": "box", "margin": 0.01},
    {"kind": "on", "obj": "cube", "support": "table", "tol": 0.01},
    {"kind": "outside", "obj": "cube", "container": "box"},
    {"kind": "beside", "obj": "cube", "reference": "box", "min_gap": 0.01, "max_gap": 0.02},
    {"kind": "beside", "obj": "cube", "reference": "box", "direction": "left"},
    {"kind": "moved", "obj": "cube", "by": 0.1, "way": "left", "tol": 0.02},
    {"kind": "moved", "obj": "cube", "at_least": 0.1, "vector": [1.0, 0.0, 0.0]},
)


@pytest.mark.parametrize("record", PLACES)
def test_a_goal_and_its_constraint_say_the_same_both_ways(record: dict[str, Any]) -> None:
    predicate = predicate_of(record)
    assert predicate is not None
    assert constraint_of(predicate, problem_of_test().scene.task) == record


@pytest.mark.parametrize(
    "record",
    [
        {"kind": "upright", "obj": "cube", "max_deg": 5.0},
    ],
)
def test_what_no_predicate_says_is_no_goal(record: dict[str, Any]) -> None:
    assert predicate_of(record) is None


def test_garbage_leaves_it_to_the_grammar(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(says("Sure! Here you go.")) as server:
        data, plan = planned(run, server, capsys)
    assert len(server.asked) == 2
    assert data["model"]["answered_by"] == plan.grounding_source == "grammar"
    assert not any(stage.path for stage in plan.stages)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_what_no_plan_keeps_is_left_out_and_said(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(says("no"), says(json.dumps(reply(NEVER)))) as server:
        data, plan = planned(run, server, capsys)
    assert data["model"]["answered_by"] == plan.grounding_source == "model, repaired"
    assert any("no plan keeps what the model added" in text for text in data["model"]["remarks"])
    assert not any(stage.path for stage in plan.stages)


def test_a_models_stages_find_those_of_the_task() -> None:
    """Grasp, way and release go where they belong; where things end is the task file's."""
    problem = problem_of_test()
    task = problem.scene.task
    record = reply()
    grasp, place = record["stages"]
    outside = {"kind": "outside", "obj": "cube", "container": "box"}
    grasp["subgoal"], place["subgoal"], place["path"] = [LOW], [INSIDE, outside], [NEVER]
    lift = {**place, "id": "lift", "subgoal": [NEVER], "path": [LOW], "allowed_contacts": []}
    del lift["release"]
    record["stages"] = [grasp, lift, place]
    stages = read_reply(json.dumps(record), Vocabulary.of_task(task), TASK)
    changed, remarks = model_stages.with_added(problem, stages)
    found = [(each.get("subgoal"), each.get("path")) for each in changed.scene.task.stages]
    assert found == [([LOW], None), (None, [LOW, NEVER])]  # this task carries as it releases
    assert len(remarks) == 3
    assert "height of stage lift: the task has no stage of its own to carry cube" in remarks[0]
    assert "inside of stage place" in remarks[1]  # with another margin than the task's
    assert "outside of stage place" in remarks[2]
    assert changed.scene.task.success == task.success
    carry = {"id": "carry", "carry": "cube", "text": "", "allowed_contacts": []}
    three = replace(task, stages=(task.stages[0], carry, task.stages[1]))
    problem = replace(problem, scene=replace(problem.scene, task=three))
    changed, _ = model_stages.with_added(problem, stages)
    found = [(each.get("subgoal"), each.get("path")) for each in changed.scene.task.stages]
    assert found == [([LOW], None), ([NEVER], [LOW]), (None, [NEVER])]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--model", "http://127.0.0.1:9/v1"], "--model-name"),
        (["--policy", "model"], "--model URL"),
        (["--model", "nowhere", "--model-name", "m"], "must begin with http"),
    ],
)
def test_half_a_model_is_wrong_use(
    run: RunFolder, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    assert robot_gst.run(["plan", str(run.path), "--task", TASK, *options]) == 2
    assert said in capsys.readouterr().err
    assert not run.tasks_dir.exists()
