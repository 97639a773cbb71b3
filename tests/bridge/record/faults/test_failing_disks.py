"""Disks that are slow or break, and files that are taken away while they are written."""

import os
import random
import shutil
import signal
import time
from collections import Counter
from pathlib import Path

import pytest
from fault_account import accounts_are_exact, check_code, ledger, lost, nothing_invented, read
from fault_cell import FaultCell, PublisherChild
from fault_messages import GRIPPER, JOINTS, MIX
from loopback import free_endpoint
from patience import wait_until

import robot_gst

HERE = Path(__file__).parent
IMAGES = ("color", "depth", "raw")
WRITE_S = 0.4
TAIL_S = 0.5
KILLS = int(os.environ.get("GST_SLOW_KILLS", "2"))
WAIT_S = 60.0


def slow(delay_s: float) -> str:
    return f"{HERE / 'slow_recorder.py'} {delay_s}"


def wait_for_messages(asker: PublisherChild, count: int) -> None:
    wait_until(lambda: asker.ask("status")["ok"].get("messages", 0) >= count, within_s=WAIT_S)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(KILLS))
def test_a_kill_on_a_slow_disk_costs_half_a_second_and_two_writes(
    cell: FaultCell, number: int
) -> None:
    recorder = cell.record("--episode", "t1", "--cell", "cell", program=slow(WRITE_S))
    small, images = cell.publisher(), cell.publisher()
    small.flow(60.0, "joints", "gripper", period_s=0.001)
    images.flow(60.0, *IMAGES, qos="own")
    time.sleep(random.Random(number).uniform(2.0, 6.0))  # the instant of the fault
    killed_ns = time.time_ns()
    recorder.kill()
    small.kill()
    images.kill()
    path = cell.path("t1")
    assert robot_gst.run(["recover", str(cell.run), "-q"]) == 0
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    found = read(path)
    nothing_invented(
        found, [*small.sent(), *images.sent()], transcoded=("/cell/cam/raw/color/image",)
    )
    for topic in (JOINTS, GRIPPER):
        numbers = [item.sequence for item in found if item.topic == topic]
        assert numbers == list(range(len(numbers)))
        old_ns = killed_ns - (TAIL_S + 2 * WRITE_S) * 1e9
        old = sum(item.topic == topic and item.put_ns < old_ns for item in small.sent())
        assert len(numbers) >= old
    assert check_code(path) == 3


@pytest.mark.slow
def test_a_slow_disk_drops_no_joints(cell: FaultCell) -> None:
    """Law: images wait in their own queue, and the lag of the small ones is in the status."""
    cell.record("--episode", "t1", "--cell", "cell", program=slow(0.2))
    small, images, asker = cell.publisher(), cell.publisher(), cell.publisher()
    small.flow(3.0, "joints", "gripper", period_s=0.001)
    images.flow(3.0, *IMAGES)
    wait_for_messages(asker, 500)
    assert asker.ask("status")["ok"]["write_lag_s"] < 2.0
    small.answer()
    images.answer()
    assert small.ask("status")["ok"]["ok"]  # in line behind the last message
    assert images.ask("stop")["ok"]["lost"] == 0
    topics = accounts_are_exact(
        cell.path("t1"), [*small.sent(), *images.sent()], transcoded=("/cell/cam/raw/color/image",)
    )
    assert lost(topics[JOINTS]) == lost(topics[GRIPPER]) == 0
    assert check_code(cell.path("t1")) == 0


@pytest.mark.parametrize("what", ["file", "folder"])
def test_a_file_that_is_removed_while_it_is_written_is_written_anew(
    cell: FaultCell, what: str
) -> None:
    recorder = cell.record("--episode", "t1", "--cell", "cell")
    flow, asker = cell.publisher(), cell.publisher()
    flow.flow(4.0, *MIX)
    wait_for_messages(asker, 300)
    part = cell.path("t1").with_suffix(".mcap.part")
    if what == "file":
        part.unlink()
    else:
        shutil.rmtree(cell.run)
    recorder.wait_for("t1.mcap.part was removed while it was written; it was written there anew")
    assert part.exists()
    flow.answer()  # a killed publisher takes along what it had not sent yet
    answer = asker.ask("stop")["ok"]
    assert (answer["lost"], answer["uncounted_tails"]) == (0, [])
    sent = Counter(item.topic for item in flow.sent())
    for topic, tally in ledger(cell.path("t1")).items():
        assert tally["received"] == sent[topic]
    nothing_invented(read(cell.path("t1")), flow.sent())


def test_a_disk_that_breaks_ends_the_recorder_with_clear_words(
    cell: FaultCell,
) -> None:
    recorder = cell.record(
        "--episode", "t1", "--cell", "cell", program=str(HERE / "failing_recorder.py")
    )
    flow, asker = cell.publisher(), cell.publisher()
    flow.flow(60.0, "joints")
    wait_for_messages(asker, 100)
    recorder.send(signal.SIGUSR1)
    assert recorder.process.wait(timeout=WAIT_S) == 1
    said = recorder.said()
    assert "Input/output error (the disk, or the connection to it, is failing)" in said
    assert "choose another disk, then record again" in said
    assert "Traceback" not in said


def test_a_second_recorder_on_one_folder_is_refused(cell: FaultCell) -> None:
    first = cell.record()
    second = cell.start_recording(endpoint=free_endpoint())
    assert second.process.wait(timeout=WAIT_S) == 2
    assert f"another recorder records into {cell.run} already" in second.said()
    first.finish()
    cell.record().finish()  # the folder is free again


def test_recorders_that_share_a_folder_keep_others_out_of_it(cell: FaultCell) -> None:
    first = cell.record("--shares-folder")
    elsewhere = free_endpoint()
    second = cell.record("--shares-folder", endpoint=elsewhere)
    third = cell.start_recording(endpoint=free_endpoint())
    assert third.process.wait(timeout=WAIT_S) == 2
    assert "already" in third.said()
    assert second.process.poll() is None
    first.finish()
    fourth = cell.start_recording(endpoint=free_endpoint())
    assert fourth.process.wait(timeout=WAIT_S) == 2, "one of two is still at work"
    second.finish()
    cell.record().finish()
