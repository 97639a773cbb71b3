"""Recorder, publishers and commands as real processes on the loopback address."""

import hashlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from loopback import free_endpoint
from mcap.reader import make_reader
from own_process import begun

from bridge.errors import BridgeError
from bridge.record.control import RecorderClient
from bridge.wire.config import WireConfig
from bridge.wire.session import open_session

CHILD = Path(__file__).with_name("publisher_child.py")
WAIT_S = 30.0

pytestmark = pytest.mark.slow


class Cell:
    """One recorder process and everything that talks to it."""

    def __init__(self, run_path: Path) -> None:
        """Find a free port."""
        self.endpoint = free_endpoint()
        self.run_path = run_path
        self.children: list[subprocess.Popen[str]] = []

    def record(self, *arguments: str, **options: object) -> "subprocess.Popen[str]":
        command = ("robot_gst.py", "record", str(self.run_path), "--listen", self.endpoint)
        child = begun(*command, *arguments, **options)
        self.children.append(child)
        return child

    def publish(self, account: Path, *arguments: str) -> "subprocess.Popen[str]":
        child = begun(str(CHILD), self.endpoint, str(account), *arguments)
        self.children.append(child)
        return child

    def wait_until_ready(self) -> None:
        end_s = time.monotonic() + WAIT_S
        while True:
            try:
                self.status()
                return
            except BridgeError:
                if time.monotonic() > end_s:
                    raise
                time.sleep(0.05)

    def status(self) -> dict[str, object]:
        with open_session(WireConfig(connect=(self.endpoint,), connect_timeout_s=0.5)) as session:
            return RecorderClient(session, timeout_s=5.0).status()

    def command(self, *arguments: str) -> "subprocess.CompletedProcess[str]":
        child = begun("robot_gst.py", *arguments, "--connect", self.endpoint)
        self.children.append(child)
        out, err = child.communicate(timeout=WAIT_S)
        return subprocess.CompletedProcess(child.args, child.returncode, out, err)


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    made = Cell(tmp_path / "run")
    yield made
    for child in made.children:
        if child.poll() is None:
            child.kill()
        child.communicate()


def recorded(path: Path) -> dict[tuple[str, int], str]:
    """Content hash by topic and sequence, read by the official reader with CRCs checked."""
    with path.open("rb") as stream:
        return {
            (channel.topic, message.sequence): hashlib.sha256(message.data).hexdigest()
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
            if channel.topic.startswith("/child/")
        }


def sent(account: Path) -> dict[tuple[str, int], str]:
    rows = [line.split() for line in account.read_text().splitlines()]
    return {(topic, int(number)): digest for topic, number, digest in rows}


def test_everything_a_publisher_sent_is_in_the_file(cell: Cell, tmp_path: Path) -> None:
    recorder = cell.record()
    cell.wait_until_ready()
    publisher = cell.publish(tmp_path / "account", "300", "0.001", "t1")
    _, err = publisher.communicate(timeout=WAIT_S)
    assert publisher.returncode == 0, err
    path = cell.run_path / "episodes" / "t1.mcap"
    assert recorded(path) == sent(tmp_path / "account")
    assert len(recorded(path)) == 900
    recorder.send_signal(signal.SIGTERM)
    assert recorder.wait(timeout=WAIT_S) == 0
    checked = subprocess.run(
        [str(Path(sys.executable).with_name("rerun")), "mcap", "check", "--full", str(path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert "PROBLEM" not in checked.stdout


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_finishes_the_open_episode(
    cell: Cell, tmp_path: Path, number: signal.Signals
) -> None:
    recorder = cell.record("--episode", "t1", "--kind", "scan", "--json")
    cell.wait_until_ready()
    assert cell.publish(tmp_path / "account", "10", "0").wait(timeout=WAIT_S) == 0
    recorder.send_signal(number)
    out, err = recorder.communicate(timeout=WAIT_S)
    assert recorder.returncode == 0, err
    answer = json.loads(out)
    assert (answer["episode"], answer["messages"], answer["lost"]) == ("t1", 30, 0)
    assert recorded(cell.run_path / "episodes" / "t1.mcap") == sent(tmp_path / "account")
