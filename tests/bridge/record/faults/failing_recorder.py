"""robot-gst whose disk breaks: from SIGUSR1 on, what lies in its run folder takes no more writes.

Arguments: those of robot-gst.
"""

import errno
import os
import signal
import sys
from pathlib import Path
from typing import Any

import robot_gst

REAL = os.pwritev
BROKEN: list[int] = []


def main() -> None:
    run = str(Path(sys.argv[2]).resolve())

    def failing(descriptor: int, *arguments: Any) -> int:
        if BROKEN and str(Path(f"/proc/self/fd/{descriptor}").readlink()).startswith(run + "/"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return REAL(descriptor, *arguments)

    os.pwritev = failing
    signal.signal(signal.SIGUSR1, lambda number, _: BROKEN.append(number))
    sys.exit(robot_gst.main())


if __name__ == "__main__":
    main()
