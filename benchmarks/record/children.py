"""Processes of a benchmark: started, metered from outside, and ended with it."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
WAIT_S = 60.0
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def free_endpoint() -> str:
    """A loopback endpoint nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def wait_until(there: Callable[[], bool], what: str, timeout_s: float = WAIT_S) -> None:
    """Poll.

    Raises:
        TimeoutError: Naming what did not happen.
    """
    end_s = time.monotonic() + timeout_s
    while not there():
        if time.monotonic() > end_s:
            message = f"{what} did not happen within {timeout_s:g} s"
            raise TimeoutError(message)
        time.sleep(0.02)


class Child:
    """A Python process of this benchmark."""

    def __init__(self, *arguments: str, log: Path) -> None:
        """Start it; what it says on standard error goes to a file."""
        self.log = log
        with log.open("ab") as errors:
            self.process = subprocess.Popen(
                [sys.executable, *arguments],
                cwd=ROOT,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        self.pid = self.process.pid

    def expect(self, word: str) -> None:
        """Wait for a line on its standard output.

        Raises:
            RuntimeError: When it says something else, or ends.
        """
        said = self.process.stdout.readline().strip()
        if said != word:
            message = f"expected {word!r}, got {said!r}: {self.log.read_text()[-2000:]}"
            raise RuntimeError(message)

    def tell(self, word: str) -> None:
        """Write a line to its standard input."""
        self.process.stdin.write(word + "\n")
        self.process.stdin.flush()

    def summary(self, timeout_s: float = WAIT_S) -> dict[str, Any]:
        """Wait for its end and return the JSON it printed last."""
        out, _ = self.process.communicate(timeout=timeout_s)
        if self.process.returncode != 0 or not out.strip():
            message = f"exit code {self.process.returncode}: {self.log.read_text()[-2000:]}"
            raise RuntimeError(message)
        return dict(json.loads(out.strip().splitlines()[-1]))

    def cpu_s(self) -> float:
        """Processor time of all its threads so far, user and system [s]."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) * _TICK_S

    def peak_rss_mb(self) -> float:
        """The most memory it ever held; shared memory it reads from counts [MB]."""
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        peak = next((line for line in lines if line.startswith("VmHWM")), "VmHWM: 0 kB")
        return int(peak.split()[1]) / 1e3

    def is_running(self) -> bool:
        """Whether it is still there."""
        return self.process.poll() is None

    def send_signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self.process.send_signal(number)

    def end(self) -> None:
        """Kill it if it is still there."""
        if self.is_running():
            self.process.kill()
        self.process.communicate()


@contextmanager
def children() -> Iterator[list[Child]]:
    """Whatever is put into the list does not outlive the context."""
    found: list[Child] = []
    try:
        yield found
    finally:
        for child in found:
            child.end()


class Publisher(Child):
    """The cell; see ``publisher.py``."""

    def __init__(
        self,
        endpoint: str,
        spec_text: str,
        folder: Path,
        *,
        seconds: float,
        block: bool = False,
        shared_memory_mb: int = 0,
        name: str = "account",
    ) -> None:
        """Start it and wait until it is ready to publish."""
        self.account_path = folder / f"{name}.npz"
        super().__init__(
            str(Path(__file__).with_name("publisher.py")),
            *("--endpoint", endpoint, "--spec", spec_text, "--seconds", str(seconds)),
            *("--account", str(self.account_path), "--shared-memory-mb", str(shared_memory_mb)),
            *(("--block",) if block else ()),
            log=folder / f"{name}.log",
        )
        self.expect("ready")
