"""Somebody sets the clock of the recorder's machine while it records."""

import signal
import time
from pathlib import Path

import pytest
from fault_account import accounts_are_exact, check_code, metadata, read
from fault_cell import FaultCell
from fault_messages import MIX
from patience import wait_until

from bridge.episode.reader import Episode
from bridge.episode.streams import events

STEPPER = str(Path(__file__).with_name("stepping_recorder.py"))
HOUR_NS = 3_600 * 10**9
WAIT_S = 30.0


@pytest.mark.slow
def test_a_clock_set_by_an_hour_and_back_reorders_nothing_and_is_noted(cell: FaultCell) -> None:
    """Law: log times go on as if nothing had happened; the step itself is an event."""
    recorder = cell.record(program=STEPPER)
    flow, asker = cell.publisher(), cell.publisher()
    assert asker.ask("start", {"id": "t1", "info": {"cell": "cell"}})["ok"]["ok"]
    begin_ns = time.time_ns()
    flow.flow(3.0, *MIX)
    for count, number in enumerate((signal.SIGUSR1, signal.SIGUSR2), start=1):
        recorder.send(number)
        wait_until(lambda count=count: asker.ask("status")["ok"]["clock_steps"] >= count)
    flow.answer()
    answer = flow.ask("stop")["ok"]
    end_ns = time.time_ns()
    path = cell.path("t1")
    accounts_are_exact(path, flow.sent())
    assert answer["lost"] == 0
    assert 0.0 < answer["duration_s"] < 60.0
    times: dict[str, list[int]] = {}
    for item in read(path):
        times.setdefault(item.topic, []).append(item.log_ns)
    for topic, of_topic in times.items():
        assert of_topic == sorted(of_topic), topic
        assert begin_ns <= of_topic[0]
        assert of_topic[-1] <= end_ns
    noted = [event["data"]["step_ns"] for event in events(Episode.open(path))]
    assert [round(step / HOUR_NS) for step in noted] == [1, -1]
    assert metadata(path, "recorder")["clock_steps_ns"] == noted
    named = [(each["name"], each["text"][:15]) for each in answer["findings"]]
    assert named == [("host_clock_jump", "set ahead by 36"), ("host_clock_jump", "set back by 360")]
    assert check_code(path) == 3
