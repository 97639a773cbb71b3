"""robot-gst on a slow disk: each write of an episode takes so long; a file tells when it works.

Its lines: the writing thread came round, a write began, or it ended, and the time [ns].
"""

import os
import sys
import time
from pathlib import Path
from typing import Any

import robot_gst
from bridge.episode.writer import EpisodeWriter

WRITE, TICK = os.pwritev, EpisodeWriter.tick


def main() -> None:
    delay_s, path = float(sys.argv.pop(1)), Path(sys.argv.pop(1))
    account = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def note(what: str) -> None:
        os.write(account, f"{what} {time.time_ns()}\n".encode())

    def slow(*arguments: Any) -> int:
        note("began")
        time.sleep(delay_s)
        written = WRITE(*arguments)
        note("ended")
        return written

    def tick(writer: EpisodeWriter) -> None:
        TICK(writer)
        note("tick")

    os.pwritev = slow
    EpisodeWriter.tick = tick  # type: ignore[method-assign]
    sys.exit(robot_gst.main())


if __name__ == "__main__":
    main()
