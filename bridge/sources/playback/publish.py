"""Publishes what an episode holds: the same bytes in the same order, as far apart as they came.

Publish times are those of the episode, so that a recording of the playback has them too. Sequence
numbers are counted anew: a gap in the new recording was lost on this way, not on the first one.
"""

import contextlib
import threading
import time
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap import records

from bridge.clock import NS_PER_S, ns_from_s
from bridge.episode import schema
from bridge.episode.mcap.messages import Selection, Stored, merged
from bridge.episode.reader import Episode
from bridge.episode.topics import OF_RECORDER, TF_STATIC, is_latched
from bridge.errors import UsageError
from bridge.sources.playback.config import PlaybackConfig, choose_topics
from bridge.terminal import Output
from bridge.wire.clocks import announce
from bridge.wire.errors import BadTopicError
from bridge.wire.keys import key_from_topic
from bridge.wire.qos import Qos
from bridge.wire.session import WirePublisher, WireSession

LATEST_NS = 2**63 - 1
"""The latest publish time that an attachment can hold."""


class Due(NamedTuple):
    """A message and its place in the time of the playback."""

    at_ns: int
    item: Stored


class Pace:
    """Says when a message is due."""

    def __init__(self, rate: float, *, monotonic: Callable[[], float] = time.monotonic) -> None:
        """Begin with the first message."""
        self._rate = rate
        self._monotonic = monotonic
        self._first: tuple[int, float] | None = None

    def wait(self, at_ns: int, stop: threading.Event) -> float | None:
        """Wait until a message is due.

        Returns:
            How late it is [s], or None when the playback was stopped.
        """
        first_ns, began_s = self._first = self._first or (at_ns, self._monotonic())
        due_s = began_s + (at_ns - first_ns) / (NS_PER_S * self._rate)
        while not stop.is_set():
            left_s = due_s - self._monotonic()
            if left_s <= 0:
                return -left_s
            stop.wait(left_s)
        return None


class EpisodeSource:
    """An episode as a ``bridge.sources.source.Source``."""

    def __init__(self, path: Path, config: PlaybackConfig) -> None:
        """Open an episode and choose what is sent."""
        self.episode = Episode.open(path)
        self.config = config
        self._defined: set[str] = set()
        self.pace = Pace(config.rate)
        counts = {topic: each.count for topic, each in self.episode.topics().items()}
        there = [topic for topic in counts if topic not in OF_RECORDER]
        self.topics = tuple(choose_topics(config.topics, there))
        for topic in self.topics:
            try:
                key_from_topic(topic)
            except BadTopicError as error:
                raise UsageError(f"{path}: {error} Choose others with --topics.") from error
        self.num_messages = sum(counts[topic] for topic in self.topics)
        if not self.num_messages:
            listed = ", ".join(self.topics) or "it has no topics"
            raise UsageError(f"{path} holds no messages to play ({listed}).")
        self.start_ns = self.episode.start_ns + ns_from_s(config.start_s)
        if self.start_ns > self.episode.end_ns:
            raise UsageError(
                f"--start-s {config.start_s:g} is behind the end of {path}, which lasts "
                f"{self.episode.duration_s:.3f} s."
            )

    @property
    def name(self) -> str:
        """The episode's id."""
        return self.episode.info.id

    def messages(self) -> Iterator[Due]:
        """Yield what is sent; the recorder's drop log stays out."""
        for item in self._latched_before():
            yield Due(self.start_ns, item)
        for item in merged([self.episode.file], Selection(frozenset(self.topics), self.start_ns)):
            yield Due(item.log_time_ns, item)

    def _latched_before(self) -> Iterator[Stored]:
        """What was latched when the playback begins: the last of each topic, and all frames."""
        if self.start_ns <= self.episode.start_ns:
            return
        latched = frozenset(topic for topic in self.topics if is_latched(topic))
        last: dict[tuple[str, int], Stored] = {}
        for item in merged([self.episode.file], Selection(latched, None, self.start_ns)):
            topic = item.channel.topic
            last[topic, len(last) if topic == TF_STATIC else 0] = item
        yield from last.values()

    def run(self, session: WireSession, stop: threading.Event, output: Output) -> dict[str, Any]:
        """Send every message at its time.

        Returns:
            Messages sent in all and by topic, and how late they were [ms].
        """
        if cells := sorted({name.split("/")[1] for name in self.topics if name.count("/") > 1}):
            announce(session, *cells, has_clock=False)
        publishers = self._publishers(session)
        sent = dict.fromkeys(self.topics, 0)
        late_s = array("d")
        with output.progress("play", self.num_messages) as advance:
            for at_ns, item in self.messages():
                waited_s = self.pace.wait(at_ns, stop)
                if waited_s is None:
                    break
                late_s.append(waited_s)
                publisher = publishers[item.channel.id]
                publisher.put(item.data, source_ns=min(item.publish_time_ns, LATEST_NS))
                sent[item.channel.topic] += 1
                advance(len(late_s), "")
        return {
            "episode": self.name,
            "messages": len(late_s),
            "of": self.num_messages,
            "topics": sent,
            "late_ms": _lateness_ms(late_s),
        }

    def _publishers(self, session: WireSession) -> dict[int, WirePublisher]:
        """A publisher for each topic with one definition, by channel."""
        made: dict[tuple[str, str, str], WirePublisher] = {}
        found: dict[int, WirePublisher] = {}
        for channel in self.episode.file.summary.channels.values():
            if channel.topic not in self.topics:
                continue
            record = self.episode.file.schema_of(channel)
            key = (channel.topic, record.name if record else "", channel.message_encoding)
            if record is not None:
                self._define(session, record, channel.message_encoding)
            if key not in made:
                made[key] = session.publisher(
                    channel.topic, key[1], qos=Qos.PLAYBACK, message_encoding=key[2]
                )
            found[channel.id] = made[key]
        return found

    def _define(self, session: WireSession, record: records.Schema, message_encoding: str) -> None:
        """Send the definition of a type that only the episode knows."""
        is_new = record.name not in self._defined
        if is_new and record.data and schema.schema_for(record.name) is None:
            self._defined.add(record.name)
            made = schema.Schema(
                name=record.name,
                schema_encoding=record.encoding,
                message_encoding=message_encoding,
                data=record.data,
            )
            with contextlib.suppress(BadTopicError):  # then only its name is recorded again
                session.define(made)


def _lateness_ms(late_s: "array[float]") -> dict[str, float]:
    """How long after their time messages left [ms]: median, 99th percentile, largest."""
    if not late_s:
        return {}
    late_ms = np.frombuffer(late_s, dtype=np.float64) * 1e3
    median, p99 = np.percentile(late_ms, (50, 99)).tolist()
    return {"median": median, "p99": p99, "max": float(late_ms.max())}


def describe_counts(counts: dict[str, Any]) -> str:
    """One line for people."""
    topics = sum(count > 0 for count in counts["topics"].values())
    text = f"{counts['episode']}: {counts['messages']} messages on {topics} topics sent"
    if counts["late_ms"]:
        text += f", 99 % of them at most {counts['late_ms']['p99']:.1f} ms late"
    return text
