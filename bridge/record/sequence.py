"""Counts what was lost on the way, from the numbers publishers give their messages."""

from typing import NamedTuple

from bridge.wire.session import WireSample

MAX_STREAMS = 10_000


class Step(NamedTuple):
    """What one message says about those before it."""

    gap: int
    """Messages missing directly before this one."""
    repeated: bool
    """Older than, or the same as, one seen before."""


class SequenceTracker:
    """Follows each (topic, publisher); a restarted publisher is a new stream, not a gap."""

    def __init__(self) -> None:
        """Start without any stream."""
        self._next: dict[tuple[str, bytes], int] = {}

    def observe(self, sample: WireSample) -> Step:
        """Compare a message's number with the one expected; without a number nothing is known."""
        if sample.sequence is None or sample.source_gid is None:
            return Step(0, False)
        stream = (sample.topic, sample.source_gid)
        expected = self._next.get(stream)
        if expected is None and len(self._next) >= MAX_STREAMS:
            del self._next[next(iter(self._next))]
        if expected is not None and sample.sequence < expected:
            return Step(0, True)
        self._next[stream] = sample.sequence + 1
        return Step(0 if expected is None else sample.sequence - expected, False)
