"""The gate with fakes for perception, localisation and replay: undecided is never yes."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gate_fakes import HOME, PLAN, URDF, FakePerception, accept, found, gate_with, raising

from bridge.task.find import chosen_task_file, find_task_file
from bridge.task.plan import Plan
from bridge.task.task_file import Task, load_task
from bridge.task.verdict import Factor, Verdict
from twin.errors import TwinError
from twin.gate import gate as gate_module
from twin.gate.gate import JudgedTasks, PlanTooLargeError, of_another_scene


def arm(**changes: Any) -> Any:
    return SimpleNamespace(**{**vars(HOME), **changes})


DAMAGED = '<robot name="ur5_parallel_gripper"><robot_gst>{}</robot_gst></robot>'


def test_the_verdict_is_the_replays_from_the_localised_poses() -> None:
    seen: dict[str, Any] = {}

    def replay(
        plan: Plan, task: Task, poses: dict[str, Any], urdf: str, start_rad: np.ndarray, _: float
    ) -> Verdict:
        seen.update(plan=plan, task=task, poses=poses, urdf=urdf, start_rad=start_rad)
        return replace(accept(plan, poses, urdf), terminal=Factor(value=False, cause="inside"))

    verdict = gate_with(replay=replay).judge(PLAN.to_json())
    assert verdict.accepted is False
    assert verdict.first_failing == "terminal"
    assert seen["plan"] == PLAN
    assert sorted(seen["poses"]) == ["box", "cube"]
    assert seen["urdf"] == URDF
    assert seen["start_rad"].tolist() == [0.0] * 6


def sees(**seen: Any) -> dict[str, Any]:
    return {"perception": FakePerception(**seen)}


LATE_NS = 2_000_000_000
TOO_OLD = "s old, and only those of the last 1 s say where"


@pytest.mark.parametrize(
    ("settings", "plan", "reason"),
    [
        (sees(seen=[]), PLAN, "no usable frames within 0 s: side: silent for 9.0 s"),
        (sees(description=None), PLAN, "no robot description"),
        (sees(arm=None), PLAN, "no joint states have arrived on /standin/joint_states"),
        (sees(arm=arm(names=("panda_joint1", "panda_joint2"))), PLAN, "of another robot: they name "
         "panda_joint1, panda_joint2, and lack shoulder_pan_joint"),
        (sees(arm=arm(stamp_ns=42 - 1_100_000_000)), PLAN, f"are 1.1 {TOO_OLD}"),
        ({**sees(heard=LATE_NS), "now_ns": lambda: LATE_NS}, PLAN, f"are 2.0 {TOO_OLD}"),
        (sees(arm=arm(position=np.array([0.0, np.inf, 0, 0, 0, 0]))), PLAN, "hold no numbers "
         "for every joint"),
        (sees(arm=arm(position=np.zeros(0))), PLAN, "hold no numbers for every joint"),
        (sees(running="plan_0"), PLAN, "plan_0 is being executed"),
        ({"localise": lambda *_: found(cube="0 points")}, PLAN, "not every object was found: cube "
         "(0 points)"),
        ({"replay": raising(TwinError("no waypoints"))}, PLAN, "no waypoints"),
        ({}, replace(PLAN, frame="world"), "is given in frame 'world'"),
        (sees(description='<robot name="panda"/>'), replace(PLAN, robot="panda"), "is given in "
         "frame 'base_link'; only 'panda_link0'"),
        (sees(description=DAMAGED), PLAN, "carries a record that is not a robot: Object missing "
         "required field `name`"),
        ({}, replace(PLAN, robot="panda"), "for robot 'panda'; the cell's robot is 'ur5"),
        ({}, replace(PLAN, task_sha256="0" * 64), "that is asked for has sha256 000000000000"),
        ({}, replace(PLAN, task="fold_towel"), "task 'fold_towel' is asked for; this gate judges"),
    ],
)  # fmt: skip
def test_what_cannot_be_decided_is_null_with_a_reason(
    settings: dict[str, Any], plan: Plan, reason: str
) -> None:
    verdict = gate_with(**settings).judge(plan.to_json())
    assert verdict.accepted is None
    assert verdict.plan_id == plan.id
    assert reason in str(verdict.reason)
    assert Verdict.from_json(verdict.to_json()) == verdict


def believed(**places: Any) -> Plan:
    return replace(PLAN, entities=places)


def test_a_plan_made_for_another_scene_gets_no_verdict() -> None:
    """The fakes see every object at the origin."""
    far = believed(cube={"p_m": [0.0, 0.11, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]})
    verdict = gate_with().judge(far.to_json())
    assert verdict.accepted is None
    assert "was made for another scene: it has cube 110 mm from where it is seen" in str(
        verdict.reason
    )
    near = believed(
        cube={"p_m": [0.0, 0.09, 0.0]}, box={"where": "left"}, marker={"p_m": [9, 9, 9]}
    )
    assert gate_with().judge(near.to_json()).accepted is True


def test_objects_that_look_alike_may_be_confused() -> None:
    task = load_task("five_ducks_into_basket")
    places = {name: np.eye(4) for name in task.objects}
    for index, T in enumerate(places.values()):
        T[0, 3] = 0.3 * index
    seen = {name: SimpleNamespace(T_base_object=T) for name, T in places.items()}
    swapped = believed(duck_1={"p_m": [0.3, 0.0, 0.0]}, duck_2={"p_m": [0.0, 0.0, 0.0]})
    assert of_another_scene(swapped, seen, task) == ""
    on_the_basket = believed(duck_1={"p_m": places["basket"][:3, 3].tolist()})
    assert "it has duck_1 300 mm" in of_another_scene(on_the_basket, seen, task)


def test_frames_that_were_searched_are_not_searched_again() -> None:
    """Two planners ask from one start: it is localised once, until something newer is seen."""
    perception, searched = FakePerception(), []

    def localise(frames: Any, *_: Any) -> Any:
        searched.append(frames[0].stamp_ns)
        return found()

    gate = gate_with(perception, localise)
    for stamp_ns in (1, 1, 2, 2, 1):
        perception.seen = [SimpleNamespace(stamp_ns=stamp_ns)]
        assert gate.judge(PLAN.to_json()).accepted is True
    assert searched == [1, 2, 1]


def test_a_cell_not_heard_for_long_is_not_judged_from_memory_however_often_one_asks() -> None:
    gate = gate_with(now_ns=lambda: 100_000_000_000)
    for _ in range(3):
        verdict = gate.judge(PLAN.to_json())
        assert verdict.accepted is None
        assert "nothing has arrived from the cell for 100 s" in str(verdict.reason)


def test_a_cell_that_stands_still_while_it_waits_for_a_verdict_is_not_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each verdict takes 60 s, the cell asks again 1 s later: 1 s of silence, then 2."""
    monkeypatch.setattr(gate_module, "MAX_JOINT_AGE_S", 10.0)
    seconds = iter([1, 1, 61, 62, 62, 122, 200, 200])
    gate = gate_with(FakePerception(heard=0), now_ns=lambda: next(seconds) * 10**9)
    assert gate.judge(PLAN.to_json()).accepted is True
    assert gate.judge(PLAN.to_json()).accepted is True
    assert "for 80 s" in str(gate.judge(PLAN.to_json()).reason)


