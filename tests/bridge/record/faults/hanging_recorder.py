"""robot-gst whose disk hangs: from SIGUSR1 to SIGUSR2 no write in its run folder returns.

Arguments: those of robot-gst.
"""

import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

import robot_gst

REAL = os.pwritev
ANSWERS = threading.Event()
ANSWERS.set()


def main() -> None:
    run = str(Path(sys.argv[2]).resolve())

    def hanging(descriptor: int, *arguments: Any) -> int:
        name = "" if ANSWERS.is_set() else str(Path(f"/proc/self/fd/{descriptor}").readlink())
        if name.startswith(run + "/"):
            ANSWERS.wait()
        return REAL(descriptor, *arguments)

    os.pwritev = hanging
    signal.signal(signal.SIGUSR1, lambda number, _: ANSWERS.clear())
    signal.signal(signal.SIGUSR2, lambda number, _: ANSWERS.set())
    sys.exit(robot_gst.main())


if __name__ == "__main__":
    main()
