"""What becomes of processes that need not be our children."""

import time
from pathlib import Path


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
