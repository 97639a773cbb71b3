"""What a command starts ends with it, even when it is killed and can tell nobody."""

import os
import signal
import threading
import time
from collections.abc import Mapping

STARTED_BY = "GST_STARTED_BY"
"""Environment variable: process id of the command that started this one."""
_LOOK_S = 0.5


def ending_with_me(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment for a command that is to end when this process does."""
    return {**environment, STARTED_BY: str(os.getpid())}


def end_with_starter() -> None:
    """Watch the process that started this one, where it asked for that, and end as by SIGTERM."""
    starter = os.environ.pop(STARTED_BY, "")  # what this one starts has its own
    if not starter:
        return

    def watch() -> None:
        while str(os.getppid()) == starter:
            time.sleep(_LOOK_S)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="end_with_starter", daemon=True).start()
