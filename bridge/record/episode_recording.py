"""One episode while it is being recorded. Used by the writer thread only."""

import contextlib
import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bridge.episode import health, metadata, schema
from bridge.episode.contract import (
    PRESENCE_RECORD,
    RECORD_NAME,
    Contract,
    Span,
    TopicReport,
    findings_of,
    judge,
)
from bridge.episode.health import ContentWatch, HealthFinding, in_order, of_event
from bridge.episode.run_folder import SUFFIX
from bridge.episode.topics import CLOCKS, DROPS, EVENT, cell_topic
from bridge.episode.writer import EpisodeWriter, WriterConfig
from bridge.errors import BridgeError, MissingDependencyError
from bridge.record.clocks import StampJumps
from bridge.record.config import RecorderConfig
from bridge.record.encoders import encode
from bridge.record.inspection import (
    GOOD,
    MessageState,
    inspector,
    resolve_type,
    stamp_reader,
    why_unreadable,
)
from bridge.record.ledger import Ledger
from bridge.record.presence import News
from bridge.record.queue import Dropped, Item, second_of
from bridge.task.find import ATTACHMENT, MEDIA_TYPE
from bridge.task.task_file import TaskFile
from bridge.wire.rmw import ros_schema, type_hash_of
from bridge.wire.session import WireSample

HASH_PREFIX = "RIHS01_"
_SHOWN = len(HASH_PREFIX) + 12


@dataclass(slots=True)
class Channel:
    """One topic with one definition of its type."""

    record: schema.Schema | None
    inspect: Callable[[bytes], MessageState]
    last_ns: list[int]
    """Shared by the channels of a topic."""
    stamp_ns: Callable[[bytes], int | None] | None
    """Reads the time in a message itself, where its type has one."""
    content: ContentWatch

    def later(self, stamp_ns: int) -> int:
        """Log times of a topic never run backwards, also when two threads deliver at once."""
        last_ns = self.last_ns
        if stamp_ns > last_ns[0]:
            last_ns[0] = stamp_ns
        return last_ns[0]


class Channels:
    """Remembers the channels of one episode; a topic with two definitions gets two."""

    def __init__(
        self, max_topics: int, warn: Callable[[str], None], msg_folder: Path | None = None
    ) -> None:
        """Start empty."""
        self._msg_folder = msg_folder
        self._max_topics = max_topics
        self._warn = warn
        self._channels: dict[tuple[str, str, str, str], Channel] = {}
        self._last_ns: dict[str, list[int]] = {}
        self._records: dict[str, schema.Schema | None] = {}
        self._hashes: dict[str, str] = {}

    def of(self, sample: WireSample, type_name: str) -> Channel | None:
        """Return the channel of a message, or None when there are too many."""
        key = (sample.topic, type_name, sample.message_encoding, sample.type_hash)
        channel = self._channels.get(key)
        if channel is None and len(self._channels) < self._max_topics:
            channel = self._channels[key] = self._new(sample, type_name)
        return channel

    def later(self, topic: str, stamp_ns: int) -> int:
        """Return a log time for a record of our own."""
        last_ns = self._last_ns.setdefault(topic, [0])
        last_ns[0] = max(last_ns[0], stamp_ns)
        return last_ns[0]

    def _new(self, sample: WireSample, type_name: str) -> Channel:
        topic = sample.topic
        record, is_strange = self._schema(sample, type_name)
        if self._records.setdefault(topic, record) != record:
            self._warn(f"{topic} carries several definitions, each on a channel of its own")
        if is_strange:
            self._warn(
                f"{topic}: {type_name} was built from another definition ({sample.type_hash})"
            )
        elif record is not None and not record.schema_encoding:
            self._warn(f"{topic}: {type_name} is not known here; it is kept without a definition")
        look = inspector("" if is_strange else type_name, sample.message_encoding, sample.topic)
        last_ns = self._last_ns.setdefault(topic, [0])
        content = ContentWatch(topic, type_name)
        return Channel(record, look, last_ns, stamp_reader(record), content)

    def findings(self) -> Iterator[HealthFinding]:
        """What the messages of all topics hold, and which topics carry several types."""
        types: dict[str, set[str]] = {}
        for (topic, type_name, *_), channel in list(self._channels.items()):
            types.setdefault(topic, set()).add(type_name)
            yield from list(channel.content.findings.values())
        for topic, names in types.items():
            yield from health.mixed_types(topic, names)

    def _schema(self, sample: WireSample, type_name: str) -> tuple[schema.Schema | None, bool]:
        """The schema to register: a known one, one with a name only, or none; and if it is strange.

        MCAP reads an empty schema encoding as "no schema available", which keeps the name. A
        definition that nobody knows must not borrow another's text: its hash goes into the name.
        """
        if not type_name:
            return None, False
        encoding = sample.message_encoding
        known = schema.schema_for(type_name)
        if encoding not in ("", known.message_encoding if known else "cdr"):
            return _name_only(type_name, encoding), False
        type_hash = sample.type_hash if sample.type_hash.startswith(HASH_PREFIX) else ""
        newest = None
        with contextlib.suppress(MissingDependencyError):
            newest = type_hash_of(type_name, folder=self._msg_folder) if type_hash else None
        if known is not None and newest in (None, type_hash):
            return known, False
        with contextlib.suppress(MissingDependencyError):
            found = ros_schema(type_name, type_hash=type_hash, folder=self._msg_folder)
            if found is not None:
                return found, False
        is_first = not type_hash or self._hashes.setdefault(type_name, type_hash) == type_hash
        if newest is None and is_first:
            return _name_only(type_name, encoding), False
        return _name_only(f"{type_name}#{type_hash[:_SHOWN]}", encoding), True


