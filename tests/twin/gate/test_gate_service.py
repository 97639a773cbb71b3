"""The gate as a service of a cell: what it answers, publishes and subscribes, and how it ends."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from gate_fakes import PLAN, FakePerception, FakeSession, accept, gate_with

from bridge.episode.run_folder import RunFolder
from bridge.errors import InvalidRecordError
from bridge.task.verdict import Verdict
from bridge.terminal import Output
from twin.gate.config import GateConfig
from twin.gate.service import GateError, run_gate, serve_gate, watch_cell
from twin.robot import collision


def test_the_service_answers_and_publishes_with_the_cells_own_time() -> None:
    session = FakeSession()
    serve_gate(session, gate_with(), FakePerception(), GateConfig(), Output(quiet=True))
    answer = session.services["standin/gate/verdict"](PLAN.to_json())
    assert Verdict.from_json(answer).accepted is True
    assert session.published == [("/standin/verdict", answer, 42)]


def test_an_id_from_the_network_does_not_move_the_cursor(
    capsys: pytest.CaptureFixture[str],
) -> None:
    session, plan = FakeSession(), replace(PLAN, id="plan\x1b[2J\x1b[31m")
    serve_gate(session, gate_with(), FakePerception(), GateConfig(), Output())
    session.services["standin/gate/verdict"](plan.to_json())
    said = capsys.readouterr().err
    assert "\x1b" not in said
    assert "plan?[2J?[31m: accepted" in said


def test_a_malformed_plan_is_not_published() -> None:
    session = FakeSession()
    serve_gate(session, gate_with(), FakePerception(), GateConfig(), Output(quiet=True))
    with pytest.raises(InvalidRecordError):
        session.services["standin/gate/verdict"](b"nonsense")
    assert session.published == []


def test_only_cameras_events_joints_and_transforms_are_subscribed() -> None:
    session, taken = FakeSession(), []
    watch_cell(session, "standin", lambda *item: taken.append(item))
    assert sorted(session.subscriptions) == [
        "robot_description",
        "standin/cam/**",
        "standin/event",
        "standin/joint_states",
        "tf",
        "tf_static",
    ]
    sample = SimpleNamespace(topic="/tf", data=b"x", received_ns=3, type_name="t")
    session.subscriptions["tf"](sample)
    assert taken == [("/tf", b"x", 3, "t")]


def test_a_yes_names_scene_and_calibration_and_the_gate_says_those_of_now() -> None:
    now: dict[str, str | None] = {"scene_hash": "5cene", "calibration_id": "c"}
    session, said = FakeSession(), {"scene_hash": "5cene", "calibration_id": "c"}
    gate = gate_with(replay=lambda plan, *_: replace(accept(plan), **said), judged_in=lambda: now)
    serve_gate(session, gate, FakePerception(), GateConfig(), Output(quiet=True))
    ask = session.services["standin/gate/verdict"]
    basis = Verdict.from_json(ask(PLAN.to_json())).basis or {}
    assert {name: basis[name] for name in said} == said
    now["scene_hash"] = "rebuilt"
    assert json.loads(ask(b"")) == now
    said["calibration_id"] = "d"
    refused = Verdict.from_json(ask(PLAN.to_json()))
    assert refused.accepted is None
    assert "the run has been calibrated since the gate started" in str(refused.reason)


def test_a_gate_of_an_arm_that_nobody_watches_does_not_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder.create(tmp_path / "run")
    monkeypatch.setattr(collision, "_MOST_LEFT_OUT", 0.0)
    told = r"could be accepted: \d+% of the pairs of links .*: base_link and upper_arm_link, for"
    with pytest.raises(GateError, match=told):
        run_gate(run.path, GateConfig(robot="ur10e_parallel_gripper"), Output(quiet=True))
