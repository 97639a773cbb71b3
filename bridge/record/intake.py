"""The queue between the network thread and the writer thread: bounded, ordered, honest.

Bounded in bytes. A message that does not fit is dropped, and the drop itself is queued, so that
it is counted in the episode and the second it belongs to. Commands are never dropped and keep
their place among the messages.
"""

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from bridge.record.config import BYTES_PER_MB, RecorderConfig
from bridge.record.sequence import SequenceTracker, Step
from bridge.wire.session import WireSample

SMALL_BYTES = 65_536
OVERHEAD_BYTES = 512
"""What a queued message costs beside its data, roughly."""


@dataclass(frozen=True, kw_only=True)
class Received:
    """A message that was accepted."""

    sample: WireSample
    step: Step


@dataclass(kw_only=True)
class DropCount:
    """What was dropped of one topic in one second."""

    messages: int = 0
    bytes: int = 0
    gaps: int = 0


@dataclass(frozen=True, kw_only=True)
class Dropped:
    """Messages dropped between two accepted ones."""

    counts: dict[tuple[str, int], DropCount] = field(default_factory=dict)
    """By (topic, second of reception)."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """Something to do at this place in the stream."""

    action: Any
    received_ns: int


Entry = Received | Dropped | Command


class Intake:
    """Filled by network threads, emptied by the writer thread."""

    def __init__(self, config: RecorderConfig) -> None:
        """Set the budget."""
        self._budget = config.queue_mb * BYTES_PER_MB
        self._large_budget = self._budget - config.small_reserve_mb * BYTES_PER_MB
        self._entries: deque[Entry] = deque()
        self._tracker = SequenceTracker()
        self._ready = threading.Condition()
        self.queued_bytes = 0

    def put(self, sample: WireSample) -> None:
        """Take a message; never waits, never raises."""
        size = len(sample.data) + OVERHEAD_BYTES
        budget = self._budget if len(sample.data) < SMALL_BYTES else self._large_budget
        with self._ready:
            step = self._tracker.observe(sample)
            if self.queued_bytes + size > budget:
                self._count_drop(sample, step)
            else:
                self.queued_bytes += size
                self._entries.append(Received(sample=sample, step=step))
            self._ready.notify()

    def _count_drop(self, sample: WireSample, step: Step) -> None:
        last = self._entries[-1] if self._entries else None
        if not isinstance(last, Dropped):
            last = Dropped()
            self._entries.append(last)
        key = (sample.topic, second_of(sample.received_ns))
        count = last.counts.setdefault(key, DropCount())
        count.messages += 1
        count.bytes += len(sample.data)
        count.gaps += step.gap

    def put_command(self, command: Command) -> None:
        """Queue a command behind everything received so far."""
        with self._ready:
            self._entries.append(command)
            self._ready.notify()

    def get(self, timeout_s: float) -> Entry | None:
        """Return the oldest entry, or None when nothing came in time."""
        with self._ready:
            if not self._entries:
                self._ready.wait(timeout_s)
            if not self._entries:
                return None
            entry = self._entries.popleft()
            if isinstance(entry, Received):
                self.queued_bytes -= len(entry.sample.data) + OVERHEAD_BYTES
            return entry


def second_of(stamp_ns: int) -> int:
    """The whole second a stamp lies in."""
    return stamp_ns // 1_000_000_000
