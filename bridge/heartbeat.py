"""A command that works says so, from its first second on; imports nothing heavy."""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress


class Heartbeat:
    """Says what is being done where nothing was said for a while."""

    def __init__(self, first_s: float = 0.7, silence_s: float = 4.0) -> None:
        """Nothing is being done; the first word of a command comes sooner."""
        self._first_s, self._later_s, self._silence_s = first_s, silence_s, silence_s
        self.said_s = time.monotonic()
        self._now: Callable[[], str] | None = None

    @contextmanager
    def doing(self, text: Callable[[], str] | None) -> Iterator[None]:
        """Say this while the block lasts; None says nothing: it waits for others."""
        before, self._now = self._now, text
        try:
            yield
        finally:
            self._now = before

    def beat(self) -> None:
        """Say it, where nothing was said for so long."""
        text, now = self._now, time.monotonic()
        if text is not None and now - self.said_s >= self._silence_s:
            self.said_s, self._silence_s = now, self._later_s
            with suppress(OSError, ValueError):  # nobody listens any more
                sys.stderr.write(f"{text()}\n")
                sys.stderr.flush()

    @contextmanager
    def watching(self, words: Sequence[str]) -> Iterator[None]:
        """Beat while a command works, from a thread of its own, unless its words say quiet."""
        began = self.said_s = time.monotonic()
        ended, self._silence_s = threading.Event(), self._first_s

        def watch() -> None:
            while not ended.wait(0.1):
                self.beat()

        def text() -> str:
            return f"{' '.join(words[:1])}: at work, {time.monotonic() - began:.0f} s"

        watcher = threading.Thread(target=watch, name="heartbeat", daemon=True)
        watcher.start()
        try:
            with self.doing(None if {"-q", "--quiet"} & {*words} else text):
                yield
        finally:  # no thread may write while Python ends
            ended.set()
            watcher.join()


BEAT = Heartbeat()
"""Of this process."""
