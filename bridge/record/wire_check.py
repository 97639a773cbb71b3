"""Listens to publishers and says what of the wire contract (``docs/wire.md``) they do not keep."""

import statistics
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.topics import type_of_topic
from bridge.record.inspection import MessageState, inspector, resolve_type, stamp_reader
from bridge.record.sequence import SequenceTracker
from bridge.wire import rmw
from bridge.wire.clocks import ALIVE
from bridge.wire.session import WireSample, WireSession

RATE_TOLERANCE = 0.1
"""A rate this much off the expected one is wrong."""
FAR_NS = NS_PER_S
"""Stamps further than this from the time of arrival are of another clock or another unit."""
MAX_OFFSETS = 10_000
_UNITS = {"microseconds": 10**3, "milliseconds": 10**6, "seconds": 10**9}


class Breach(NamedTuple):
    """One thing that a publisher does not do as the contract says."""

    about: str
    """encoding, attachment, sequence, time, payload, liveliness or rate."""
    kind: Literal["wrong", "missing"]
    text: str


ASPECTS = ("encoding", "payload", "attachment", "sequence", "time", "liveliness", "rate")


@dataclass(kw_only=True)
class TopicHeard:
    """What was heard of one topic with one type."""

    topic: str
    type_name: str
    message_encoding: str
    messages: int = 0
    num_bytes: int = 0
    lost: int = 0
    not_counted: int = 0
    """Numbers that are not above the one before, of the same publisher."""
    unnumbered: int = 0
    unstamped: int = 0
    stamped_back: int = 0
    odd_attachments: set[int] = field(default_factory=set)
    states: dict[MessageState, int] = field(default_factory=dict)
    last_numbers: dict[bytes, int] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    last_source_ns: int | None = None
    offsets_ns: list[int] = field(default_factory=list)
    unset_headers: int = 0
    findings: list[Breach] = field(default_factory=list)

    @property
    def rate_hz(self) -> float:
        """Mean rate of arrival [Hz], 0 for fewer than two messages."""
        span_ns = self.last_ns - self.first_ns
        return (self.messages - 1) * NS_PER_S / span_ns if span_ns > 0 else 0.0

    def to_json(self) -> dict[str, Any]:
        """What is printed with ``--json``."""
        return {
            "topic": self.topic,
            "type": self.type_name,
            "encoding": self.message_encoding,
            "messages": self.messages,
            "bytes": self.num_bytes,
            "rate_hz": self.rate_hz,
            "publishers": len(self.last_numbers),
            "lost": self.lost,
            "findings": [finding._asdict() for finding in self.findings],
        }

    def lines(self) -> list[str]:
        """A line on the topic, one on what is right, and one on each finding."""
        named = self.type_name or "no type"
        publishers = len(self.last_numbers) or "unnamed"
        lines = [
            f"{self.topic}: {named} as {self.message_encoding or 'bytes'}, {self.messages} "
            f"messages, {self.rate_hz:.1f} Hz, publishers: {publishers}"
        ]
        faulty = {finding.about for finding in self.findings}
        if right := [name for name in ASPECTS if name not in faulty]:
            lines.append(f"  ok       {', '.join(right)}")
        return lines + [f"  {each.kind:<8} {each.about}: {each.text}" for each in self.findings]


class WireListener:
    """Takes messages and liveliness tokens on network threads; judges them at the end."""

    def __init__(self, session: WireSession, key: str) -> None:
        """Begin to listen."""
        self._lock = threading.Lock()
        self._tracker = SequenceTracker()
        self._heard: dict[tuple[str, str, str], TopicHeard] = {}
        self._alive: set[str] = set()
        self._subscribers = [
            session.watch_alive(f"**{ALIVE}", self._on_token),
            session.watch_alive(rmw.TOKENS, self._on_token),
            session.subscribe(key, self._take),
        ]

    def _on_token(self, key: str, alive: bool) -> None:
        with self._lock:
            if alive:
                self._alive.add(key)

    def _take(self, sample: WireSample) -> None:
        with self._lock:
            key = (sample.topic, sample.type_name, sample.message_encoding)
            heard = self._heard.get(key)
            if heard is None:
                heard = self._heard[key] = TopicHeard(
                    topic=key[0], type_name=key[1], message_encoding=key[2]
                )
            self._note(heard, sample)

    def _note(self, heard: TopicHeard, sample: WireSample) -> None:
        heard.messages += 1
        heard.num_bytes += len(sample.data)
        heard.first_ns = heard.first_ns or sample.received_ns
        heard.last_ns = sample.received_ns
        step = self._tracker.observe(sample)
        heard.lost += step.gap - (step.fills is not None)
        if sample.sequence is None or sample.source_gid is None:
            heard.unnumbered += 1
            if sample.attachment_bytes:
                heard.odd_attachments.add(sample.attachment_bytes)
        else:
            before = heard.last_numbers.get(sample.source_gid, -1)
            heard.not_counted += sample.sequence <= before and step.fills is None
            heard.last_numbers[sample.source_gid] = sample.sequence
        self._note_time(heard, sample)
        type_name = resolve_type(sample.topic, sample.type_name)
        state = inspector(type_name, sample.message_encoding)(sample.data)
        heard.states[state] = heard.states.get(state, 0) + 1

    def _note_time(self, heard: TopicHeard, sample: WireSample) -> None:
        source_ns = sample.source_ns
        if source_ns is None:
            heard.unstamped += 1
            known = schema.schema_for(resolve_type(sample.topic, sample.type_name))
            if (read := stamp_reader(known)) is not None:
                source_ns = read(sample.data)
                heard.unset_headers += source_ns is None
        if source_ns is None:
            return
        if heard.last_source_ns is not None and source_ns < heard.last_source_ns:
            heard.stamped_back += 1
        heard.last_source_ns = source_ns
        if len(heard.offsets_ns) < MAX_OFFSETS:
            heard.offsets_ns.append(sample.received_ns - source_ns)

    def finish(self, *, rate_hz: float | None = None) -> list[TopicHeard]:
        """Stop listening and return what was found, by topic."""
        for subscriber in self._subscribers:
            subscriber.close()
        with self._lock:
            tokens = frozenset(self._alive)
            heard = sorted(self._heard.values(), key=lambda each: (each.topic, each.type_name))
        for each in heard:
            each.findings = [
                *_of_encoding(each),
                *_of_payload(each),
                *_of_attachment(each),
                *_of_time(each),
                *_of_liveliness(each, tokens),
                *_of_rate(each, rate_hz),
            ]
        return heard


