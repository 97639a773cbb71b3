"""robot-gst, whose network thread fails: SIGUSR1 runs out of memory once, SIGUSR2 hangs for 2 s."""

import signal
import sys
import time
from typing import Any

import robot_gst
from bridge.wire import session

REAL = session.copy_sample
WANTED: list[int] = []


def choking(sample: Any, *arguments: Any, **options: Any) -> session.WireSample:
    if WANTED and str(sample.key_expr).endswith("joint_states"):
        if WANTED.pop() == signal.SIGUSR1:
            raise MemoryError("on purpose")
        time.sleep(2.0)
    return REAL(sample, *arguments, **options)


def main() -> None:
    session.copy_sample = choking
    for number in (signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, lambda number, _: WANTED.append(number))
    sys.exit(robot_gst.main())


if __name__ == "__main__":
    main()
