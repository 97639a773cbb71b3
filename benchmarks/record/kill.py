"""kill -9 at random instants: is every file recovered, and how much of its end is missing?"""

import contextlib
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader

from bridge.errors import GstError
from record.cell import CellSpec, streams_of
from record.children import Publisher, children
from record.recorders import OurRecorder, ReferenceRecorder
from record.throughput import EPISODE
from record.verify import messages_of

FINALISE_S = 0.06
"""A stop of a short episode takes about this long; kills while finalising fall within it [s]."""


@dataclass(frozen=True, kw_only=True)
class KillRun:
    """What was left of one recording."""

    recovered: bool
    """There is a file with its final name that the official reader reads, and it is right."""
    finished: bool
    """The kill came too late: the file had its final name already."""
    tail_s: dict[str, float]
    """By topic: from the last message kept to the last one sent before the kill, or the stop."""
    holes: int
    """Messages missing before the tail."""
    problem: str = ""


def kill_ours(
    spec: CellSpec, folder: Path, rng: np.random.Generator, *, seconds: float, finalising: bool
) -> KillRun:
    """Kill the recorder while it records, or while it finishes the episode, then recover."""
    from bridge.episode.recover import recover

    folder.mkdir(parents=True)
    with children() as started:
        recorder = OurRecorder(folder, "--color", "jpeg")
        started.append(recorder)
        publisher = Publisher(recorder.endpoint, spec.to_text(), folder, seconds=seconds + 5)
        started.append(publisher)
        recorder.client.start(EPISODE, {"cell": "bench"})
        publisher.tell("go")
        time.sleep(rng.uniform(0.3, seconds))
        end_ns = time.time_ns()  # of the kill, or of the stop: what comes later is not wanted
        if finalising:
            threading.Thread(target=_stop, args=(recorder,), daemon=True).start()
            time.sleep(rng.uniform(0, FINALISE_S))
        recorder.send_signal(signal.SIGKILL)
        recorder.process.wait()
        publisher.tell("stop")
        publisher.summary()
    path = recorder.run_path / "episodes" / f"{EPISODE}.mcap"
    finished = path.is_file()
    try:
        if not finished:
            path = recover(path.with_name(path.name + ".part")).output
        return _judge(path, publisher.account_path, spec, end_ns, finished=finished)
    except (GstError, McapError, OSError, ValueError) as error:
        problem = f"{type(error).__name__}: {error}"
        return KillRun(recovered=False, finished=finished, tail_s={}, holes=0, problem=problem)


def _stop(recorder: OurRecorder) -> None:
    with contextlib.suppress(GstError):  # nobody is left to answer
        recorder.stop()


def _judge(path: Path, account: Path, spec: CellSpec, end_ns: int, *, finished: bool) -> KillRun:
    kept: dict[str, set[int]] = {}
    for _, channel, message in messages_of([path]):
        kept.setdefault(channel.topic, set()).add(message.sequence)
    tail_s, holes = {}, 0
    with np.load(account) as data:
        for stream in streams_of(spec):
            stamps = data[f"stamps_ns:{stream.topic}"]
            sent = stamps[stamps <= end_ns]
            numbers = kept.get(stream.topic, set())
            last = max(numbers, default=-1)
            holes += last + 1 - len(numbers)
            if len(sent):
                before = stamps[last] if last >= 0 else sent[0] - stream.period_ns
                tail_s[stream.topic] = max(0.0, float(sent[-1] - before) * 1e-9)
    return KillRun(recovered=bool(kept), finished=finished, tail_s=tail_s, holes=holes)


def kill_reference(spec: CellSpec, folder: Path, *, seconds: float) -> tuple[int, int]:
    """Kill the reference; messages sent, and those a linear scan still finds."""
    folder.mkdir(parents=True)
    with children() as started:
        recorder = ReferenceRecorder(folder)
        started.append(recorder)
        publisher = Publisher(
            recorder.endpoint, spec.to_text(), folder, seconds=seconds, block=True
        )
        started.append(publisher)
        publisher.tell("go")
        time.sleep(seconds)
        recorder.send_signal(signal.SIGKILL)
        recorder.process.wait()
        publisher.tell("stop")
        publisher.summary()
    with np.load(publisher.account_path) as data:
        sent = sum(len(data[name]) for name in data.files if name.startswith("stamps_ns:"))
    found = 0
    with recorder.path.open("rb") as stream, contextlib.suppress(McapError, EOFError, ValueError):
        for record in StreamReader(stream).records:
            found += isinstance(record, Message)
    return sent, found
