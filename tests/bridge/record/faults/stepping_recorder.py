"""robot-gst on a machine whose clock is set: SIGUSR1 puts it an hour ahead, SIGUSR2 an hour back.

Arguments: those of robot-gst.
"""

import signal
import sys
import time

STEP_NS = 3_600 * 10**9
REAL_NS = time.time_ns
SHIFT_NS = [0]


def shifted_ns() -> int:
    return REAL_NS() + SHIFT_NS[0]


def step(number: int, _: object) -> None:
    SHIFT_NS[0] += STEP_NS if number == signal.SIGUSR1 else -STEP_NS


def main() -> None:
    time.time_ns = shifted_ns
    time.time = lambda: shifted_ns() / 1e9
    signal.signal(signal.SIGUSR1, step)
    signal.signal(signal.SIGUSR2, step)
    import robot_gst  # after the clock, which modules keep by name

    sys.exit(robot_gst.main())


if __name__ == "__main__":
    main()
