"""What one topic shows over a whole episode: numbers, times, rate, and whether it decodes."""

from array import array
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from bridge.episode.check_decode import Decoder
from bridge.episode.check_file import ScannedMessage
from bridge.errors import BridgeError

_WRAP = 1 << 32
_MAX_OPEN_GAPS = 64
ON_ITS_WAY_NS = 100_000_000


class SequenceWatch:
    """Counts missing sequence numbers; late ones are taken off again, a restart is no gap."""

    def __init__(self) -> None:
        """Start before the first number."""
        self.gaps = 0
        self.backward = 0
        """Numbers seen before, late ones and restarts."""
        self._next: int | None = None
        self._open: deque[tuple[int, int]] = deque(maxlen=_MAX_OPEN_GAPS)
        self._last_backward: int | None = None

    def see(self, sequence: int, *, may_skip: bool = False) -> None:
        """Take the next number in the order of the file.

        Args:
            sequence: The number.
            may_skip: What is missing before this one was left out on purpose.
        """
        if self._next is None:
            self._next = (sequence + 1) % _WRAP
            return
        ahead = (sequence - self._next) % _WRAP
        if ahead < _WRAP // 2:
            if ahead and not may_skip:
                self.gaps += ahead
                self._open.append((self._next, ahead))
            self._next = (sequence + 1) % _WRAP
            self._last_backward = None
            return
        self.backward += 1
        if self._fill(sequence):
            return
        # Two in a row that count on: the publisher has begun anew.
        if self._last_backward is not None and sequence == (self._last_backward + 1) % _WRAP:
            self._next = (sequence + 1) % _WRAP
            self._open.clear()
        self._last_backward = sequence

    def _fill(self, sequence: int) -> bool:
        for index, (start, length) in enumerate(self._open):
            at = (sequence - start) % _WRAP
            if at < length:
                del self._open[index]
                for rest in ((start, at), ((sequence + 1) % _WRAP, length - at - 1)):
                    if rest[1]:
                        self._open.append(rest)
                self.gaps -= 1
                return True
        return False


class Pauses:
    """The spans in which a recorder left messages out because it was told to."""

    def __init__(self, spans_ns: Iterable[tuple[int, int]]) -> None:
        """Take spans that do not overlap [ns]."""
        ordered = sorted(spans_ns)
        self._starts_ns = [start_ns for start_ns, _ in ordered]
        self._ends_ns = [end_ns for _, end_ns in ordered]

    def lies_between(self, before_ns: int, after_ns: int) -> bool:
        """Say whether two messages of a topic lie on both sides of a pause [ns].

        A message on its way when the recorder was told may be on either side.
        """
        index = bisect_left(self._starts_ns, after_ns) - 1
        return index >= 0 and before_ns < self._ends_ns[index] + ON_ITS_WAY_NS


@dataclass(kw_only=True)
class TopicCheck:
    """What was found on one topic."""

    messages: int = 0
    type_name: str = ""
    rate_hz: float = 0.0
    """Mean over the topic's own time, 0 for fewer than two messages."""
    sequence_gaps: int = 0
    """Numbers missing between those that are there."""
    sequences_backward: int = 0
    """Numbers repeated, late, or of a publisher that began anew."""
    declared_losses: int = 0
    """Gaps, queue drops and shed messages the ledger lists."""
    time_steps_back: int = 0
    """Messages whose log time is before that of the one before."""
    latency_median_s: float = 0.0
    """Log time minus publish time; large where the clocks differ."""
    latency_max_s: float = 0.0
    undecodable: int = 0
    first_fault: str = ""


@dataclass(kw_only=True)
class TopicWatch:
    """Follows one topic through all parts of an episode."""

    topic: str
    pauses: Pauses
    result: TopicCheck = field(default_factory=TopicCheck)
    sequences: SequenceWatch = field(default_factory=SequenceWatch)
    first_ns: int | None = None
    last_ns: int = 0
    latencies_ns: array = field(default_factory=lambda: array("d"))  # type: ignore[type-arg]

    def see(self, message: ScannedMessage, decoder: Decoder) -> None:
        """Take the next message in the order of the file."""
        head, result = message.head, self.result
        result.messages += 1
        result.type_name = message.schema.name if message.schema else ""
        may_skip = self.pauses.lies_between(self.last_ns, head.log_time_ns)
        self.sequences.see(head.sequence, may_skip=may_skip)
        if self.first_ns is None:
            self.first_ns = head.log_time_ns
        elif head.log_time_ns < self.last_ns:
            result.time_steps_back += 1
        self.last_ns = max(self.last_ns, head.log_time_ns)
        self.latencies_ns.append(head.log_time_ns - head.publish_time_ns)
        try:
            decoder.decode(self.topic, message)
        except BridgeError as error:
            result.undecodable += 1
            if not result.first_fault:
                result.first_fault = f"{self.topic}: {error}"

    def finish(self) -> TopicCheck:
        """Work out what needs all messages."""
        result = self.result
        result.sequence_gaps = self.sequences.gaps
        result.sequences_backward = self.sequences.backward
        span_s = (self.last_ns - (self.first_ns or 0)) * 1e-9
        if result.messages > 1 and span_s > 0:
            result.rate_hz = (result.messages - 1) / span_s
        if self.latencies_ns:
            latencies = np.frombuffer(self.latencies_ns, dtype=np.float64)
            result.latency_median_s = float(np.median(latencies)) * 1e-9
            result.latency_max_s = float(latencies.max()) * 1e-9
        return result
