"""Chunks of a live recording on their way to the disk.

A thread of its own writes them, so that nobody waits for the disk. Each write takes all chunks of
small messages and then one of images, so that small messages wait for one write and their own. What
the disk refused it may take without the images.
"""

import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from bridge.episode.mcap.data_section import DataSection, EncodedChunk

LOOK_S = 0.05
"""The thread looks for chunks this often, rather than being woken by each."""
_INDEX_BYTES = 15
"""Of a message index without entries, which have 16 bytes each."""


class _Small(NamedTuple):
    chunk: EncodedChunk
    since_s: float


def _size(chunk: EncodedChunk) -> int:
    """Bytes of a chunk and of its message indexes."""
    entries = sum(map(len, chunk.index.values()))
    return chunk.entry.chunk_length + _INDEX_BYTES * len(chunk.index) + 8 * entries


class ChunkQueue:
    """Writes chunks in a thread. The owner's calls are for one thread."""

    def __init__(self, section: DataSection, *, monotonic: Callable[[], float]) -> None:
        """Start the thread."""
        self._section = section
        self._monotonic = monotonic
        self._small: deque[_Small] = deque()
        self._bulk: deque[EncodedChunk] = deque()
        self._error: OSError | None = None
        self._is_held = False
        """Nothing is written after an error, until its owner knows and calls again."""
        self._busy_since_s: float | None = None
        self._is_ending = False
        self._changed = threading.Condition()
        self.small_bytes = 0
        self.bulk_bytes = 0
        """Bytes of large chunks that wait."""
        self._thread = threading.Thread(target=self._work, name="episode disk", daemon=True)
        self._thread.start()

    def add(self, chunk: EncodedChunk, *, is_small: bool, since_s: float) -> None:
        """Take a chunk; never waits."""
        with self._changed:
            if is_small:
                self._small.append(_Small(chunk, since_s))
                self.small_bytes += _size(chunk)
            else:
                self._bulk.append(chunk)
                self.bulk_bytes += _size(chunk)

    def raise_error(self) -> None:
        """Raise what the disk said since the last call; with the call after, it is tried again."""
        if not self._is_held:
            return
        with self._changed:
            error, self._error = self._error, None
            if error is None:
                self._is_held = False
                self._changed.notify_all()
        if error is not None:
            raise error

    def _waiting(self) -> int:
        return self.small_bytes + self.bulk_bytes

    def wait_for_room(self, num_bytes: int, limit: int) -> None:
        """Wait until a chunk may be added."""
        if not self._waiting() or self._waiting() + num_bytes <= limit:
            return
        self._wait_until(lambda: not self._waiting() or self._waiting() + num_bytes <= limit)

    def _wait_until(self, is_so: Callable[[], bool]) -> None:
        self.raise_error()
        with self._changed:
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._error is not None or is_so())
        self.raise_error()

    def drain(self) -> None:
        """Wait until everything is written; then the file is the caller's until the next ``add``.

        Raises:
            OSError: When the disk refuses; what waits is kept, and tried again with the next call.
        """
        self._wait_until(lambda: not (self._small or self._bulk or self._busy_since_s is not None))

    def oldest_s(self) -> float | None:
        """When the oldest small message came that is not on the disk yet, None without one."""
        with self._changed:
            return self._small[0].since_s if self._small else None

    def busy_s(self) -> float:
        """How long the write that is under way has taken so far [s]."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else self._monotonic() - since_s

    def _work(self) -> None:
        error = None
        while True:
            with self._changed:
                while not self._is_ending and (self._is_held or not (self._small or self._bulk)):
                    self._changed.wait(LOOK_S)
                if self._is_ending:
                    break
                small = [each.chunk for each in self._small]
                bulk = [self._bulk[0]] if self._bulk and not (small and error) else []
                self._busy_since_s = self._monotonic()
            error = None
            try:
                self._section.add_chunks(small + bulk)
            except OSError as found:
                error = found
            with self._changed:
                self._busy_since_s = None
                self._error, self._is_held = error, error is not None
                if error is None:
                    self._forget(len(small), len(bulk))
                self._changed.notify_all()

    def _forget(self, num_small: int, num_bulk: int) -> None:
        for _ in range(num_small):
            self.small_bytes -= _size(self._small.popleft().chunk)
        for _ in range(num_bulk):
            self.bulk_bytes -= _size(self._bulk.popleft())

    def end(self) -> None:
        """End the thread after the write under way; what still waits is given up."""
        with self._changed:
            self._is_ending = True
            self._changed.notify_all()
        self._thread.join()
