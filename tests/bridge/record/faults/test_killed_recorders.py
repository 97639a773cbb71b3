"""SIGKILL: at random instants, and between the system calls that finish an episode."""

import os
import random
import select
import signal
import time
from pathlib import Path

import pytest
from fault_account import (
    beginnings,
    check_code,
    metadata,
    nothing_invented,
    only_the_tail_is_missing,
    read,
)
from fault_cell import Child, FaultCell, PublisherChild
from fault_messages import MIX

from bridge.record.control import RecorderClient
from bridge.wire.config import WireConfig
from bridge.wire.session import open_session

AFTER_STOP_S = 0.5
"""A recorder answers a stop when all is written; no call of its end comes so long after."""
MIXES = {"joints": ("joints",), "mix": MIX}
KILLS = int(os.environ.get("GST_RECORDER_KILLS", "1"))
NUMBERS = [int(word) for word in os.environ.get("GST_KILL_NUMBERS", "1").split(",")]
"""At which call of a kind an episode's end is cut off; `make soak` goes on to the fifth."""
KILLER = str(Path(__file__).with_name("killing_recorder.py"))


def listed_by_the_next_start(cell: FaultCell, path: Path) -> Child:
    """Start another recorder, which says what it recovered; it goes on as if nothing had been."""
    recorder = cell.record()
    with open_session(WireConfig(connect=(cell.endpoint,), connect_timeout_s=30.0)) as session:
        status = RecorderClient(session).status()
    (report,) = status["recovered"]
    assert report["file"] == path.name + ".part"
    assert report["output"] == path.name
    assert report["messages"] >= len(read(path))  # with our own records
    assert f"recovered {path.name}: {report['messages']} messages" in recorder.said()
    if report["reason"]:  # else it was whole, and only its name was missing
        assert metadata(path, "recovered")["messages"] == report["messages"]
    assert status["state"] == "idle"
    return recorder


def kill_while_recording(cell: FaultCell, streams: tuple[str, ...], after_s: float) -> None:
    recorder = cell.record("--episode", "t1", program=cell.slow())
    publisher = cell.publisher()
    publisher.flow(60.0, *streams)
    time.sleep(after_s)
    killed_ns = time.time_ns()
    recorder.kill()
    publisher.kill()
    path = cell.path("t1")
    assert not path.exists()
    listed_by_the_next_start(cell, path).kill()
    found = read(path)
    nothing_invented(found, publisher.sent())
    only_the_tail_is_missing(found, publisher.sent(), cell.writes, killed_ns)
    assert check_code(path) == 3


@pytest.mark.parametrize("mix", sorted(MIXES))
def test_a_killed_recorder_loses_only_the_tail(cell: FaultCell, mix: str) -> None:
    kill_while_recording(cell, MIXES[mix], random.uniform(0.6, 1.2))


@pytest.mark.slow
@pytest.mark.parametrize("instant", range(KILLS))
@pytest.mark.parametrize("mix", sorted(MIXES))
def test_at_any_instant(cell: FaultCell, mix: str, instant: int) -> None:
    after_s = random.Random(f"{mix} {instant}").uniform(0.0, 4.0)
    kill_while_recording(cell, MIXES[mix], after_s)


def kill_while_finishing(cell: FaultCell, point: str) -> bool:
    """Say whether the recorder got that far."""
    recorder = cell.record(program=f"{KILLER} finish:{point}")
    publisher = cell.publisher()
    publisher.ask("start", {"id": "t1", "info": {"cell": "cell"}})
    publisher.flow(0.4, *MIX)
    publisher.answer()
    publisher.tell(ask="stop", payload="")
    code = recorder.process.wait(timeout=60.0) if _dies(recorder, publisher) else None
    publisher.kill()
    if code is None:
        recorder.kill()
        return False
    assert code == -signal.SIGKILL
    path = cell.path("t1")
    if path.exists():  # it had its name already: nothing is missing, and nothing to recover
        assert len(read(path)) == len(publisher.sent())
        assert check_code(path) == 0
        return True
    listed_by_the_next_start(cell, path).kill()
    nothing_invented(read(path), publisher.sent())
    beginnings(read(path), publisher.sent())
    if "rename" in point:  # all was written and synced
        assert len(read(path)) == len(publisher.sent())
        assert check_code(path) == 0
    else:
        assert check_code(path) in (0, 3)
    return True


def _dies(recorder: Child, publisher: PublisherChild) -> bool:
    """Until it is dead, or has answered the stop and made no such call for a while after."""
    end_s = time.monotonic() + 60.0
    answered = False
    while time.monotonic() < end_s and recorder.process.poll() is None:
        if not answered and select.select([publisher.process.stdout], [], [], 0.0)[0]:
            answered, end_s = True, time.monotonic() + AFTER_STOP_S
        time.sleep(0.02)
    return recorder.process.poll() is not None


def test_killed_before_the_last_rename_nothing_is_lost(cell: FaultCell) -> None:
    assert kill_while_finishing(cell, "rename:1:before")


@pytest.mark.slow
@pytest.mark.parametrize("side", ["before", "after"])
@pytest.mark.parametrize("call", ["pwritev", "fdatasync", "rename", "fsync"])
@pytest.mark.parametrize("number", NUMBERS)
def test_killed_between_the_calls_that_finish_an_episode(
    cell: FaultCell, call: str, number: int, side: str
) -> None:
    if not kill_while_finishing(cell, f"{call}:{number}:{side}"):
        assert number > 1, "the end of an episode makes each of these calls"


@pytest.mark.slow
@pytest.mark.parametrize("call", ["pwritev", "fdatasync", "rename", "fsync"])
def test_killed_while_recovering_it_is_done_by_the_next(cell: FaultCell, call: str) -> None:
    recorder = cell.record("--episode", "t1", program=cell.slow())
    publisher = cell.publisher()
    publisher.flow(1.0, *MIX)
    publisher.answer()
    killed_ns = time.time_ns()
    recorder.kill()
    publisher.kill()
    second = cell.start_recording(program=f"{KILLER} start:{call}:1:before")
    assert second.process.wait(timeout=60.0) == -signal.SIGKILL
    listed_by_the_next_start(cell, cell.path("t1")).kill()
    found = read(cell.path("t1"))
    nothing_invented(found, publisher.sent())
    only_the_tail_is_missing(found, publisher.sent(), cell.writes, killed_ns)
    assert check_code(cell.path("t1")) == 3
