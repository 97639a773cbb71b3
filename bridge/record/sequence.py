"""Counts what was lost on the way, from the numbers publishers give their messages.

A number that is skipped is booked as lost at once, and taken back when its message arrives late:
what remains booked is what never came. What came before the first number of a stream, and after
its last where its publisher does not say how many it has sent, is unknown and not claimed.
"""

import sys
from bisect import bisect_right
from dataclasses import dataclass, field
from typing import NamedTuple

from bridge.wire.session import WireSample

MAX_STREAMS = 10_000
MAX_HOLES = 8192
"""Runs of missing numbers remembered over all streams; of older ones a late message is a repeat."""
MAX_JUMP = 2**31
"""A step this large is another numbering (or a wrap), not messages lost."""
UNKNOWN = -1
"""In place of a ticket: nothing was booked."""
_WRAPS = (2**32, 2**64)


class Step(NamedTuple):
    """What one message says about the others of its stream."""

    gap: int = 0
    """Messages missing directly before this one."""
    repeated: bool = False
    """Seen before, or so late that its gap is forgotten."""
    fills: int | None = None
    """This message was booked as missing when the one with this ticket arrived."""


_NEXT = Step()
_REPEATED = Step(repeated=True)


@dataclass(slots=True)
class _Hole:
    first: int
    end: int
    ticket: int


@dataclass(slots=True)
class _Stream:
    first: int
    next: int
    newest_ns: int
    offset: int = 0
    """Added to a number to continue the count past a wrap."""
    holes: list[_Hole] = field(default_factory=list)


class SequenceTracker:
    """Follows each (topic, publisher); a restarted publisher is a new stream, not a gap."""

    def __init__(self) -> None:
        """Start without any stream."""
        self._streams: dict[tuple[str, bytes], _Stream] = {}
        self._num_holes = 0

    def observe(self, sample: WireSample, ticket: int = 0) -> Step:
        """Compare a message's number with the one expected; without a number nothing is known."""
        if sample.sequence is None or sample.source_gid is None:
            return _NEXT
        stream = self._streams.get((sample.topic, sample.source_gid))
        if stream is not None:
            number = sample.sequence + stream.offset
            if number == stream.next:  # nearly always
                stream.next += 1
                if sample.source_ns is not None and sample.source_ns > stream.newest_ns:
                    stream.newest_ns = sample.source_ns
                return _NEXT
            step = self._odd(stream, sample, ticket)
            if step is not None:
                return step
        self._begin(sample)
        return _NEXT

    def told(self, topic: str, gid: bytes, sent: int, ticket: int) -> int | None:
        """Book what a publisher has sent and nobody has seen; None where that cannot be."""
        stream = self._streams.get((topic, gid))
        gap = MAX_JUMP + 1 if stream is None else _unwrapped(sent, stream) - stream.next
        if stream is None or gap > MAX_JUMP:
            return None
        if gap > 0:
            self._remember(stream, _Hole(stream.next, stream.next + gap, ticket))
            stream.next += gap
        return max(0, gap)

    def _begin(self, sample: WireSample) -> None:
        key = (sample.topic, sample.source_gid or b"")
        before = self._streams.pop(key, None)
        if before is None and len(self._streams) >= MAX_STREAMS:
            before = self._streams.pop(next(iter(self._streams)))
        if before is not None:
            self._num_holes -= len(before.holes)
        number = sample.sequence or 0
        self._streams[key] = _Stream(number, number + 1, sample.source_ns or 0)

    def _odd(self, stream: _Stream, sample: WireSample, ticket: int) -> Step | None:
        """A number out of turn: ahead, late or repeated; None when the numbering begins anew."""
        number = _unwrapped(sample.sequence or 0, stream)
        if number >= stream.next:
            gap = number - stream.next
            if gap > MAX_JUMP:
                return None
            if gap:
                self._remember(stream, _Hole(stream.next, number, ticket))
            stream.offset = number - (sample.sequence or 0)
            stream.next = number + 1
            stream.newest_ns = max(stream.newest_ns, sample.source_ns or 0)
            return Step(gap=gap)
        booked = self._fill(stream, number)
        if booked is not None:
            return Step(fills=booked)
        # A copy or a late message is not younger than what was seen; a restart is.
        if sample.source_ns is not None and sample.source_ns > stream.newest_ns:
            return None
        if number < stream.first:  # sent before we listened, handed over later
            if number + 1 < stream.first:
                self._remember(stream, _Hole(number + 1, stream.first, UNKNOWN), at=0)
            stream.first = number
            return _NEXT
        return _REPEATED

    def _remember(self, stream: _Stream, hole: _Hole, *, at: int = sys.maxsize) -> None:
        stream.holes.insert(at, hole)
        self._num_holes += 1
        if self._num_holes > MAX_HOLES:
            del stream.holes[0]
            self._num_holes -= 1

    def _fill(self, stream: _Stream, number: int) -> int | None:
        """Take a number out of the missing ones; returns the ticket it was booked with."""
        at = bisect_right(stream.holes, number, key=lambda hole: hole.first) - 1
        if at < 0 or number >= stream.holes[at].end:
            return None
        hole = stream.holes[at]
        rest = [
            _Hole(first, end, hole.ticket)
            for first, end in ((hole.first, number), (number + 1, hole.end))
            if first < end
        ]
        stream.holes[at : at + 1] = rest
        self._num_holes += len(rest) - 1
        return hole.ticket


def _unwrapped(sequence: int, stream: _Stream) -> int:
    """Continue the count where a 32-bit or 64-bit number has wrapped."""
    number = sequence + stream.offset
    if abs(number - stream.next) <= MAX_JUMP:
        return number
    for wrap in _WRAPS:
        for candidate in (number + wrap, number - wrap):
            if abs(candidate - stream.next) <= MAX_JUMP // 2:
                return candidate
    return number
