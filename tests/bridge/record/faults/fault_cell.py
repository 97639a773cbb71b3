"""Processes that record and publish, for tests that break them."""

import base64
import contextlib
import json
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loopback import free_endpoint
from own_process import begun

CHILD = Path(__file__).with_name("fault_publisher.py")
WAIT_S = 60.0


@dataclass(frozen=True)
class Sent:
    """One line of a publisher's account."""

    put_ns: int
    topic: str
    sequence: int | None
    gid: str
    digest: str


class Child:
    """A process whose words go into a file."""

    def __init__(self, *arguments: str, log: Path, **options: Any) -> None:
        """Start it."""
        self.log = log
        with log.open("wb") as stream:
            self.process = begun(*arguments, stdin=subprocess.PIPE, stderr=stream, **options)

    def said(self) -> str:
        return self.log.read_text()

    def wait_for(self, text: str) -> None:
        end_s = time.monotonic() + WAIT_S
        while text not in self.said():
            assert self.process.poll() is None, self.said()
            assert time.monotonic() < end_s, f"{text!r} was not said:\n{self.said()}"
            time.sleep(0.02)

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        """End it as a power cut would."""
        self.process.kill()
        self.process.wait()

    def finish(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Ask it to end; returns its exit code."""
        self.send(number)
        return self.process.wait(timeout=WAIT_S)

    def memory_mb(self, name: str = "VmRSS") -> float:
        return self.number(name) * 1024 / 1e6

    def number(self, name: str) -> int:
        """A number of /proc/<pid>/status."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return next(int(line.split()[1]) for line in status.splitlines() if line.startswith(name))

    def open_files(self) -> int:
        return len(list(Path(f"/proc/{self.process.pid}/fd").iterdir()))


class PublisherChild(Child):
    """See fault_publisher.py."""

    def __init__(self, endpoint: str, folder: Path, name: str) -> None:
        """Start it and wait until it is connected."""
        self.account = folder / f"{name}.account"
        super().__init__(str(CHILD), endpoint, str(self.account), log=folder / f"{name}.log")
        self.answer()

    def answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, self.said()
        return json.loads(line)

    def tell(self, **request: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()

    def ask(self, verb: str, payload: bytes | dict[str, Any] = b"{}") -> dict[str, Any]:
        data = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
        self.tell(ask=verb, payload=base64.b64encode(data).decode())
        answer: dict[str, Any] = self.answer()
        return answer

    def flow(
        self, seconds: float, *streams: str, qos: str = "reliable", period_s: float = 0.002
    ) -> None:
        """Begin to publish; ``answer`` waits for its end."""
        self.tell(flow=seconds, streams=streams, qos=qos, period_s=period_s)

    def sent(self) -> list[Sent]:
        """Every message that left, in the order they left."""
        if not self.account.exists():
            return []
        lines = self.account.read_text().splitlines(keepends=True)
        return [Sent(*json.loads(line)) for line in lines if line.endswith("\n")]


class FaultCell:
    """A run folder, an endpoint, and the processes around them."""

    def __init__(self, folder: Path) -> None:
        """Find a free port."""
        self.folder = folder
        self.run = folder / "run"
        self.endpoint = free_endpoint()
        self.children: list[Child] = []

    def __enter__(self) -> "FaultCell":
        """Start nothing yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """End whatever still runs."""
        for child in self.children:
            if child.process.poll() is None:
                child.send(signal.SIGCONT)
                child.kill()
            for pipe in (child.process.stdin, child.process.stdout):
                if pipe is not None:
                    with contextlib.suppress(BrokenPipeError):
                        pipe.close()

    def record(
        self, *arguments: str, endpoint: str = "", program: str = "robot_gst.py", **options: Any
    ) -> Child:
        """Start a recorder and wait until it listens."""
        child = self.start_recording(*arguments, endpoint=endpoint, program=program, **options)
        child.wait_for("listens on")
        return child

    def start_recording(
        self, *arguments: str, endpoint: str = "", program: str = "robot_gst.py", **options: Any
    ) -> Child:
        command = (*program.split(), "record", str(self.run), "--listen", endpoint or self.endpoint)
        log = self.folder / f"recorder{len(self.children)}.log"
        child = Child(*command, *arguments, log=log, **options)
        self.children.append(child)
        return child

    @property
    def writes(self) -> Path:
        return self.folder / "writes"

    def slow(self, delay_s: float = 0.0) -> str:
        """A program for ``record`` that notes when it writes, see slow_recorder.py."""
        return f"{CHILD.with_name('slow_recorder.py')} {delay_s} {self.writes}"

    def publisher(self, endpoint: str = "") -> PublisherChild:
        name = f"publisher{len(self.children)}"
        child = PublisherChild(endpoint or self.endpoint, self.folder, name)
        self.children.append(child)
        return child

    def path(self, episode: str) -> Path:
        return self.run / "episodes" / f"{episode}.mcap"