def _of_encoding(heard: TopicHeard) -> Iterator[Breach]:
    if not heard.message_encoding:
        text = "none that is known; send application/cdr;TYPE (or json, protobuf ...)"
        yield Breach("encoding", "missing", text)
    if not heard.type_name:
        guessed = type_of_topic(heard.topic)
        text = f"; {guessed} is taken from the topic" if guessed else ""
        yield Breach("encoding", "missing", f"it names no type{text}")


_STATES = {
    MessageState.UNDECODABLE: "are not what their type says",
    MessageState.NEWER_VERSION: "are of a newer version of their schema than is known here",
}


def _of_payload(heard: TopicHeard) -> Iterator[Breach]:
    for state, text in _STATES.items():
        if count := heard.states.get(state, 0):
            yield Breach("payload", "wrong", f"{count} of {heard.messages} messages {text}")


def _of_attachment(heard: TopicHeard) -> Iterator[Breach]:
    if heard.odd_attachments:
        sizes = ", ".join(map(str, sorted(heard.odd_attachments)))
        text = f"{sizes} bytes; it has 33 (or 77): sequence, time, 16, publisher id"
        yield Breach("attachment", "wrong", text)
    elif heard.unnumbered:
        text = f"none on {heard.unnumbered} of {heard.messages} messages"
        yield Breach("attachment", "missing", text)
    if heard.unnumbered:
        text = "messages without a number: their losses cannot be seen"
        yield Breach("sequence", "missing", text)
    if heard.lost > 0:
        text = f"{heard.lost} of {heard.messages + heard.lost} numbers were skipped: lost messages"
        yield Breach("sequence", "wrong", text)
    if heard.not_counted:
        text = f"{heard.not_counted} numbers do not count on; each message gets the next one"
        yield Breach("sequence", "wrong", text)


def _of_time(heard: TopicHeard) -> Iterator[Breach]:
    if heard.unstamped and heard.unset_headers:
        text = "neither an attachment nor header.stamp says when a message was made"
        yield Breach("time", "missing", text)
    elif heard.unstamped and not heard.offsets_ns:
        text = "nothing says when a message was made; its arrival counts instead"
        yield Breach("time", "missing", text)
    if heard.stamped_back:
        text = f"{heard.stamped_back} messages are stamped before the one that came before them"
        yield Breach("time", "wrong", text)
    offset_ns = round(statistics.median(heard.offsets_ns or [0]))
    if abs(offset_ns) > FAR_NS:
        yield Breach("time", "wrong", _far(heard, offset_ns))


def _far(heard: TopicHeard, offset_ns: int) -> str:
    source_ns = heard.last_ns - offset_ns
    for unit, factor in _UNITS.items():
        if abs(heard.last_ns - source_ns * factor) < heard.last_ns // 100:
            return f"stamps look like {unit}; they are nanoseconds since 1970"
    side = "behind" if offset_ns > 0 else "ahead of"
    return f"stamps are {abs(offset_ns) / NS_PER_S:.3g} s {side} this computer's clock"


def _of_liveliness(heard: TopicHeard, tokens: frozenset[str]) -> Iterator[Breach]:
    parts = heard.topic.strip("/").split("/")
    prefixes = {"/".join(parts[:count]) + ALIVE for count in range(1, len(parts) + 1)}
    of_ros = {each.topic for token in tokens if (each := rmw.parse_token(token)) is not None}
    if not prefixes & tokens and heard.topic not in of_ros:
        text = f"no token {parts[0]}{ALIVE}: nobody notices when this publisher is gone"
        yield Breach("liveliness", "missing", text)


def _of_rate(heard: TopicHeard, rate_hz: float | None) -> Iterator[Breach]:
    if rate_hz is not None and abs(heard.rate_hz - rate_hz) > RATE_TOLERANCE * rate_hz:
        text = f"{heard.rate_hz:.1f} Hz, expected {rate_hz:g} Hz within {RATE_TOLERANCE:.0%}"
        yield Breach("rate", "wrong", text)


def describe_heard(key: str, heard: list[TopicHeard]) -> str:
    """What is printed for people."""
    if not heard:
        return f"nothing came on {key}; is the publisher running, and connected to this address?"
    return "\n".join(line for each in heard for line in each.lines())
