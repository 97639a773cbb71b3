"""One recording of the benchmark's cell, metered from outside and compared with what was sent."""

import os
import shutil
import signal
import statistics
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from record.cell import CellSpec
from record.children import Publisher, children
from record.recorders import OurRecorder, ReferenceRecorder
from record.verify import TopicVerdict, verify

EPISODE = "bench"


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What one recording cost and kept."""

    cpu_s: float
    """Of the recorder, from the first message to the finished file [s]."""
    seconds: float
    publisher_cpu_s: float
    not_shared: int
    """Messages that found the shared memory full and went over the network."""
    peak_rss_mb: float
    file_mb: float
    load_1min: float
    verdicts: dict[str, TopicVerdict]

    @property
    def core(self) -> float:
        """Processor time over recorded time."""
        return self.cpu_s / self.seconds

    def total(self, name: str, *, images_only: bool = False) -> int:
        """Sum of one count over the topics."""
        chosen = (v for t, v in self.verdicts.items() if not images_only or t.endswith("/image"))
        return sum(int(getattr(verdict, name) or 0) for verdict in chosen)

    @property
    def kept_of_wanted(self) -> float:
        """Images kept over images that were due."""
        return self.total("kept", images_only=True) / self.total("wanted", images_only=True)

    @property
    def ledger_is_exact(self) -> bool:
        """Every topic: nothing altered, declared lost equals lost by the sender's count."""
        return all(verdict.is_exact for verdict in self.verdicts.values())

    def to_record(self) -> dict[str, Any]:
        """For the stored result."""
        topics = {}
        for topic, verdict in self.verdicts.items():
            counts = {**asdict(verdict), "lost": verdict.lost}
            put_ns = counts.pop("put_ns")
            topics[topic] = {**counts, "put_max_ms": float(put_ns.max(initial=0)) / 1e6}
        names = ("cpu_s", "seconds", "core", "publisher_cpu_s", "not_shared", "peak_rss_mb")
        names += ("file_mb", "load_1min", "ledger_is_exact")
        return {**{name: getattr(self, name) for name in names}, "topics": topics}


def record_ours(
    spec: CellSpec, seconds: float, folder: Path, *, shared_memory_mb: int = 0, depth: str = "raw"
) -> Recording:
    """Record with ``robot-gst record``, then compare; the episode is removed afterwards."""
    folder.mkdir(parents=True)
    with children() as started:
        recorder = OurRecorder(folder, "--depth", depth, "--color", "jpeg")
        started.append(recorder)
        publisher = Publisher(
            recorder.endpoint,
            spec.to_text(),
            folder,
            seconds=seconds,
            shared_memory_mb=shared_memory_mb,
        )
        started.append(publisher)
        recorder.client.start(EPISODE, {"cell": "bench"})
        found = _meter(recorder, publisher, seconds)
        recorder.leave()
        recorder.send_signal(signal.SIGTERM)
        recorder.process.communicate(timeout=60)
        if recorder.process.returncode != 0:
            message = f"the recorder ended with {recorder.process.returncode}: {recorder.log}"
            raise RuntimeError(message)
    first = recorder.run_path / "episodes" / f"{EPISODE}.mcap"
    return _compared(found, [first], publisher.account_path, spec, folder)


def record_reference(spec: CellSpec, seconds: float, folder: Path) -> Recording:
    """Record with the reference; its publisher waits (BLOCK), as in the study."""
    folder.mkdir(parents=True)
    with children() as started:
        recorder = ReferenceRecorder(folder)
        started.append(recorder)
        publisher = Publisher(
            recorder.endpoint, spec.to_text(), folder, seconds=seconds, block=True
        )
        started.append(publisher)
        found = _meter(recorder, publisher, seconds)
        recorder.tell("end")
        recorder.process.communicate(timeout=60)
    return _compared(found, [recorder.path], publisher.account_path, spec, folder)


def _meter(
    recorder: OurRecorder | ReferenceRecorder, publisher: Publisher, seconds: float
) -> dict[str, Any]:
    before_s = recorder.cpu_s()
    publisher.tell("go")
    summary = publisher.summary(timeout_s=seconds * 4 + 120)
    recorder.wait_until_drained()
    recorder.stop()
    return {
        "cpu_s": recorder.cpu_s() - before_s,
        "seconds": seconds,
        "publisher_cpu_s": summary["cpu_s"],
        "not_shared": summary["not_shared"],
        "peak_rss_mb": recorder.peak_rss_mb(),
        "load_1min": os.getloadavg()[0],
    }


def _compared(
    found: dict[str, Any], files: list[Path], account: Path, spec: CellSpec, folder: Path
) -> Recording:
    size = sum(path.stat().st_size for path in files)
    verdicts = verify(files, account, spec)
    shutil.rmtree(folder)
    return Recording(**found, file_mb=size / 1e6, verdicts=verdicts)


def median_core(recordings: Iterable[Recording]) -> float:
    """The middle one's cost."""
    return statistics.median(recording.core for recording in recordings)
