"""A disk that fills up while recording: how soon is it known, and is the file whole?"""

import contextlib
import json
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.errors import GstError
from bridge.record.control import RecorderClient
from bridge.wire.session import WireSample
from record.cell import CellSpec
from record.children import Publisher, children
from record.recorders import OurRecorder
from record.throughput import EPISODE
from record.verify import verify

SIZE_MB = 80
FULL_BYTES = 1_300_000
"""Less than one chunk is left; the disk says no at this instant or a little later."""
GIVE_UP_S = 30.0


@dataclass(frozen=True, kw_only=True)
class DiskFullRun:
    """What a person or a program watching the recorder would see."""

    status_after_s: float
    """From the disk being full to an error in the status, heard or asked for [s]."""
    exit_after_s: float
    exit_code: int | None
    is_valid: bool
    """The episode has its final name and every message in it is what was sent."""
    messages: int


@contextmanager
def small_disk(folder: Path) -> Iterator[Path | None]:
    """A file system of its own of 80 MB; None where mounting is not allowed."""
    folder.mkdir(parents=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_MB}m", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        yield None
        return
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


class Watch:
    """Notes when the disk was full, when the status said so, and when the process ended."""

    def __init__(self, recorder: OurRecorder, disk: Path) -> None:
        """Start watching."""
        self.full_s = self.status_s = self.exit_s = float("inf")
        self._recorder = recorder
        self._disk = disk
        self._subscriber = recorder.session.subscribe("rec/*/status", self._hear)
        self._client = RecorderClient(recorder.session, timeout_s=1.0)
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._watch, self._ask)
        ]
        for thread in self._threads:
            thread.start()

    def _hear(self, sample: WireSample) -> None:
        self._judge(json.loads(sample.data))

    def _ask(self) -> None:
        """Somebody may also ask instead of listening."""
        while self._recorder.is_running():
            with contextlib.suppress(GstError):  # it may be ending
                self._judge(self._client.status())
            time.sleep(0.05)

    def _judge(self, status: dict[str, Any]) -> None:
        if status.get("error"):
            self.status_s = min(self.status_s, time.monotonic())

    def _watch(self) -> None:
        end_s = time.monotonic() + GIVE_UP_S
        while self._recorder.is_running() and time.monotonic() < end_s:
            found = os.statvfs(self._disk)
            if found.f_bavail * found.f_frsize < FULL_BYTES:
                self.full_s = min(self.full_s, time.monotonic())
            time.sleep(0.002)
        if not self._recorder.is_running():
            self.exit_s = time.monotonic()

    def wait(self) -> None:
        """Until the recorder ended, or long enough."""
        for thread in self._threads:
            thread.join()


def run_disk_full(spec: CellSpec, folder: Path, disk: Path) -> DiskFullRun:
    """Record onto the small disk until it is full; no reserve, so that the disk itself says no."""
    folder.mkdir(parents=True)
    with children() as started:
        limits = ("--min-free-mb", "0", "--footer-mb", "4")
        recorder = OurRecorder(folder, "--color", "jpeg", *limits, run=disk / "run")
        started.append(recorder)
        publisher = Publisher(recorder.endpoint, spec.to_text(), folder, seconds=GIVE_UP_S)
        started.append(publisher)
        recorder.client.start(EPISODE, {"cell": "bench"})
        watch = Watch(recorder, disk)
        publisher.tell("go")
        watch.wait()
        publisher.tell("stop")
        publisher.summary()
        exit_code = recorder.process.poll()
        recorder.leave()
    path = disk / "run" / "episodes" / f"{EPISODE}.mcap"
    kept, is_valid = 0, False
    if path.is_file():
        verdicts = verify([path], publisher.account_path, spec).values()
        kept = sum(verdict.kept for verdict in verdicts)
        is_valid = kept > 0 and not any(v.unequal + v.unsent + v.repeated for v in verdicts)
    return DiskFullRun(
        status_after_s=watch.status_s - watch.full_s,
        exit_after_s=watch.exit_s - watch.full_s,
        exit_code=exit_code,
        is_valid=is_valid,
        messages=kept,
    )
