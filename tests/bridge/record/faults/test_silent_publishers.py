"""Publishers that stop, hang, vanish or come late; and a recorder that hears nothing."""

import base64
import contextlib
import io
import json
import signal
import time
from collections.abc import Callable
from typing import Any

import pytest
from fault_account import check_code, metadata
from fault_cell import FaultCell, PublisherChild
from fault_messages import COLOR, GRIPPER, JOINTS, joints

import robot_gst
from bridge.episode import schema
from bridge.episode.reader import Episode
from bridge.episode.streams import events

WAIT_S = 60.0
CONTRACT = f"""
schema_version = 1
[topics."{JOINTS}"]
rate_hz = 500
tolerance = 0.5
silence_s = 0.8
[topics."{GRIPPER}"]
required = false
"""


def wait_until(
    asker: PublisherChild, is_so: Callable[[dict[str, Any]], bool], what: str
) -> dict[str, Any]:
    """Ask for the status until something is in it."""
    end_s = time.monotonic() + WAIT_S
    while time.monotonic() < end_s:
        status: dict[str, Any] = asker.ask("status")["ok"]
        if is_so(status):
            return status
        time.sleep(0.02)
    pytest.fail(f"{what} was not said")


def silent(status: dict[str, Any]) -> set[str]:
    return {silence["topic"] for silence in status["silent"]}


def notes(cell: FaultCell, kind: str) -> list[dict[str, Any]]:
    found = [event.get("data") for event in events(Episode.open(cell.path("t1")))]
    return [data for data in found if data and data.get("kind") == kind]


@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)]
)
def test_joints_that_stop_are_named_live_and_in_the_file(
    cell: FaultCell, how: signal.Signals
) -> None:
    recorder = cell.record()
    asker, dying, living = cell.publisher(), cell.publisher(), cell.publisher()
    assert asker.ask("start", {"id": "t1", "info": {"cell": "cell"}})["ok"]["ok"]
    dying.flow(60.0, "joints")
    living.flow(60.0, "color", "gripper")
    wait_until(asker, lambda status: status["seen"].get(JOINTS, 0) > 600, "600 joints")
    dying.send(how)
    status = wait_until(asker, silent, "a silence")
    assert silent(status) == {JOINTS}
    (silence,) = status["silent"]
    assert silence["silent_s"] < 2.0
    recorder.wait_for(f"{JOINTS} silent for ")
    wait_until(asker, lambda now: now["silent"][0]["silent_s"] > 1.2, "a longer silence")
    answer = asker.ask("stop")["ok"]
    assert answer["lost"] == 0
    (found,) = answer["findings"]
    assert (found["name"], found["about"]) == ("tail_unknown", JOINTS)
    assert found["text"].startswith("nothing came in the last ")
    assert [data["topic"] for data in notes(cell, "silent")] == [JOINTS]
    presence = metadata(cell.path("t1"), "presence")
    assert presence["topics"][JOINTS]["tail"] == "unknown"
    assert presence["topics"][COLOR]["tail"] == "known"
    assert check_code(cell.path("t1")) == 3
    assert JOINTS in robot_gst_output("check", str(cell.path("t1")))
    assert "tail unknown" in robot_gst_output("info", str(cell.path("t1")))
    assert "tail unknown" in robot_gst_output("ls", str(cell.run))


def robot_gst_output(*words: str) -> str:
    """What a command prints."""
    with contextlib.redirect_stdout(io.StringIO()) as stream:
        robot_gst.run(list(words))
    return " ".join(stream.getvalue().split())


def test_a_required_topic_that_is_missing_refuses_a_start(cell: FaultCell) -> None:
    cell.run.mkdir()
    (cell.run / "cell.toml").write_text(CONTRACT)
    cell.record()
    asker, flow = cell.publisher(), cell.publisher()
    refused = asker.ask("start", {"id": "t1"})["refused"]
    assert refused.startswith(f"t1 was not started: {JOINTS} has not been seen.")
    assert "--anyway" in refused
    answer = asker.ask("start", {"id": "t0", "anyway": True})["ok"]
    assert answer["missing"] == [f"{JOINTS} has not been seen"]
    answer = asker.ask("stop")["ok"]
    found, nothing = answer["findings"]
    assert nothing["name"] == "nothing_recorded"
    assert (found["name"], found["about"]) == ("contract_broken", JOINTS)
    assert found["text"] == "no message, and the contract requires it"
    assert check_code(cell.path("t0")) == 3
    flow.flow(60.0, "joints")
    wait_until(asker, lambda status: not status["missing"], "that nothing is missing")
    assert asker.ask("start", {"id": "t1", "info": {"cell": "cell"}})["ok"]["ok"]
    begun = wait_until(asker, lambda status: status.get("messages", 0) > 500, "500 messages")
    assert not begun["silent"]
    answer = asker.ask("stop")["ok"]
    assert (answer["findings"], answer["lost"]) == ([], 0)
    assert check_code(cell.path("t1")) == 0
    flow.kill()
    wait_until(asker, silent, "the silence while idle")
    assert "silent for" in asker.ask("start", {"id": "t2"})["refused"]


