"""A recorder that hangs, publishers that die, messages too large."""

import signal
import time

import pytest
from fault_account import accounts_are_exact, check_code, ledger, lost, nothing_invented, read
from fault_cell import FaultCell
from fault_messages import JOINTS, MIX
from patience import wait_until

from bridge.episode.check import check_episode

STOP_S = 3.0
HUGE_BYTES = 200_000_000


@pytest.mark.slow
def test_a_recorder_stopped_for_seconds_accounts_for_every_message(cell: FaultCell) -> None:
    """Law: sent = written + declared lost, on every topic, whatever was dropped on the way."""
    recorder = cell.record()
    publisher = cell.publisher()
    publisher.ask("start", {"id": "t1", "info": {"cell": "cell"}})
    for name in (*MIX, "raw"):  # what is lost before the first that arrives, nobody can know
        publisher.flow(0.0, name, qos="own")
        publisher.answer()
    wait_until(lambda: publisher.ask("status")["ok"]["messages"] == len(publisher.sent()))
    begun = len(publisher.sent())
    publisher.flow(STOP_S + 2.5, *MIX, "raw", qos="own")
    wait_until(lambda: len(publisher.sent()) >= begun + 100)
    recorder.send(signal.SIGSTOP)
    time.sleep(STOP_S)
    recorder.send(signal.SIGCONT)
    publisher.answer()
    answer = publisher.ask("stop")["ok"]
    path = cell.path("t1")
    topics = accounts_are_exact(path, publisher.sent(), transcoded=("/cell/cam/raw/color/image",))
    assert answer["lost"] == sum(lost(tally) for tally in topics.values())
    assert answer["messages"] + answer["lost"] == len(publisher.sent())
    print({topic: (tally["received"], lost(tally)) for topic, tally in topics.items()})
    assert answer["lost"] > 0, "the stop was too short to prove anything"
    assert check_code(path) == 3


def test_a_publisher_killed_and_come_back_is_no_gap(cell: FaultCell) -> None:
    """Law: what a dead publisher did not send is not lost, nor is what it sent before."""
    cell.record()
    asker, first = cell.publisher(), cell.publisher()
    asker.ask("start", {"id": "t1", "info": {"cell": "cell"}})
    first.flow(60.0, *MIX)
    wait_until(lambda: len(first.sent()) >= 60)
    first.kill()
    second = cell.publisher()
    second.flow(0.5, *MIX)
    second.answer()
    answer = second.ask("stop")["ok"]
    path = cell.path("t1")
    found, sent = read(path), first.sent() + second.sent()
    nothing_invented(found, sent)
    assert answer["lost"] == sum(lost(tally) for tally in ledger(path).values()) == 0
    # What the network still held of the first went with it; all of the second is there.
    digests = {item.digest for item in found}
    assert all(item.digest in digests for item in second.sent())
    of_first = len(found) - len(second.sent())
    assert 0.8 * len(first.sent()) < of_first <= len(first.sent())
    # Whether the first one had said its count before it was killed is chance.
    assert {each.name for each in check_episode(path).findings} <= {"tail_untold"}


@pytest.mark.slow
def test_messages_of_200_megabytes_are_refused_and_counted(cell: FaultCell) -> None:
    """Law: too large a message is counted as lost, and memory holds three copies at most."""
    recorder = cell.record()
    publisher = cell.publisher()
    publisher.ask("start", {"id": "t1", "info": {"cell": "cell"}})
    before_mb = recorder.memory_mb()
    peaks_mb = []
    for _ in range(6):
        publisher.flow(0.05, "joints")
        publisher.answer()
        huge = {"topic": "/huge", "key": "huge", "encoding": "", "zeros": HUGE_BYTES}
        publisher.tell(puts=[{**huge, "note": None, "sequence": None, "gid": ""}])
        publisher.answer()
        peaks_mb.append(recorder.memory_mb("VmHWM"))
    answer = publisher.ask("stop")["ok"]
    path = cell.path("t1")
    topics = ledger(path)
    assert topics["/huge"]["queue_drops"] == answer["lost"] == 6
    assert topics[JOINTS]["received"] == sum(s.topic == JOINTS for s in publisher.sent())
    assert check_code(path) == 3
    after_mb = recorder.memory_mb()
    print(f"{before_mb:.0f} MB before, at most {peaks_mb} MB, {after_mb:.0f} MB after")
    # The network's own buffer, the assembled message and our copy; the allocator keeps some.
    assert max(peaks_mb) - before_mb < 3.5 * HUGE_BYTES / 1e6
    assert peaks_mb[-1] - peaks_mb[2] < 0.5 * HUGE_BYTES / 1e6  # six are no worse than three
