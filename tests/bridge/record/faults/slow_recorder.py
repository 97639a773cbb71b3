"""robot-gst on a slow disk: each write of an episode takes so long; a file says when it began."""

import os
import sys
import time
from pathlib import Path
from typing import Any

import robot_gst

REAL = os.pwritev


def main() -> None:
    delay_s, path = float(sys.argv.pop(1)), Path(sys.argv.pop(1))

    def slow(*arguments: Any) -> int:
        begun_ns = time.time_ns()
        time.sleep(delay_s)
        written = REAL(*arguments)
        with path.open("a") as begun:
            begun.write(f"{begun_ns}\n")
        return written

    os.pwritev = slow
    sys.exit(robot_gst.main())


if __name__ == "__main__":
    main()
