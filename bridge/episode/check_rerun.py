"""A second opinion: Rerun's own MCAP checker."""

import shutil
import subprocess
import sys
from pathlib import Path

from bridge.errors import MissingDependencyError

TIMEOUT_S = 3600


def rerun_faults(path: Path) -> list[str]:
    """Run ``rerun mcap check --full`` on a file and return what it objects to.

    Raises:
        MissingDependencyError: When Rerun is not installed.
    """
    beside = Path(sys.executable).with_name("rerun")
    command = str(beside) if beside.is_file() else shutil.which("rerun")
    if command is None:
        raise MissingDependencyError(
            package="rerun-sdk", extra="dashboard", purpose="the second opinion of --rerun"
        )
    try:
        done = subprocess.run(
            [command, "mcap", "check", "--full", str(path)],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return [f"{path.name}: rerun mcap check did not end within {TIMEOUT_S} s"]
    if done.returncode == 0:
        return []
    said = (done.stderr.strip() or done.stdout.strip()).splitlines()
    return [f"{path.name}: rerun mcap check says: {said[-1] if said else 'nothing'}"]
