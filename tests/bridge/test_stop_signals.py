"""Ending what runs until it is stopped, at whatever instant the signal comes."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
INSIDE_THE_EVENT = """
import os, sys
from bridge.terminal import stop_signals
with stop_signals() as stopped:
    with stopped._cond:  # as the main thread holds it now and then while it waits
        os.kill(os.getpid(), int(sys.argv[1]))
        sum(range(1000))
    print(stopped.wait(20))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_interrupts_the_waiting_itself_is_heard(number: signal.Signals) -> None:
    """A handler that takes the event's lock would wait for the code it has interrupted."""
    done = subprocess.run(
        [sys.executable, "-c", INSIDE_THE_EVENT, str(int(number))],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=ROOT,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\n", "")
