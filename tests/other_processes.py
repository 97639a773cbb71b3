"""What becomes of processes that need not be our children."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from own_process import ROOT


def is_running(pid: int) -> bool:
    """Whether a process does anything still; one that is dead and not collected does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def ended_within(pid: int, seconds: float) -> bool:
    limit = time.monotonic() + seconds
    while is_running(pid) and time.monotonic() < limit:
        time.sleep(0.02)
    return not is_running(pid)


def check_an_interrupted_evaluation(code: str, run: Path, at_work: str) -> None:
    """Law: Ctrl-C ends an evaluation with the way to continue, and all that it started."""
    with subprocess.Popen(
        [sys.executable, "-c", code, str(run)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        assert process.stdout.readline() == f"{at_work}\n"
        os.killpg(process.pid, signal.SIGINT)
        out, said = process.communicate(timeout=20)
    again = f"robot-gst: interrupted; continue with: robot-gst evaluate {run}\n"
    assert (process.returncode, out, said) == (130, "", again)
    assert ended_within(pid, 10.0)
