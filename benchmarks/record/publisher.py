"""The cell as its own process, with its own account of what it sent.

It says ``ready`` on standard output, waits for a line, publishes, and ends after its time or when
standard input says ``stop``. Its account (npz) holds, per topic, the stamp of every
message in the order sent and how long each ``put`` took.
"""

import argparse
import json
import sys
import threading
import time
from array import array
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from bridge.wire.config import WireConfig  # noqa: E402
from bridge.wire.publisher import WirePublisher  # noqa: E402
from bridge.wire.qos import Qos  # noqa: E402
from bridge.wire.session import WireSession, open_session  # noqa: E402
from record.cell import CellSpec, Stream, streams_of  # noqa: E402

LATE_IMAGES, LATE_SMALL = 3, 100
"""A source further behind than this many periods leaves some out, as a camera would."""
FLUSH_S = 0.5


class Sender:
    """Sends one stream on time."""

    def __init__(self, session: WireSession, stream: Stream, *, block: bool) -> None:
        """Announce the topic."""
        chosen = Qos.RELIABLE if block else Qos.CAMERA if stream.is_image else Qos.CONTROL
        self.stream = stream
        self.publisher: WirePublisher = session.publisher(
            stream.topic, stream.type_name, qos=chosen
        )
        self.now_ns = session.now_ns
        self.late = LATE_IMAGES if stream.is_image else LATE_SMALL
        self.due_ns = 0
        self.skipped = 0
        self.stamps_ns = array("q")
        self.put_ns = array("q")

    def send(self) -> None:
        """Send the next message, or leave out those that are too late."""
        behind = (time.perf_counter_ns() - self.due_ns) // self.stream.period_ns
        if behind > self.late:
            self.skipped += behind
            self.due_ns += behind * self.stream.period_ns
            return
        stamp_ns = self.now_ns()
        data = self.stream.message(len(self.stamps_ns), stamp_ns)
        before_ns = time.perf_counter_ns()
        self.publisher.put(data, source_ns=stamp_ns)
        self.put_ns.append(time.perf_counter_ns() - before_ns)
        self.stamps_ns.append(stamp_ns)
        self.due_ns += self.stream.period_ns


def send_all(senders: list[Sender], start_ns: int, end_ns: int, stop: threading.Event) -> None:
    """Send several streams from one thread, each when it is due."""
    for index, sender in enumerate(senders):  # not all in the same instant
        sender.due_ns = start_ns + index * sender.stream.period_ns // len(senders)
    while not stop.is_set():
        sender = min(senders, key=lambda item: item.due_ns)
        if sender.due_ns >= end_ns:
            return
        wait_ns = sender.due_ns - time.perf_counter_ns()
        if wait_ns > 0:
            time.sleep(wait_ns * 1e-9)
        sender.send()


def run(session: WireSession, spec: CellSpec, *, seconds: float, block: bool) -> list[Sender]:
    """Publish until the time is over or standard input says so."""
    senders = [Sender(session, stream, block=block) for stream in streams_of(spec)]
    stop = threading.Event()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.readline()

    def listen() -> None:
        if sys.stdin.readline().strip() == "stop":  # its end says nothing
            stop.set()

    threading.Thread(target=listen, daemon=True).start()
    start_ns = time.perf_counter_ns()
    end_ns = start_ns + round(seconds * 1e9)
    # Joints and images from two threads: a controller does not wait for a camera.
    groups = [[s for s in senders if s.stream.is_image is kind] for kind in (False, True)]
    threads = [
        threading.Thread(target=send_all, args=(group, start_ns, end_ns, stop))
        for group in groups
        if group
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    time.sleep(FLUSH_S)  # what is on its way leaves before the session closes
    return senders


def main() -> None:
    """Publish, then write the account and a summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--endpoint", required=True)
    parser.add_argument("--account", type=Path, required=True)
    parser.add_argument("--spec", type=CellSpec.from_text, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--block", action="store_true")
    parser.add_argument("--shared-memory-mb", type=int, default=0)
    options = parser.parse_args()
    wire = WireConfig(connect=(options.endpoint,), shared_memory_mb=options.shared_memory_mb)
    with open_session(wire) as session:
        senders = run(session, options.spec, seconds=options.seconds, block=options.block)
    columns: dict[str, np.ndarray] = {}
    for sender in senders:
        topic = sender.stream.topic
        columns[f"stamps_ns:{topic}"] = np.array(sender.stamps_ns, dtype=np.int64)
        columns[f"put_ns:{topic}"] = np.array(sender.put_ns, dtype=np.int64)
        columns[f"skipped:{topic}"] = np.array(sender.skipped)
    np.savez(options.account, **columns)
    summary = {
        "cpu_s": time.process_time(),
        "not_shared": sum(sender.publisher.not_shared for sender in senders),
    }
    sys.stdout.write(json.dumps(summary) + "\n")


if __name__ == "__main__":
    main()
