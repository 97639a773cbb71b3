"""A disk that is full, broken or slow, messages from before the start, and steps of the clock."""

import errno
import json
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from patience import wait_until

from bridge.clock import StepWatch
from bridge.episode.mcap.part_file import PartFile
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.recover import recover_parts
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import events
from bridge.episode.topics import DROPS
from bridge.record.config import DiskConfig
from bridge.record.errors import NoSpaceError
from bridge.record.lifecycle import DiskReserve, free_bytes
from bridge.record.recorder import Recorder
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]
MakeRecorder = Callable[..., Recorder]
INFO = EpisodeInfo(id="t1", kind="trial")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own, 12 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(place)],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip("a file system cannot be mounted here (needs root)")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_start_without_space_is_refused(
    small_disk: Path, make_recorder: MakeRecorder, make_sample: MakeSample
) -> None:
    run = RunFolder.create(small_disk / "run")
    with pytest.raises(NoSpaceError, match=r"\d\d MB free, and 500 MB must be left"):
        make_recorder(run=run).start(INFO)
    with pytest.raises(NoSpaceError, match="--footer-mb"):
        make_recorder(run=run, disk=DiskConfig(min_free_mb=0, footer_mb=50)).start(INFO)
    recorder = make_recorder(run=run, disk=DiskConfig(min_free_mb=6))  # and reserves 64
    recorder.start(INFO)
    sent, end_s = 0, time.monotonic() + 60.0
    while not recorder.failed.is_set():
        assert time.monotonic() < end_s
        recorder.receive(make_sample(topic="/a", type_name="", data=os.urandom(20_000)))
        sent += 1
        time.sleep(0.01)
    assert "6 MB must be left" in recorder.status()["error"]
    recorder.close()
    assert 3_000_000 < free_bytes(small_disk) < 6_100_000
    episode = Episode.open(run.episodes_dir / "t1.mcap")
    assert 100 < episode.topics()["/a"].count <= sent


def test_the_space_held_back_has_no_name_and_comes_back(small_disk: Path) -> None:
    def used_mb() -> float:
        found = os.statvfs(small_disk)
        return (found.f_blocks - found.f_bfree) * found.f_frsize / 1e6

    reserve = DiskReserve(small_disk, 5)
    reserve.hold()
    reserve.hold()
    assert 4.9 < used_mb() < 5.2
    assert list(small_disk.iterdir()) == []
    reserve.release()
    reserve.release()
    assert used_mb() < 0.1


def test_a_broken_disk_leaves_a_part_that_can_be_recovered(
    run: RunFolder,
    make_recorder: MakeRecorder,
    make_sample: MakeSample,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recorder = make_recorder(disk=DiskConfig(flush_s=0.05))
    recorder.start(INFO)
    part = run.episodes_dir / "t1.mcap.part"
    begun_bytes = part.stat().st_size
    for _ in range(20):
        recorder.receive(make_sample())
    wait_until(lambda: not recorder.status()["queue_bytes"] and part.stat().st_size > begun_bytes)

    def broken(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(PartFile, "append", broken)
    recorder.receive(make_sample())
    assert recorder.failed.wait(5.0)
    assert "Input/output error" in recorder.status()["error"]
    assert "robot-gst recover" in recorder.status()["error"]
    recorder.close()
    monkeypatch.undo()
    assert [path.name for path in run.episodes_dir.iterdir()] == ["t1.mcap.part"]
    [report] = recover_parts(run)
    assert report.topics["/cell/joint_states"] == 20


def test_a_status_answers_while_the_disk_hangs(
    run: RunFolder,
    make_recorder: MakeRecorder,
    make_sample: MakeSample,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate = threading.Event()
    close = PartFile.publish

    def slow(self: PartFile, path: Path) -> None:
        gate.wait()
        close(self, path)

    monkeypatch.setattr(PartFile, "publish", slow)
    recorder = make_recorder()
    recorder.start(INFO)
    stopping = threading.Thread(target=recorder.stop)
    stopping.start()
    end_s = time.monotonic() + 10.0
    while recorder.status()["stalled_s"] < 1.0:
        state = recorder.status()["state"]  # answers although the disk does not, or never
        assert time.monotonic() < end_s
        time.sleep(0.05)
    assert state == "finishing"
    for _ in range(100):
        recorder.receive(make_sample())
    gate.set()
    stopping.join(10.0)
    assert recorder.status()["state"] == "idle"


JOINTS = "/cell/joint_states"


def episode_of(run: RunFolder, name: str = "t1") -> Episode:
    return Episode.open(run.episodes_dir / f"{name}.mcap")


def data_of(episode: Episode, topic: str = JOINTS) -> list[bytes]:
    return [message.data for message in episode.messages([topic])]


def info(name: str = "t1") -> EpisodeInfo:
    return EpisodeInfo(id=name, kind="trial", cell="cell")


def test_a_step_of_the_system_clock_is_written_down_and_reorders_nothing(
    make_recorder: MakeRecorder, run: RunFolder, make_sample: MakeSample
) -> None:
    shift_ns = 0
    recorder = make_recorder(wall_ns=lambda: time.time_ns() + shift_ns)
    recorder.start(info())
    for count, step_ns in enumerate((3_600 * 10**9, -2 * 3_600 * 10**9), start=1):
        recorder.receive(make_sample())
        shift_ns += step_ns
        wait_until(lambda count=count: recorder.status()["clock_steps"] == count)
    recorder.receive(make_sample())
    recorder.stop()
    episode = episode_of(run)
    found = [event["data"]["step_ns"] for event in events(episode)]
    assert [round(step / 1e9) for step in found] == [3_600, -7_200]
    assert episode.metadata_records["recorder"]["clock_steps_ns"] == found
    times = [message.log_time_ns for message in episode.messages([JOINTS])]
    assert times == sorted(times)
    assert times[-1] - times[0] < 60 * 10**9


def test_trimming_a_clock_and_a_stopped_process_are_no_steps() -> None:
    now_ns, wall_ns = 0, 10**18

    def slow_now() -> int:  # a process stopped between two readings
        nonlocal now_ns
        now_ns += stopped_ns
        return now_ns

    stopped_ns = 0
    watch = StepWatch(slow_now, wall_ns=lambda: wall_ns)
    for _ in range(10):
        now_ns += 10**9
        wall_ns += 10**9 + 500_000  # 500 ppm fast
        assert watch.step_ns() == 0
    stopped_ns = 5 * 10**9
    assert watch.step_ns() == 0


def test_ledger_records_say_how_things_stood(
    make_recorder: MakeRecorder, run: RunFolder, make_sample: MakeSample
) -> None:
    recorder = make_recorder()
    recorder.start(info())
    for delay_ns in (5_000_000, 3_000_000, 9_000_000):
        sample = make_sample()
        recorder.receive(replace(sample, source_ns=sample.received_ns - delay_ns))
    recorder.stop()
    records = [json.loads(data) for data in data_of(episode_of(run), DROPS)]
    mine = [record for record in records if record["topic"] == JOINTS]
    assert min(record["clock_offset_ns"] for record in mine) == 3_000_000
    for record in mine:
        assert record["disk_free_bytes"] > 0
        assert record["queue_bytes"] >= 0
    assert episode_of(run).metadata_records["drops"]["clock_offset_ns"] == 3_000_000