def test_a_bug_in_the_replay_is_null_and_not_silence(capsys: pytest.CaptureFixture[str]) -> None:
    verdict = gate_with(replay=raising(ZeroDivisionError("oops"))).judge(PLAN.to_json())
    assert verdict.accepted is None
    assert verdict.reason == "internal error: ZeroDivisionError: oops"
    assert "Traceback" in capsys.readouterr().err


def test_a_payload_that_is_too_large_is_not_even_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred megabytes of JSON would keep all other answers waiting while they are parsed."""
    payload = b" " * (100 * 10**6)
    monkeypatch.setattr(Plan, "from_json", staticmethod(raising(AssertionError("it was read"))))
    with pytest.raises(PlanTooLargeError, match=r"100 MB .* is not read as a plan; at most 10 MB"):
        gate_with().judge(payload)


@pytest.fixture
def any_task(tmp_path: Path) -> JudgedTasks:
    """What a gate without --task judges by, in a run that has a task of its own."""
    own = chosen_task_file("cube_into_box").data.replace(b'"cube_into_box"', b'"my_task"')
    (tmp_path / "my_task.toml").write_bytes(own)
    return JudgedTasks(tasks_dir=tmp_path)


@pytest.mark.parametrize("name", ["cube_into_box", "my_task"])
def test_a_gate_without_a_task_judges_by_the_file_that_a_plan_names_and_hashes(
    any_task: JudgedTasks, name: str
) -> None:
    file = find_task_file(name, tasks_dir=any_task.tasks_dir)
    judged: list[str] = []

    def replay(plan: Plan, task: Task, *_: Any) -> Verdict:
        judged.append(task.name)
        return accept(plan)

    gate = gate_with(replay=replay, tasks=any_task)
    plan = replace(PLAN, task=name, task_sha256=file.sha256)
    assert gate.judge(plan.to_json()).accepted is True
    assert gate.localise(name, file.sha256).found is True
    assert judged == [name]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, "named without the hash of its file"),
        ({"task": "", "task_sha256": "0" * 64}, "task '' is named with the hash"),
        ({"task_sha256": "0" * 64}, "no task named 'cube_into_box' with sha256 000000000000"),
        ({"task": "no_such_task", "task_sha256": "0" * 64}, "no task named 'no_such_task'"),
        ({"task": "../my_task", "task_sha256": "0" * 64}, "no task named '../my_task'"),
    ],
)
def test_a_task_that_is_not_known_by_name_and_hash_is_never_a_yes(
    any_task: JudgedTasks, changes: dict[str, str], reason: str
) -> None:
    verdict = gate_with(tasks=any_task).judge(replace(PLAN, **changes).to_json())
    assert verdict.accepted is None
    assert reason in (verdict.reason or "")


def test_the_same_frames_are_searched_again_for_another_task(any_task: JudgedTasks) -> None:
    searched: list[str] = []

    def localise(frames: Any, task: Task, ends_s: float) -> dict[str, Any]:
        searched.append(task.name)
        return found()

    gate = gate_with(localise=localise, tasks=any_task)
    for name in ("cube_into_box", "cube_into_box", "my_task"):
        gate.localise(name, find_task_file(name, tasks_dir=any_task.tasks_dir).sha256)
    assert searched == ["cube_into_box", "my_task"]
