"""Chunks of a live recording on their way to the disk.

A thread of its own writes them, so that nobody waits for the disk. Small messages never wait behind
images: their chunks go first, and while one has to wait for a slow write it is also put into a
journal, a file beside the part with a descriptor of its own. The journal goes when the episode is
finished; ``recover`` takes from it what the part lacks.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.data_section import DataSection, EncodedChunk
from bridge.episode.mcap.part_file import PartFile

JOURNAL = ".journal"
"""Takes the place of ``.part`` in the name of the journal."""
JOURNAL_AFTER_S = 0.1
"""A small chunk that has waited for so long goes into the journal too [s]."""
SLOW_FOR_S = 2.0
"""For so long after the journal was needed it is used without that delay [s]."""
JOURNAL_BYTES = 4 << 20
"""A longer journal begins anew when the part holds everything in it."""
_INDEX_BYTES = 15
"""Of a message index without entries, which have 16 bytes each."""
BATCH_BYTES = 4 << 20
"""Large chunks written with one call: a disk that is slow by the call keeps up."""


def journal_path(part_path: Path) -> Path:
    """Name the journal of a part."""
    return part_path.with_name(part_path.name.removesuffix(".part") + JOURNAL)


@dataclass(slots=True)
class _Small:
    chunk: EncodedChunk
    since_s: float
    closed_s: float
    is_in_journal: bool = False


def _size(chunk: EncodedChunk) -> int:
    """Bytes of a chunk and of its message indexes."""
    return chunk.length + sum(_INDEX_BYTES + 8 * len(entries) for entries in chunk.index.values())


class ChunkQueue:
    """Writes chunks in a thread. The owner's calls are for one thread."""

    def __init__(
        self,
        section: DataSection,
        part_path: Path,
        *,
        header: bytes,
        monotonic: Callable[[], float],
    ) -> None:
        """Start the thread."""
        self._section = section
        self._header = header
        self._monotonic = monotonic
        self._small: deque[_Small] = deque()
        self._bulk: deque[EncodedChunk] = deque()
        self._error: OSError | None = None
        self._is_held = False
        """Nothing is written after an error, until its owner knows and calls again."""
        self._batch_bytes = BATCH_BYTES
        self._busy_since_s: float | None = None
        self._is_ending = False
        self._changed = threading.Condition()
        self.small_bytes = 0
        self.bulk_bytes = 0
        """Bytes of large chunks that wait."""
        self._journal = _Journal(journal_path(part_path))
        self._journal_thread: threading.Thread | None = None
        self._needed_s: float | None = None
        self._thread = threading.Thread(target=self._work, name="episode disk", daemon=True)
        self._thread.start()

    def add(self, chunk: EncodedChunk, *, is_small: bool, since_s: float) -> None:
        """Take a chunk; never waits."""
        with self._changed:
            if is_small:
                self._small.append(_Small(chunk, since_s, self._monotonic()))
                self.small_bytes += _size(chunk)
            else:
                self._bulk.append(chunk)
                self.bulk_bytes += _size(chunk)
            self._changed.notify_all()

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
        self.raise_error()
        with self._changed:
            self._changed.wait_for(
                lambda: (
                    self._error is not None
                    or not self._waiting()
                    or self._waiting() + num_bytes <= limit
                )
            )
        self.raise_error()

    def drain(self) -> None:
        """Wait until everything is written; then the file is the caller's until the next ``add``.

        Raises:
            OSError: When the disk refuses; what waits is kept, and tried again with the next call.
        """
        self.raise_error()
        with self._changed:
            self._changed.wait_for(
                lambda: (
                    self._error is not None
                    or not (self._small or self._bulk or self._busy_since_s is not None)
                )
            )
        self.raise_error()

    def tick(self) -> None:
        """Have the journal written when the part takes too long; call it often."""
        if self._journal.has_failed or not self._waits_too_long():
            return
        if self._journal_thread is None:
            self._journal_thread = threading.Thread(
                target=self._keep_journal, name="episode journal", daemon=True
            )
            self._journal_thread.start()
        with self._changed:
            self._changed.notify_all()

    def is_slow(self) -> bool:
        """Whether the disk was too slow for small messages a moment ago."""
        return self._needed_s is not None and self._monotonic() - self._needed_s < SLOW_FOR_S

    def _waits_too_long(self) -> bool:
        late_s = self._monotonic() - (0.0 if self.is_slow() else JOURNAL_AFTER_S)
        return any(
            not small.is_in_journal and small.closed_s <= late_s for small in list(self._small)
        )

    def oldest_s(self) -> float | None:
        """When the oldest small message came that is on no disk yet, None without one."""
        with self._changed:
            return next((small.since_s for small in self._small if not small.is_in_journal), None)

    def busy_s(self) -> float:
        """How long the write that is under way has taken so far [s]."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else self._monotonic() - since_s

    def _work(self) -> None:
        turn_of_bulk = False
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: (
                        self._is_ending or (not self._is_held and bool(self._small or self._bulk))
                    )
                )
                if self._is_ending:
                    break
                small = [] if turn_of_bulk and self._bulk else [each.chunk for each in self._small]
                turn_of_bulk = bool(small)
                chunks = small or self._batch()
                self._busy_since_s = self._monotonic()
            error = None
            try:
                self._section.add_chunks(chunks)
            except OSError as found:
                error = found
            with self._changed:
                self._busy_since_s = None
                self._error, self._is_held = error, error is not None
                if error is None:
                    self._forget(len(chunks), is_small=bool(small))
                    self._batch_bytes = BATCH_BYTES
                else:
                    self._batch_bytes = 0  # what does not fit together may fit alone
                self._changed.notify_all()

    def _batch(self) -> list[EncodedChunk]:
        chunks: list[EncodedChunk] = []
        size = 0
        for chunk in self._bulk:
            size += chunk.length
            if chunks and size > self._batch_bytes:
                break
            chunks.append(chunk)
        return chunks

    def _forget(self, count: int, *, is_small: bool) -> None:
        for _ in range(count):
            if is_small:
                self.small_bytes -= _size(self._small.popleft().chunk)
            else:
                self.bulk_bytes -= _size(self._bulk.popleft())

    def _keep_journal(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_ending or self._waits_too_long())
                if self._is_ending:
                    return
                waiting = [small for small in self._small if not small.is_in_journal]
                self._needed_s = self._monotonic()
                is_empty = not any(small.is_in_journal for small in self._small)
            if is_empty and self._journal.bytes > JOURNAL_BYTES:
                self._journal.begin_anew()
            if not self._journal.add(self._header, [small.chunk for small in waiting]):
                return
            with self._changed:
                for small in waiting:
                    small.is_in_journal = True

    def end(self) -> None:
        """End the threads after the write under way; what still waits is given up."""
        with self._changed:
            self._is_ending = True
            self._changed.notify_all()
        self._thread.join()
        if self._journal_thread is not None:
            self._journal_thread.join()
        self._journal.close()

    def remove_journal(self) -> None:
        """Remove the journal, if there is one: the part holds everything."""
        self._journal.remove()


class _Journal:
    """A file of chunks without an end; made when it is first needed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.bytes = 0
        self.has_failed = False
        """A disk that takes no journal: the part is all there is."""
        self._file: PartFile | None = None

    def add(self, header: bytes, chunks: list[EncodedChunk]) -> bool:
        """Append chunks; False when the disk takes none."""
        buffers = [buffer for chunk in chunks for buffer in chunk.buffers]
        try:
            if self._file is None:
                self.path.unlink(missing_ok=True)  # of a part that was given up under this name
                self._file = PartFile.create(self.path)
            if not self._file.offset:
                buffers = [mcap_format.MAGIC + header, *buffers]
            self._file.append(buffers)
        except OSError:
            self.has_failed = True
            return False
        self.bytes = self._file.offset
        return True

    def begin_anew(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.truncate(0, 0)
                self.bytes = 0

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def remove(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                self.path.unlink(missing_ok=True)
            self._file = None
