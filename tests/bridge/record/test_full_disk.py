"""A disk that is full, broken or slow: said at once, finished where possible, counted exactly."""

import errno
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from patience import wait_until

from bridge.clock import AnchoredClock
from bridge.episode.mcap.part_file import PartFile
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.recover import recover_parts
from bridge.episode.run_folder import RunFolder
from bridge.record.config import DiskConfig, RecorderConfig
from bridge.record.errors import NoSpaceError
from bridge.record.lifecycle import DiskReserve, free_bytes
from bridge.record.recorder import Recorder
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]
MakeRecorder = Callable[..., Recorder]
INFO = EpisodeInfo(id="t1", kind="trial")


@pytest.fixture
def make_recorder() -> Iterator[MakeRecorder]:
    made: list[Recorder] = []

    def make(run: RunFolder, **disk: object) -> Recorder:
        config = RecorderConfig(disk=DiskConfig(**disk))  # type: ignore[arg-type]
        made.append(Recorder(run, now_ns=AnchoredClock().now_ns, config=config))
        return made[-1]

    yield make
    for recorder in made:
        recorder.close()


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
        make_recorder(run).start(INFO)
    with pytest.raises(NoSpaceError, match="--footer-mb"):
        make_recorder(run, min_free_mb=0, footer_mb=50).start(INFO)
    recorder = make_recorder(run, min_free_mb=6)  # with the usual reserve of 64
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
    recorder = make_recorder(run, flush_s=0.05)
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
    recorder = make_recorder(run)
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
