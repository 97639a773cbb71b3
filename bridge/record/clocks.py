"""Asks every source for its clock, once a second, and at the end how many messages it has sent.

The readings go into the open episode on ``/recorder/clocks``; ``bridge.episode.clocks`` fits them.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Collection
from typing import Any

from bridge.episode.clocks import (
    STAMP_JUMP_NS,
    Reading,
    SourceClock,
    StampWatch,
    to_record,
    told_jump,
)
from bridge.record.presence import News
from bridge.wire.clocks import ClockAnswer, Sent, ask_clocks, hear_last_words
from bridge.wire.errors import WireError
from bridge.wire.session import WireSession

PERIOD_S = 1.0
SETTLE_S, MOST_ASKS = 1.0, 5
"""A stop waits no longer for those who do not answer, and asks no more often."""
MAX_SOURCES = 200
KEPT = 600
EARLIER = 60
"""Of those made before an episode, at most so many begin it: the best of each stretch."""

Record = dict[str, Any]


class ClockBook:
    """What the recorder knows of its sources' clocks; may be used by several threads."""

    def __init__(
        self,
        *,
        tell: Callable[[News], None] = lambda news: None,
        write: Callable[[Record], None] = lambda record: None,
    ) -> None:
        """Know no source."""
        self._tell = tell
        self._write = write
        self._lock = threading.Lock()
        self._clocks: dict[tuple[str, str], SourceClock] = {}

    def take(self, answer: ClockAnswer) -> None:
        """Enter what a source answered of its clock."""
        if answer.reading is None:
            return
        key = (answer.source, answer.identity)
        with self._lock:
            clock = self._clocks.get(key)
            if clock is None:
                if len(self._clocks) >= MAX_SOURCES:
                    del self._clocks[next(iter(self._clocks))]
                clock = self._clocks[key] = SourceClock(source=answer.source, host=answer.host)
            clock.topics = answer.topics
            jump = clock.add(answer.reading)
            del clock.spans[-1][:-KEPT]
            record = to_record(clock, answer.identity, [answer.reading])
        self._write(record)
        if jump is not None:
            text = told_jump(clock.source, clock.host, jump)
            data = {"kind": "clock_jump", "source": clock.source, "host": clock.host}
            self._tell(News(text=text, data={**data, "by_ns": jump.by_ns}, warns=True))

    def earlier(self) -> list[Record]:
        """Records of what was measured before an episode, to begin it with."""
        with self._lock:
            return [
                to_record(clock, identity, _best(clock.spans[-1]))
                for (_, identity), clock in self._clocks.items()
            ]

    def has_named(self, topics: Collection[str], by_ns: int) -> bool:
        """Say whether the jump that stamps show is one that their source's answers have shown."""
        with self._lock:
            return any(
                clock.topics.issuperset(topics) and abs(jump.by_ns - by_ns) < STAMP_JUMP_NS
                for clock in self._clocks.values()
                for jump in clock.jumps[-1:]
            )

    def answering(self) -> set[str]:
        """What those publish who have answered."""
        with self._lock:
            return set().union(*(clock.topics for clock in self._clocks.values()))

    def status(self) -> list[Record]:
        """What goes into the recorder's status, by source."""
        told = []
        with self._lock:
            for clock in self._clocks.values():
                line = clock.lines()[-1]
                told.append(
                    {
                        "source": clock.source,
                        "host": clock.host,
                        "offset_ms": round(line.offset_ns / 1e6, 3),
                        "uncertainty_ms": round(line.uncertainty_ns / 1e6, 3),
                        "drift_ppm": None if line.drift is None else round(line.drift * 1e6, 2),
                        "jumps": len(clock.jumps),
                    }
                )
        return told


def _best(readings: list[Reading]) -> list[Reading]:
    """The surest reading of each stretch of equally many, in order."""
    size = -(-len(readings) // EARLIER)
    stretches = (readings[at : at + size] for at in range(0, len(readings), size))
    return [min(stretch, key=lambda reading: reading.error_ns) for stretch in stretches]


class ClockAsker:
    """Asks all sources on a thread of its own."""

    def __init__(
        self,
        session: WireSession,
        book: ClockBook,
        told: Callable[[Sent], None],
        seen: Callable[[], dict[str, int]],
    ) -> None:
        """Begin to ask; ``told`` hears how many messages publishers have sent."""
        self._session = session
        self._book = book
        self._told, self._seen = told, seen
        self._last = hear_last_words(session, told)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="clocks", daemon=True)
        self._thread.start()

    def _ask(self) -> None:
        while not self._ended.is_set():
            with contextlib.suppress(WireError):  # the session is closing
                for answer in ask_clocks(self._session, timeout_s=PERIOD_S):
                    self._book.take(answer)
            self._ended.wait(PERIOD_S)

    def settle(self) -> None:
        """Ask everybody how many messages they have sent by now.

        An answer comes behind the messages: while some come, who did not answer is asked again.
        """
        for _ in range(MOST_ASKS):
            asked_s, seen, answers = time.monotonic(), self._seen(), []
            with contextlib.suppress(WireError):  # the session is closing
                answers = ask_clocks(self._session, timeout_s=SETTLE_S, is_last=True)
            for answer in answers:
                self._told(answer.sent)
            is_answered = time.monotonic() < asked_s + SETTLE_S
            if is_answered or self._seen() == seen:
                return

    def close(self) -> None:
        """Stop."""
        self._ended.set()
        self._last.close()
        self._thread.join(timeout=2 * PERIOD_S)


class StampJumps:
    """Clocks that were set, by the stamps of an episode's messages; one line for each."""

    def __init__(self) -> None:
        """Begin an episode."""
        self._watch = StampWatch()

    def look(self, records: list[Record]) -> list[News]:
        """Look through the drop records of some seconds."""
        found: dict[tuple[int, bool], dict[str, int]] = {}
        for record in records:
            delay_ns = record["clock_offset_ns"]
            by_ns = 0 if delay_ns is None else self._watch.see(record["topic"], delay_ns)
            if abs(by_ns) > 1e9 or (by_ns and record["received"] >= 5):  # few are late by chance
                at = (record["second"], by_ns > 0)
                found.setdefault(at, {})[record["topic"]] = by_ns
        return [_told_stamps(jumped) for jumped in found.values()]


def _told_stamps(jumped: dict[str, int]) -> News:
    topics = sorted(jumped)
    by_ns = jumped[topics[0]]
    more = f" and {len(topics) - 1} more" if len(topics) > 1 else ""
    side = "ahead" if by_ns > 0 else "back"
    text = (
        f"the stamps of {topics[0]}{more} jumped {side} by {abs(by_ns) / 1e9:.3f} s: the clock of "
        "their publisher was set"
    )
    data = {"kind": "stamp_jump", "topics": topics, "by_ns": by_ns}
    return News(text=text, data=data, warns=True)
