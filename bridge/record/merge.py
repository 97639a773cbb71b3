"""Puts small messages, encoded images and commands back in order for the writer.

Small messages never wait for images. A barrier command (start, stop ...) waits until every image
received before it has come out of its encoder, and holds back everything received after it.
"""

from collections import deque
from collections.abc import Iterable, Iterator

from bridge.record.entries import Command, Dropped, Entry, Item


class Merge:
    """Fed with what the intake gives; yields what may be dealt with now."""

    def __init__(self) -> None:
        """Start empty."""
        self._entries: deque[Entry] = deque()
        self._held: deque[Item] = deque()
        self.images_out = 0
        """Images yielded or given up."""

    @property
    def images_seen(self) -> int:
        """Images that have come out of their encoders."""
        return self.images_out + len(self._held)

    @property
    def is_waiting(self) -> bool:
        """Say whether a command waits for images."""
        return bool(self._entries)

    def feed(self, entries: Iterable[Entry], images: Iterable[Item]) -> None:
        """Add what came in."""
        self._entries.extend(entries)
        self._held.extend(images)

    def ready(self) -> Iterator[Entry]:
        """Yield, in order, all that need not wait; what is yielded is forgotten."""
        while True:
            while self._entries and not _is_barrier(self._entries[0]):
                yield self._entries.popleft()
            barrier = self._entries[0] if self._entries else None
            if not isinstance(barrier, Command):
                yield from self._images_before(None)
                return
            yield from self._images_before(barrier.ticket)
            if self.images_out < barrier.images_before:
                return
            yield self._entries.popleft()

    def _images_before(self, ticket: int | None) -> Iterator[Item]:
        # One by one: what has not been yielded must be found by rest(), called in between.
        at = 0
        while at < len(self._held):
            item = self._held[at]
            if ticket is None or item.ticket < ticket:
                del self._held[at]
                self.images_out += 1
                yield item
            else:
                at += 1

    def rest(self) -> list[Item | Dropped]:
        """Give up what has not been yielded, up to the next barrier; commands stay."""
        barrier = next((entry for entry in self._entries if _is_barrier(entry)), None)
        ticket = barrier.ticket if isinstance(barrier, Command) else None
        given_up: list[Item | Dropped] = list(self._images_before(ticket))
        kept: deque[Entry] = deque()
        for entry in self._entries:
            is_late = (
                ticket is not None and not isinstance(entry, Command) and entry.ticket > ticket
            )
            if isinstance(entry, Command) or is_late:
                kept.append(entry)
            else:
                given_up.append(entry)
        self._entries = kept
        return given_up


def _is_barrier(entry: Entry) -> bool:
    return isinstance(entry, Command) and entry.is_barrier
