"""A recorder must never hold a controller up: it is stopped under a running publisher."""

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from own_process import begun

CHILD = Path(__file__).with_name("stall_child.py")
PUTS = 3000
"""More than the network's buffers take: those of a reliable publisher are full before."""
STUCK_ANSWERS = 75
"""A child that answers so often, 20 ms apart, without having made a put() waits for the recorder;
one that gets no processor does not answer either."""

pytestmark = pytest.mark.slow


def spawn(*arguments: str) -> "subprocess.Popen[str]":
    return begun(*arguments, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)


@pytest.fixture
def recorder(endpoint: str, tmp_path: Path) -> Iterator["subprocess.Popen[str]"]:
    child = spawn(
        "robot_gst.py", "record", str(tmp_path / "run"), "--listen", endpoint, "--episode", "t1"
    )
    try:
        end_s = time.monotonic() + 60.0
        while not list(tmp_path.rglob("*.part")):
            assert child.poll() is None, "the recorder did not start"
            assert time.monotonic() < end_s
            time.sleep(0.05)
        yield child
    finally:
        child.send_signal(signal.SIGCONT)
        child.kill()
        child.communicate()


class Controller:
    """The child, and how many of its put() have returned."""

    def __init__(self, endpoint: str, preset: str) -> None:
        """Start it."""
        self._child = spawn(str(CHILD), endpoint, preset)
        assert self._child.stdout is not None
        assert self._child.stdout.readline().strip() == "go"

    def returned(self) -> int:
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        self._child.stdin.write("\n")
        self._child.stdin.flush()
        return int(self._child.stdout.readline())

    def wait_for(self, count: int) -> bool:
        """Whether so many return before the child has answered often and none returned."""
        seen, same = self.returned(), 0
        while seen < count and same < STUCK_ANSWERS:
            time.sleep(0.02)
            now = self.returned()
            seen, same = now, same + 1 if now == seen else 0
        return seen >= count

    def close(self) -> None:
        self._child.kill()
        self._child.communicate()


def goes_on_while_stopped(
    recorder: "subprocess.Popen[str]", endpoint: str, preset: str
) -> tuple[bool, bool]:
    """Whether a publisher goes on while the recorder is stopped, and after that."""
    with closing(Controller(endpoint, preset)) as controller:
        assert controller.wait_for(500), "the first messages find and fill caches"
        recorder.send_signal(signal.SIGSTOP)
        during = controller.wait_for(controller.returned() + PUTS)
        recorder.send_signal(signal.SIGCONT)
        return during, controller.wait_for(controller.returned() + 100)


def test_a_stopped_recorder_does_not_hold_a_control_publisher(
    recorder: "subprocess.Popen[str]", endpoint: str
) -> None:
    """How long each put() takes then, ``make bench BENCH=record_live`` measures."""
    assert goes_on_while_stopped(recorder, endpoint, "control") == (True, True)


def test_a_stopped_recorder_does_stall_a_reliable_publisher(
    recorder: "subprocess.Popen[str]", endpoint: str
) -> None:
    """The reason for the other preset; when this fails, the test above proves nothing."""
    during, _ = goes_on_while_stopped(recorder, endpoint, "reliable")
    assert not during
