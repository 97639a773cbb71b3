"""robot-gst, but it kills itself at a chosen system call of an episode's end."""

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import robot_gst
from bridge.episode.writer import EpisodeWriter


def main() -> None:
    phase, call, number, side = sys.argv.pop(1).split(":")
    owner = Path if call == "rename" else os
    real = getattr(owner, call)
    left = int(number)
    armed = phase == "start"

    def counted(*arguments: Any) -> Any:
        nonlocal left
        left -= armed
        if armed and left == 0 and side == "before":
            os.kill(os.getpid(), signal.SIGKILL)
        result = real(*arguments)
        if armed and left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, call, counted)
    close: Callable[[EpisodeWriter], Path] = EpisodeWriter.close

    def close_armed(writer: EpisodeWriter) -> Path:
        nonlocal armed
        armed = True
        return close(writer)

    EpisodeWriter.close = close_armed  # type: ignore[method-assign]
    sys.exit(robot_gst.main())


if __name__ == "__main__":
    main()
