"""Disks that fill up and files that may not grow, under a cell in full flow."""

import resource
import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fault_account import check_code, ledger, lost, nothing_invented, read
from fault_cell import FaultCell, PublisherChild, Sent
from fault_messages import MIX, RAW
from mcap.reader import make_reader

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
    assert len(found) > 100
    assert check_code(path) == 3
