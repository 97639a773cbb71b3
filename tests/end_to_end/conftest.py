"""Run the commands as a user would, each in its own process."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(Path(__file__).parent), str(ROOT / "tests" / "twin" / "scene")]
SHARED = Path(os.environ.get("GST_SHARED_DATA", ROOT.parent / "shared" / "data"))
Gst = Callable[..., subprocess.CompletedProcess[str]]


def run_command(*arguments: str, timeout_s: float = 300.0) -> subprocess.CompletedProcess[str]:
    """Run one command to its end."""
    return subprocess.run(
        [sys.executable, "-m", "robot_gst", *arguments],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
        cwd=ROOT,
    )


@contextmanager
def _recorder(run: Path, endpoint: str) -> Iterator[subprocess.Popen[bytes]]:
    """Leave a recorder running in its own process; finish it with SIGTERM."""
    command = [sys.executable, "-m", "robot_gst", "record", str(run), "--listen", endpoint]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT
    )
    try:
        deadline = time.monotonic() + 60
        while run_command("ctl", "status", "--connect", endpoint).returncode != 0:
            if process.poll() is not None or time.monotonic() > deadline:
                message = "the recorder did not start"
                raise RuntimeError(message)
        yield process
    finally:
        process.terminate()
        process.wait(30)


@pytest.fixture(scope="session")
def gst() -> Gst:
    """Give the function that runs one command to its end."""
    return run_command


@pytest.fixture
def recorder() -> Callable[[Path, str], AbstractContextManager[subprocess.Popen[bytes]]]:
    """Give the context manager that keeps a recorder running."""
    return _recorder


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """Give the function that finds a folder of real inputs, or skips the test."""

    def find(name: str) -> Path:
        folder = SHARED / name
        if not folder.is_dir():
            pytest.skip(f"real input {name} is not here (set GST_SHARED_DATA)")
        return folder

    return find
