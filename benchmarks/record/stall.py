"""A recorder that is stopped for five seconds: does a controller notice?"""

import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from record.cell import CellSpec
from record.children import Publisher, children
from record.recorders import OurRecorder
from record.throughput import EPISODE
from record.verify import TopicVerdict, verify

STALL_S = 5.0
BEFORE_S = 2.0
AFTER_S = 3.0


@dataclass(frozen=True, kw_only=True)
class StallRun:
    """The controller's side, and whether the ledger knows what was lost."""

    put_max_ms: float
    put_p999_ms: float
    joints_sent: int
    joints_wanted: int
    lost: int
    is_exact: bool


def run_stall(spec: CellSpec, folder: Path, *, stall: bool) -> StallRun:
    """Cameras and a joint publisher as two processes; the recorder stands still, or does not."""
    folder.mkdir(parents=True)
    seconds = BEFORE_S + STALL_S + AFTER_S
    specs = {name: CellSpec(**{**vars(spec), "streams": name}) for name in ("joints", "cameras")}
    with children() as started:
        recorder = OurRecorder(folder, "--color", "jpeg")
        started.append(recorder)
        publishers = {}
        for name, part in specs.items():
            publishers[name] = Publisher(
                recorder.endpoint, part.to_text(), folder, seconds=seconds, name=name
            )
            started.append(publishers[name])
        recorder.client.start(EPISODE, {"cell": "bench"})
        for publisher in publishers.values():
            publisher.tell("go")
        time.sleep(BEFORE_S)
        if stall:
            recorder.send_signal(signal.SIGSTOP)
        time.sleep(STALL_S)
        recorder.send_signal(signal.SIGCONT)
        for publisher in publishers.values():
            publisher.summary()
        recorder.wait_until_drained()
        recorder.stop()
    files = [recorder.run_path / "episodes" / f"{EPISODE}.mcap"]
    verdicts: dict[str, TopicVerdict] = {}
    for name, part in specs.items():
        verdicts |= verify(files, publishers[name].account_path, part)
    joints = verdicts["/bench/joint_states"]
    put_ms = joints.put_ns / 1e6
    return StallRun(
        put_max_ms=float(put_ms.max()),
        put_p999_ms=float(np.quantile(put_ms, 0.999)),
        joints_sent=joints.sent,
        joints_wanted=joints.wanted,
        lost=sum(verdict.lost for verdict in verdicts.values()),
        is_exact=all(verdict.is_exact for verdict in verdicts.values()),
    )