def test_a_recorder_that_starts_by_itself_waits_for_what_is_required(cell: FaultCell) -> None:
    cell.run.mkdir()
    (cell.run / "cell.toml").write_text(CONTRACT)
    recorder = cell.record("--episode", "t1", "--cell", "cell")
    recorder.wait_for(f"waiting: {JOINTS} has not been seen")
    flow = cell.publisher()
    flow.flow(60.0, "joints")
    wait_until(flow_asker := cell.publisher(), lambda s: s.get("messages", 0) > 100, "messages")
    assert flow_asker.ask("stop")["ok"]["findings"] == []


def test_a_message_that_cannot_be_taken_in_does_not_end_the_hearing(cell: FaultCell) -> None:
    """Law: an error in the network thread costs one message, which its numbers show."""
    deaf = str(__file__).replace("test_silent_publishers", "choking_recorder")
    recorder = cell.record(program=deaf)
    asker, flow = cell.publisher(), cell.publisher()
    asker.ask("start", {"id": "t1", "info": {"cell": "cell"}})
    flow.flow(60.0, "joints")
    wait_until(asker, lambda status: status["seen"].get(JOINTS, 0) > 300, "joints")
    recorder.send(signal.SIGUSR1)
    status = wait_until(asker, lambda now: now["receive_errors"] == 1, "an error")
    assert "MemoryError" in status["last_receive_error"]
    seen = status["seen"][JOINTS] + 100
    wait_until(asker, lambda now: now["seen"][JOINTS] > seen, "more joints")
    answer = asker.ask("stop")["ok"]
    assert answer["lost"] == 1
    assert check_code(cell.path("t1")) == 3


def test_messages_without_numbers_are_said_to_hide_losses(cell: FaultCell) -> None:
    cell.record()
    publisher = cell.publisher()
    publisher.ask("start", {"id": "t1", "info": {"cell": "cell"}})
    put = {"topic": JOINTS, "key": JOINTS[1:], "sequence": None, "gid": "", "note": None}
    put |= {
        "encoding": f"application/cdr;{schema.JOINT_STATE}",
        "data": base64.b64encode(joints()).decode(),
    }
    publisher.tell(puts=[put] * 7)
    publisher.answer()
    answer = publisher.ask("stop")["ok"]
    assert answer["unnumbered"] == {JOINTS: 7}
    words = f"{JOINTS}: 7 messages carry no sequence number; losses of it cannot be seen"
    assert words in robot_gst_output("check", str(cell.path("t1")))
    assert words in robot_gst_output("info", str(cell.path("t1")))
    assert check_code(cell.path("t1")) == 0


def test_a_contract_of_the_run_holds_its_episodes(cell: FaultCell) -> None:
    rules = [f'[topics."{topic}"]\nsilence_s = 0.5' for topic in (COLOR, GRIPPER, JOINTS)]
    cell.run.mkdir(exist_ok=True)
    (cell.run / "cell.toml").write_text("\n".join(["schema_version = 1", *rules]))
    cell.record()
    asker, flow = cell.publisher(), cell.publisher()
    flow.flow(60.0, "joints", "gripper", "color")
    wait_until(asker, lambda status: status["seen"].get(COLOR, 0) > 3, "images")
    assert asker.ask("start", {"id": "t1", "info": {"cell": "cell"}})["ok"]["ok"]
    wait_until(asker, lambda status: status.get("duration_s", 0) > 1.0, "a second")
    flow.kill()
    wait_until(asker, lambda status: silent(status) == {COLOR, GRIPPER, JOINTS}, "all silent")
    answer = asker.ask("stop")["ok"]
    assert [each["name"] for each in answer["findings"]].count("contract_broken") >= 3
    report = json.loads(robot_gst_output("check", str(cell.path("t1")), "--json"))
    assert report["episodes"][0]["state"] == "contract broken"
