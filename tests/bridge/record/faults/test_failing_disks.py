"""Disks that are full, slow or break, files that may not grow or go, a clock that is set."""

import os
import random
import resource
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fault_account import (
    accounts_are_exact,
    check_code,
    ledger,
    lost,
    metadata,
    nothing_invented,
    only_the_tail_is_missing,
    read,
)
from fault_cell import FaultCell, PublisherChild, Sent
from fault_messages import GRIPPER, JOINTS, MIX, RAW
from loopback import free_endpoint
from mcap.reader import make_reader
from patience import wait_until

import robot_gst
from bridge.episode.reader import Episode
from bridge.episode.streams import events

HERE = Path(__file__).parent
IMAGES = ("color", "depth", "raw")
WRITE_S = 0.4
KILLS = int(os.environ.get("GST_SLOW_KILLS", "2"))
WAIT_S = 60.0


def wait_for_messages(asker: PublisherChild, count: int) -> None:
    wait_until(lambda: asker.ask("status")["ok"].get("messages", 0) >= count, within_s=WAIT_S)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(KILLS))
def test_a_kill_on_a_slow_disk_costs_half_a_second_and_two_writes(
    cell: FaultCell, number: int
) -> None:
    """Law: what came half a second before the last write that was finished began, is in the file.

    So a kill costs the write under way, what came during the one before, and that half second.
    """
    recorder = cell.record("--episode", "t1", "--cell", "cell", program=cell.slow(WRITE_S))
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
    only_the_tail_is_missing(found, small.sent(), cell.writes, killed_ns)
    assert check_code(path) == 3


@pytest.mark.slow
def test_a_slow_disk_drops_no_joints(cell: FaultCell) -> None:
    """Law: images wait in their own queue, and the lag of the small ones is in the status."""
    cell.record("--episode", "t1", "--cell", "cell", program=cell.slow(0.2))
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


@pytest.mark.parametrize("what", ["file", "folder", "replaced", "cut"])
def test_a_file_that_is_removed_while_it_is_written_ends_the_recorder(
    cell: FaultCell, what: str
) -> None:
    recorder = cell.record("--episode", "t1", "--cell", "cell")
    flow, asker = cell.publisher(), cell.publisher()
    flow.flow(60.0, "joints")
    wait_for_messages(asker, 100)
    part = cell.path("t1").with_suffix(".mcap.part")
    if what == "folder":
        shutil.rmtree(cell.run)
    elif what == "cut":
        os.truncate(part, part.stat().st_size // 2)
    else:
        part.unlink()
    if what == "replaced":
        part.write_bytes(b"not ours")
    assert recorder.process.wait(timeout=WAIT_S) == 1
    done = "cut" if what == "cut" else "removed or replaced"
    assert f"t1.mcap.part was {done} while it was written" in recorder.said()
    assert not cell.path("t1").exists()
    assert what != "replaced" or part.read_bytes() == b"not ours"


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


STEPPER = str(Path(__file__).with_name("stepping_recorder.py"))
HOUR_NS = 3_600 * 10**9


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


SMALL = ("--min-free-mb", "0", "--footer-mb", "6")


@pytest.fixture
def disk(cell: FaultCell) -> Iterator[Path]:
    """A file system of 16 MB under the run folder."""
    cell.run.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(cell.run)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small file system needs more rights than this machine gives")
    yield cell.run
    subprocess.run(["umount", "--lazy", str(cell.run)], check=True)


def failed_status(publisher: PublisherChild) -> dict[str, Any]:
    """Ask until the recorder says that it failed."""
    end_s = time.monotonic() + 60.0
    while time.monotonic() < end_s:
        answer = publisher.ask("status")["ok"]
        if not answer["ok"]:
            return dict(answer)
    pytest.fail("the recorder never said that its disk is full")


def ends_at_one_instant(path: Path, sent: list[Sent]) -> int:
    """Return how many of what was sent are accounted for; they must be the first so many."""
    topics = ledger(path)
    said = {
        topic: tally["received"] - tally["repeated"] + lost(tally)
        for topic, tally in topics.items()
    }
    count = sum(said.values())
    assert Counter(item.topic for item in sent[:count]) == said
    return count


@pytest.mark.parametrize(
    "streams",
    [pytest.param(MIX, id="mix", marks=pytest.mark.slow), pytest.param((*MIX, "raw"), id="raw")],
)
def test_a_full_disk_is_said_at_once_and_every_message_is_accounted_for(
    cell: FaultCell, disk: Path, streams: tuple[str, ...]
) -> None:
    recorder = cell.record("--episode", "t1", "--cell", "cell", *SMALL)
    flow, asker = cell.publisher(), cell.publisher()
    flow.flow(60.0, *streams, period_s=0.0005)
    status = failed_status(asker)
    assert "No space left on device" in status["error"]
    assert recorder.process.wait(timeout=30.0) == 1
    flow.kill()
    assert "No space left on device. The recorder stopped. The episode was finished" in (
        recorder.said()
    )
    assert "Traceback" not in recorder.said()
    path = cell.path("t1")
    assert [p.name for p in path.parent.iterdir()] == ["t1.mcap"]
    sent = flow.sent()
    nothing_invented(read(path), sent, transcoded=(RAW,))
    count = ends_at_one_instant(path, sent)
    print(f"{count} of {len(sent)} accounted for")
    assert check_code(path) == 3


@pytest.mark.slow
def test_the_reserve_ends_an_episode_while_there_is_room(cell: FaultCell, disk: Path) -> None:
    """Law: at --min-free-mb nothing that was received is lost, and that much is left."""
    recorder = cell.record(
        "--episode", "t1", "--cell", "cell", "--min-free-mb", "8", "--footer-mb", "4"
    )
    flow = cell.publisher()
    flow.flow(60.0, *MIX)
    assert recorder.process.wait(timeout=60.0) == 1
    flow.kill()
    assert "MB must be left. The recorder stopped. The episode was finished" in recorder.said()
    path = cell.path("t1")
    sent = flow.sent()
    count = ends_at_one_instant(path, sent)
    assert sum(lost(tally) for tally in ledger(path).values()) == 0
    assert len(read(path)) == count
    assert check_code(path) == 0
    assert shutil.disk_usage(disk).free > 2_000_000


@pytest.mark.slow
def test_a_file_that_may_not_grow_is_recovered_with_all_but_the_refused(cell: FaultCell) -> None:
    """Law: there is no room for an end, so the part stays, and recovery makes it whole."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, 1_500_000))

    recorder = cell.record("--episode", "t1", "--cell", "cell", preexec_fn=limit)
    flow, asker = cell.publisher(), cell.publisher()
    flow.flow(60.0, *MIX)
    status = failed_status(asker)
    assert "File too large" in status["error"]
    assert recorder.process.wait(timeout=30.0) == 1
    flow.kill()
    assert "robot-gst recover finishes it" in recorder.said()
    cell.record().kill()
    path = cell.path("t1")
    found = read(path)
    nothing_invented(found, flow.sent())
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert found
    for topic in {item.topic for item in found}:
        numbers = [item.sequence for item in found if item.topic == topic]
        assert numbers == list(range(len(numbers)))
    assert check_code(path) == 3
