"""The last seconds before a start, kept in memory: bounded in seconds and in bytes."""

from collections import deque
from collections.abc import Callable

from bridge.clock import ns_from_s
from bridge.record.entries import Dropped, Item
from bridge.record.intake import OVERHEAD_BYTES


class PreRoll:
    """Holds messages as they would be written; what falls out at the old end is passed on."""

    def __init__(self, *, seconds: float, max_bytes: int, passed: Callable[[Item], None]) -> None:
        """Set the bounds.

        Args:
            seconds: How far back it reaches [s]; 0 holds nothing.
            max_bytes: Memory; with less than the seconds need, it reaches less far.
            passed: Called with each message that is too old now.
        """
        self._span_ns = ns_from_s(seconds)
        self._max_bytes = max_bytes
        self._passed = passed
        self._entries: deque[Item | Dropped] = deque()
        self.bytes = 0

    @property
    def is_on(self) -> bool:
        """Say whether anything is held at all."""
        return self._span_ns > 0

    def add(self, entry: Item | Dropped) -> None:
        """Hold a message, or the count of messages that were left out."""
        if not self.is_on:
            if isinstance(entry, Item):
                self._passed(entry)
            return
        self._entries.append(entry)
        self.bytes += _size(entry)
        while self.bytes > self._max_bytes:
            self._let_go()

    def trim(self, now_ns: int) -> None:
        """Let go of what is too old."""
        while self._entries and self._entries[0].received_ns < now_ns - self._span_ns:
            self._let_go()

    def _let_go(self) -> None:
        entry = self._entries.popleft()
        self.bytes -= _size(entry)
        if isinstance(entry, Item):
            self._passed(entry)

    def held(self, now_ns: int) -> list[Item | Dropped]:
        """Return what lies within the span, in order of arrival."""
        self.trim(now_ns)
        return sorted(self._entries, key=lambda entry: entry.ticket)

    def empty(self) -> None:
        """Let go of everything: it is in an episode now."""
        while self._entries:
            self._let_go()

    def seconds(self, now_ns: int) -> float:
        """How far back it reaches now [s]."""
        first = self._entries[0].received_ns if self._entries else now_ns
        return max(0, now_ns - first) / 1e9


def _size(entry: Item | Dropped) -> int:
    return OVERHEAD_BYTES + (len(entry.sample.data) if isinstance(entry, Item) else 0)
