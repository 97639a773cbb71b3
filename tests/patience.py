"""Waiting for what must come, and saying what did not."""

import time
from collections.abc import Callable


def wait_until(is_so: Callable[[], object], what: str = "it", *, within_s: float = 20.0) -> None:
    end_s = time.monotonic() + within_s
    while not is_so():
        assert time.monotonic() < end_s, f"{what} did not happen"
        time.sleep(0.01)
