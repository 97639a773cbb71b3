"""What was received and what was lost: per topic and second, and in total."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from bridge.record.inspection import Finding
from bridge.record.intake import Dropped, Received, second_of


@dataclass(kw_only=True)
class Tally:
    """Counts of one topic."""

    received: int = 0
    """Written to the episode."""
    gaps: int = 0
    """Lost before they reached the recorder, by the publishers' numbers."""
    queue_drops: int = 0
    """Reached the recorder, which could not keep them."""
    undecodable: int = 0
    """Written as they are, but not what their type says."""
    newer_version: int = 0
    """JSON records of a newer schema version than this software knows."""
    unknown_type: int = 0
    """Written as they are, of a type this software does not know."""
    repeated: int = 0
    """Numbers that were seen before, or arrived late."""
    unnumbered: int = 0
    """Without a sequence number, so that losses cannot be seen."""
    bytes: int = 0

    def add(self, other: "Tally") -> None:
        """Add another tally to this one."""
        for name, value in asdict(other).items():
            setattr(self, name, getattr(self, name) + value)


class Ledger:
    """The accounts of one episode."""

    def __init__(self) -> None:
        """Start empty."""
        self._totals: dict[str, Tally] = {}
        self._open: dict[tuple[int, str], Tally] = {}

    def _tally(self, topic: str, second: int) -> Tally:
        return self._open.setdefault((second, topic), Tally())

    def count_received(self, entry: Received, finding: Finding) -> None:
        """Book a message that was written."""
        sample = entry.sample
        tally = self._tally(sample.topic, second_of(sample.received_ns))
        tally.received += 1
        tally.bytes += len(sample.data)
        tally.gaps += entry.step.gap
        tally.repeated += entry.step.repeated
        tally.unnumbered += sample.sequence is None
        if finding is not Finding.GOOD:
            setattr(tally, finding.value, getattr(tally, finding.value) + 1)

    def count_refused(self, entry: Received) -> None:
        """Book a message that came out of the queue but could not be written."""
        sample = entry.sample
        tally = self._tally(sample.topic, second_of(sample.received_ns))
        tally.queue_drops += 1
        tally.gaps += entry.step.gap

    def count_dropped(self, dropped: Dropped) -> None:
        """Book messages the queue had no room for."""
        for (topic, second), count in dropped.counts.items():
            tally = self._tally(topic, second)
            tally.queue_drops += count.messages
            tally.gaps += count.gaps

    def close_seconds(self, before: int | None = None) -> Iterator[dict[str, Any]]:
        """Yield a drops record for each topic and second that is over, and forget it.

        Args:
            before: Close seconds earlier than this; None closes all.
        """
        for second, topic in sorted(self._open):
            if before is not None and second >= before:
                continue
            tally = self._open.pop((second, topic))
            self._totals.setdefault(topic, Tally()).add(tally)
            yield {"schema_version": 1, "topic": topic, "second": second, **asdict(tally)}

    def totals(self) -> dict[str, Tally]:
        """Counts by topic, seconds still open included."""
        totals = {topic: Tally(**asdict(tally)) for topic, tally in self._totals.items()}
        for (_, topic), tally in self._open.items():
            totals.setdefault(topic, Tally()).add(tally)
        return dict(sorted(totals.items()))

    def total(self) -> Tally:
        """Sum over all topics."""
        total = Tally()
        for tally in self.totals().values():
            total.add(tally)
        return total

    def to_metadata(self) -> dict[str, str]:
        """The ``drops`` metadata record: totals, and counts by topic."""
        record = {name: json.dumps(value) for name, value in asdict(self.total()).items()}
        by_topic = {topic: asdict(tally) for topic, tally in self.totals().items()}
        return {**record, "topics": json.dumps(by_topic)}
