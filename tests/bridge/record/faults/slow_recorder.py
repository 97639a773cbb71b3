"""robot-gst on a slow disk: each write of an episode takes so long."""

import os
import sys
import time
from typing import Any

import robot_gst

REAL = os.pwritev


def main() -> None:
    delay_s = float(sys.argv.pop(1))

    def slow(*arguments: Any) -> int:
        time.sleep(delay_s)
        return REAL(*arguments)

    os.pwritev = slow
    sys.exit(robot_gst.main())


if __name__ == "__main__":
    main()
