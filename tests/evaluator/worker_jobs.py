"""Work for several processes; a module of its own, so that they can import it."""

import os
import signal
import sys
import time
import warnings


def where(number: int) -> tuple[int, int]:
    """Say what was asked, and who answers."""
    time.sleep(0.002)
    return number, os.getpid()


def surroundings(number: int) -> tuple[int, bool, str | None]:
    """Say who answers, whether torch is loaded there, and how many threads NumPy may start."""
    time.sleep(0.002)
    return os.getpid(), "torch" in sys.modules, os.environ.get("OMP_NUM_THREADS")


def fail(number: int) -> int:
    """Fail with what nobody expects, at one item."""
    time.sleep(0.002)
    if number == 37:
        message = f"item {number}"
        raise LookupError(message)
    return number


def warn(number: int) -> int:
    """Warn of every item."""
    time.sleep(0.002)
    warnings.warn(f"item {number}", RuntimeWarning, stacklevel=1)
    return number


def signal_elsewhere(owner: int, number: signal.Signals, item: int) -> int:
    """Send a signal to whoever does this, unless it is the owner."""
    time.sleep(0.002)
    if os.getpid() != owner:
        os.kill(os.getpid(), number)
    return item
