"""What was received and what was lost: per topic and second, and in total.

Of every topic, as long as its messages are numbered:
sent = received - repeated + gaps + queue_drops.
"""

import json
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, fields
from typing import Any

from bridge.episode.contract import Presence
from bridge.record.inspection import GOOD, MessageState
from bridge.record.queue import MAX_WARNINGS, Dropped, Item, second_of
from bridge.record.sequence import MAX_STREAMS

OTHER_TOPICS = "(further topics)"
"""The account of topics beyond those an episode may have."""


@dataclass(kw_only=True, slots=True)
class Tally:
    """Counts of one topic."""

    received: int = 0
    gaps: int = 0
    """Lost before they reached the recorder, by the publishers' numbers. Negative in a second in
    which more of them arrived late than went missing."""
    queue_drops: int = 0
    """Reached the recorder, which could not keep them."""
    undecodable: int = 0
    """Written as they are, but not what their type says."""
    newer_version: int = 0
    """JSON records of a newer schema version than this software knows."""
    unknown_type: int = 0
    """Written as they are, of a type this software does not know."""
    repeated: int = 0
    """Written although their number was written before."""
    unnumbered: int = 0
    """Without a sequence number, so that losses cannot be seen."""
    bytes: int = 0
    """As they came over the wire."""
    clock_offset_ns: int | None = None
    """The least time from publishing to receiving: transport delay plus clock offset."""

    def add(self, other: "Tally") -> None:
        """Add another tally to this one."""
        for name in _COUNTS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        if other.clock_offset_ns is not None:
            self.see_offset(other.clock_offset_ns)

    def see_offset(self, offset_ns: int) -> None:
        """Keep the least offset."""
        if self.clock_offset_ns is None or offset_ns < self.clock_offset_ns:
            self.clock_offset_ns = offset_ns

    @property
    def lost(self) -> int:
        """Everything that was sent and is not in the episode."""
        return self.gaps + self.queue_drops

    def to_record(self) -> dict[str, Any]:
        """Counts by name."""
        return {name: getattr(self, name) for name in _NAMES}


_NAMES = tuple(item.name for item in fields(Tally))
_COUNTS = tuple(name for name in _NAMES if name != "clock_offset_ns")


class Ledger:
    """The accounts of one episode. Written by one thread; totals may be read by any."""

    def __init__(self, max_topics: int = 4096) -> None:
        """Start empty."""
        self.warnings: list[str] = []
        self.presences: dict[str, Presence] = {}
        self.answering: Callable[[], Collection[str]] = tuple
        """Topics whose sources have said, some time, how many messages they had sent."""
        self._max_topics = max_topics
        self._totals: dict[str, Tally] = {}
        self._open: dict[tuple[int, str], Tally] = {}
        self._streams: set[tuple[str, bytes]] = set()
        self._told: set[tuple[str, bytes]] = set()
        self._closing = threading.Lock()
        self._first = 0

    def begin(self, ticket: int) -> None:
        """Count what carries this ticket or a later one."""
        self._first = ticket

    def warn(self, text: str) -> None:
        """Keep a remark about the recording; each is kept once."""
        if text not in self.warnings and len(self.warnings) < MAX_WARNINGS:
            self.warnings.append(text)

    def _tally(self, topic: str, second: int) -> Tally:
        tally = self._open.get((second, topic))
        if tally is None:
            if topic not in self._totals:
                if len(self._totals) >= self._max_topics and topic != OTHER_TOPICS:
                    return self._tally(OTHER_TOPICS, second)
                self._totals[topic] = Tally()
            tally = self._open[second, topic] = Tally()
        return tally

    def _book(self, tally: Tally, item: Item) -> None:
        step = item.step
        tally.gaps += step.gap
        tally.gaps -= step.fills is not None and step.fills >= self._first

    def count_received(self, item: Item, found: MessageState, made_ns: int | None = None) -> None:
        """Book a message that was written, and was made then."""
        sample = item.sample
        tally = self._tally(sample.topic, second_of(sample.received_ns))
        tally.received += 1
        tally.bytes += item.size
        self._book(tally, item)
        tally.repeated += item.step.repeated
        tally.unnumbered += sample.sequence is None
        gid = sample.source_gid
        if gid is not None and len(self._streams) < MAX_STREAMS:
            self._streams.add((sample.topic, gid))
        presence = self.presences.get(sample.topic)
        if presence is None and len(self.presences) < self._max_topics:
            presence = self.presences[sample.topic] = Presence()
        if presence is not None:
            presence.see(sample.received_ns)
        if made_ns is not None:
            tally.see_offset(sample.received_ns - made_ns)
        if found is not GOOD:
            setattr(tally, found.value, getattr(tally, found.value) + 1)

    def count_refused(self, item: Item) -> None:
        """Book a message that came out of the queue but could not be written."""
        sample = item.sample
        tally = self._tally(sample.topic, second_of(sample.received_ns))
        tally.queue_drops += not item.step.repeated
        self._book(tally, item)

    def count_dropped(self, dropped: Dropped) -> None:
        """Book messages that were not taken in."""
        for (topic, second), count in dropped.counts.items():
            tally = self._tally(topic, second)
            tally.queue_drops += count.messages
            tally.gaps += count.gaps - sum(ticket >= self._first for ticket in count.fills)
        self._told |= dropped.told
        for text in dropped.warnings:
            self.warn(text)

    def close_seconds(self, before: int | None = None) -> Iterator[dict[str, Any]]:
        """Yield a drops record for each topic and second that is over, and forget it."""
        for second, topic in sorted(self._open):
            if before is not None and second >= before:
                continue
            with self._closing:
                tally = self._open.pop((second, topic))
                self._totals[topic].add(tally)
            yield {"schema_version": 1, "topic": topic, "second": second, **tally.to_record()}

    def totals(self) -> dict[str, Tally]:
        """Counts by topic, seconds still open included."""
        with self._closing:
            closed, still_open = self._totals.copy(), self._open.copy()
            totals = {topic: Tally(**tally.to_record()) for topic, tally in closed.items()}
            for (_, topic), tally in still_open.items():
                totals.setdefault(topic, Tally()).add(tally)
        return dict(sorted(totals.items()))

    def total(self) -> Tally:
        """Sum over all topics."""
        total = Tally()
        for tally in self.totals().values():
            total.add(tally)
        return total

    def unnumbered(self) -> dict[str, int]:
        """By topic, messages without a number: losses among them cannot be seen."""
        totals = self.totals()
        return {topic: tally.unnumbered for topic, tally in totals.items() if tally.unnumbered}

    def uncounted_tails(self) -> list[str]:
        """Topics of which not every publisher said how many messages it had sent."""
        return sorted({topic for topic, _ in self._streams - self._told})

    def untold_tails(self) -> list[str]:
        """Those among them whose source said it before, and in the end did not."""
        return sorted({*self.answering()}.intersection(self.uncounted_tails()))

    def to_metadata(self) -> dict[str, str]:
        """The ``drops`` metadata record: totals, counts by topic, and warnings.

        ``several_publishers`` lists the topics whose numbers are no single row.
        """
        publishers = Counter(topic for topic, _ in self._streams)
        record = {
            **self.total().to_record(),
            "topics": {topic: tally.to_record() for topic, tally in self.totals().items()},
            "warnings": self.warnings,
            "several_publishers": sorted(topic for topic, n in publishers.items() if n > 1),
            "uncounted_tails": self.uncounted_tails(),
            "untold_tails": self.untold_tails(),
        }
        return {name: json.dumps(value) for name, value in record.items()}