def _name_only(name: str, encoding: str) -> schema.Schema:
    return schema.Schema(name=name, schema_encoding="", message_encoding=encoding, data=b"")


class EpisodeRecording:
    """Writes messages as they came, books losses, and finishes the file."""

    def __init__(
        self,
        folder: Path,
        info: metadata.EpisodeInfo,
        config: RecorderConfig,
        *,
        start_ns: int,
        latched: Callable[[], list[WireSample]],
        others: Mapping[str, Callable[[], object]],
        contract: Contract | None = None,
        task: TaskFile | None = None,
        clocks: Iterable[dict[str, Any]] = (),
    ) -> None:
        """Create the episode file and say in it who and what it is."""
        self.info = info
        self.ledger = Ledger(config.queues.max_topics)
        self.start_ns = start_ns
        self.outcome: metadata.Outcome | None = None
        self.presence: dict[str, TopicReport] = {}
        """By topic, when it was there; known at the end."""
        self._of_presence: tuple[HealthFinding, ...] = ()
        self.news: list[News] = []
        """What it noticed and a person should hear of."""
        self._noted: list[HealthFinding] = []
        self._unreadable: dict[str, str] = {}
        self._jumps = StampJumps()
        self._contract = contract
        self._config = config
        self._latched = latched
        self._others = others
        self._channels = Channels(config.queues.max_topics, self.ledger.warn, config.msg_folder)
        self._num_latched = 0
        self._begins_ns, self._waits = start_ns, info.stand_in
        """A stand-in's first message says when, for its clock may run ahead of this one."""
        self._closed_second = second_of(start_ns)
        self._records: deque[dict[str, Any]] = deque()
        self._clock_steps_ns: list[int] = []
        self._is_summed_up = False
        disk = config.disk
        self.writer = EpisodeWriter(
            folder / f"{info.id}{SUFFIX}",
            config=WriterConfig(
                chunk_bytes=1 << 20,
                flush_s=disk.flush_s,
                sync_s=disk.sync_s,
                backlog_bytes=disk.backlog_bytes,
            ),
        )
        try:
            self._say_what_it_is(contract, task)
            if not self._waits:
                self._repeat_latched(start_ns)
            for record in clocks:
                self.write_clock(record, start_ns)
        except OSError as error:
            self.writer.discard()
            raise BridgeError(
                f"cannot write {self.writer.part_path}: {error.strerror}. Choose another folder."
            ) from error

    def _say_what_it_is(self, contract: Contract | None, task: TaskFile | None) -> None:
        self.writer.describe(self.info)
        if contract is not None:
            self.writer.add_metadata(RECORD_NAME, contract.to_record())
        if task is not None:
            self.writer.attach(
                ATTACHMENT, task.data, media_type=MEDIA_TYPE, log_time_ns=self.start_ns
            )

    @property
    def keeps_up(self) -> bool:
        """Whether little enough waits for the disk to give it more images."""
        return self.writer.backlog_bytes < self._config.disk.backlog_bytes

    @property
    def disk(self) -> dict[str, float]:
        """How far the disk is behind, for the status."""
        return {"write_lag_s": self.writer.lag_s, "busy_s": self.writer.busy_s}

    def _repeat_latched(self, stamp_ns: int) -> None:
        samples = self._latched()
        for sample in samples:
            channel = self._channels.of(sample, resolve_type(sample.topic, sample.type_name))
            if channel is not None:
                self._append(channel, sample, stamp_ns)
        self._num_latched = len(samples)

    def write(self, item: Item) -> None:
        """Append a message, whatever it is, and book it."""
        if self._waits and item.sample.source_ns:
            self._begins_ns, self._waits = max(self.start_ns, item.sample.source_ns), False
            self._repeat_latched(self._begins_ns)
        channel = self._channels.of(item.sample, item.type_name)
        if channel is None:
            self.ledger.count_refused(item)
            return
        if item.is_bulk and item.finding is None:
            encode(item, self._config)
        is_known = channel.content.knows(item.sample.data)
        finding = GOOD if is_known else item.finding or channel.inspect(item.sample.data)
        self._look(channel, item, finding, is_known=is_known)
        try:
            at_ns = self._append(channel, item.sample, item.sample.received_ns, item.image_encoding)
        except OSError:
            self.ledger.count_refused(item)
            raise
        self.ledger.count_received(item, finding, at_ns)

    def _look(self, channel: Channel, item: Item, finding: MessageState, *, is_known: bool) -> None:
        """Tell of what is wrong with a message, once for each topic and kind."""
        topic, data = item.sample.topic, item.sample.data
        if finding is MessageState.UNDECODABLE and topic not in self._unreadable:
            why = self._unreadable[topic] = why_unreadable(topic, item.type_name, data)
            text = f"{topic}: messages cannot be read: {why}"
            told = {"kind": "unreadable", "topic": topic}
            self.news.append(News(text=text, data=told, warns=True))
        if channel.content.is_of_use and finding is GOOD:
            found = channel.content.see(data, item.sample.received_ns, is_known=is_known)
            if found is not None:
                told = {"kind": found.name, "topic": topic}
                self.news.append(News(text=found.line(), data=told, warns=True))

    def findings(self) -> list[HealthFinding]:
        """What is wrong with the episode so far; of presence at the end only."""
        found = [*self._channels.findings(), *self._noted]
        for topic, tally in self.ledger.totals().items():
            if tally.lost:
                found.append(health.drops_logged(topic, tally.lost))
            if tally.undecodable:
                why = self._unreadable.get(topic, "")
                found.append(health.unreadable(topic, tally.undecodable, tally.received, why))
        return in_order([*found, *self._of_presence])

    def _append(
        self, channel: Channel, sample: WireSample, stamp_ns: int, image_encoding: str = ""
    ) -> int | None:
        source_ns = sample.source_ns
        if source_ns is None and channel.stamp_ns is not None:
            source_ns = channel.stamp_ns(sample.data)
        if self.info.stand_in:
            stamp_ns = max(self._begins_ns, source_ns or 0)
        log_ns = channel.later(stamp_ns)
        self.writer.write(
            sample.topic,
            sample.data,
            schema_record=channel.record,
            message_encoding=sample.message_encoding,
            log_time_ns=log_ns,
            publish_time_ns=source_ns if source_ns is not None and source_ns >= 0 else log_ns,
            sequence=sample.sequence,
            about=(("image_encoding", image_encoding),) if image_encoding else (),
        )
        return source_ns

    def tick(self, now_ns: int, health: dict[str, int]) -> None:
        """Write what has waited long enough, and the drop log of the seconds that are over."""
        # A message may wait in the queue while its second ends: give it one second more.
        before = second_of(now_ns) - 1
        if before > self._closed_second:
            self._closed_second = before
            self._write_ledger(before, now_ns, health)
        self.writer.tick()

    def _write_ledger(self, before: int | None, now_ns: int, health: dict[str, int]) -> None:
        closed = list(self.ledger.close_seconds(before))
        if not self.info.stand_in:  # its clock may stand
            self.news += self._jumps.look(closed)
        self._records.extend({**record, **health} for record in closed)
        while self._records:
            self._write_json(DROPS, self._records[0], schema.DROPS, now_ns)
            self._records.popleft()

    def _write_json(
        self, topic: str, record: dict[str, Any], type_name: str, stamp_ns: int
    ) -> None:
        log_ns = self._channels.later(topic, max(stamp_ns, self._begins_ns))
        self.writer.write(topic, record, type_name=type_name, log_time_ns=log_ns)

    def write_clock(self, record: dict[str, Any], stamp_ns: int) -> None:
        """Append readings of a source's clock."""
        self._write_json(CLOCKS, record, schema.CLOCKS, stamp_ns)

    def write_event(
        self,
        kind: str,
        *,
        stamp_ns: int,
        text: str = "",
        outcome: metadata.Outcome | None = None,
        data: dict[str, Any] | None = None,
    ) -> None:
        """Append a mark or a label to the cell's events; a label is the outcome from now on."""
        record: dict[str, Any] = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind}
        if text:
            record["text"] = text
        if data is not None:
            record["data"] = data
        if outcome is not None:
            record["outcome"] = asdict(outcome)
        self._noted += of_event(record)
        topic = cell_topic(self.info.cell or "recorder", EVENT)
        self._write_json(topic, record, schema.EVENT, stamp_ns)
        self.outcome = outcome or self.outcome

    def note_clock_step(self, step_ns: int, *, stamp_ns: int) -> None:
        """Write down that the system clock has jumped; log times have not."""
        self._clock_steps_ns.append(step_ns)
        self.write_event("clock_step", stamp_ns=stamp_ns, data={"step_ns": step_ns})

    def refuse(self, entries: Iterable[Item | Dropped]) -> None:
        """Book messages that came before the end and can no longer be written."""
        for entry in entries:
            if isinstance(entry, Item):
                self.ledger.count_refused(entry)
            else:
                self.ledger.count_dropped(entry)

    def close(
        self, *, end_ns: int, reason: str, outcome: metadata.Outcome | None, health: dict[str, int]
    ) -> Path:
        """Write the accounts, finish the file and give it its final name.

        May be called again after an OSError, when there is space.
        """
        self._write_ledger(None, end_ns, health)
        for news in self.news:
            if "by_ns" in news.data:  # of a clock that was set: nothing else in the file says it
                self.write_event("note", stamp_ns=end_ns, text=news.text, data=news.data)
        self.news.clear()
        if not self._is_summed_up:
            self._sum_up(end_ns, reason, outcome or self.outcome)
            self._is_summed_up = True
        return self.writer.close()

    def _sum_up(self, end_ns: int, reason: str, outcome: metadata.Outcome | None) -> None:
        writer = self.writer
        if outcome is not None:
            writer.add_metadata("outcome", metadata.to_strings(outcome))
        writer.add_metadata("drops", self.ledger.to_metadata())
        self._judge_presence(Span(self.start_ns, end_ns))
        recorder = {
            "settings": asdict(self._config),
            "start_ns": self.start_ns,
            "end_ns": end_ns,
            "stopped_by": reason,
            "latched_messages_repeated": self._num_latched,
            "clock_steps_ns": self._clock_steps_ns,
            **{name: ask() for name, ask in self._others.items()},
        }
        values = {name: json.dumps(value, default=str) for name, value in recorder.items()}
        writer.add_metadata("recorder", values)

    def _judge_presence(self, span: Span) -> None:
        totals = self.ledger.totals()
        lost = {topic: tally.lost for topic, tally in totals.items()}
        self.presence = judge(
            self.ledger.presences, self._contract, span, lost, by_habit=not self.info.stand_in
        )
        presences = self.ledger.presences
        untold = self.ledger.untold_tails()
        self._of_presence = tuple(findings_of(self.presence, presences, span.end_ns, untold))
        record = {
            "topics": {topic: asdict(report) for topic, report in self.presence.items()},
            "unnumbered": self.ledger.unnumbered(),
        }
        values = {name: json.dumps(value) for name, value in record.items()}
        self.writer.add_metadata(PRESENCE_RECORD, values)
        told = json.dumps([asdict(finding) for finding in self.findings()])
        self.writer.add_metadata(health.RECORD_NAME, {"findings": told})

    def discard(self) -> None:
        """Remove the file: the take was not wanted."""
        self.writer.discard()

    def abandon(self) -> None:
        """Stop without finishing; the ``.part`` file stays."""
        with contextlib.suppress(OSError):  # the disk that failed may fail again
            self.writer.abandon()
