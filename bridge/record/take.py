"""One episode while it is being recorded. Used by the writer thread only."""

import json
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bridge.episode import metadata, schema
from bridge.errors import BridgeError
from bridge.record.channels import Channel, Channels
from bridge.record.config import RecorderConfig
from bridge.record.entries import Command, Dropped, Item, second_of
from bridge.record.inspection import resolve_type
from bridge.record.ledger import Ledger
from bridge.record.parts import Parts
from bridge.wire.session import WireSample


class Take:
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
    ) -> None:
        """Create the episode file and say in it who and what it is.

        Args:
            folder: Where episodes lie.
            info: What is being recorded.
            config: The recorder's settings.
            start_ns: When it begins [ns].
            latched: What was said before and still holds, repeated at the start of each file.
            others: What else goes into the ``recorder`` record, by name; asked at the end.

        Raises:
            UsageError: When the episode exists already.
            BridgeError: When the folder cannot be written.
        """
        self.info = info
        self.ledger = Ledger(config.queues.max_topics)
        self.start_ns = start_ns
        self.outcome: metadata.Outcome | None = None
        self._config = config
        self._latched = latched
        self._others = others
        self._paused_ns: list[list[int]] = []
        self._channels = Channels(config.queues.max_topics, self.ledger.warn, config.msg_folder)
        self._num_latched = 0
        self._closed_second = second_of(start_ns)
        self._records: deque[dict[str, Any]] = deque()
        self._clock_steps_ns: list[int] = []
        self._is_summed_up = False
        self._parts = Parts(folder, info, config.disk, start_ns)
        try:
            self._repeat_latched(start_ns)
        except OSError as error:
            self._parts.discard()
            raise BridgeError(
                f"cannot write {self.part_path}: {error.strerror}. Choose another folder."
            ) from error

    @property
    def part_path(self) -> Path:
        """The file while it is open."""
        return self._parts.open_path

    @property
    def path(self) -> Path:
        """The episode's file when it is finished; its first one if it is split."""
        return self._parts.first_path

    @property
    def num_parts(self) -> int:
        """Files so far."""
        return self._parts.index

    def _repeat_latched(self, stamp_ns: int) -> None:
        samples = self._latched()
        for sample in samples:
            channel = self._channels.of(sample, resolve_type(sample.topic, sample.type_name))
            if channel is not None:
                self._append(channel, sample, stamp_ns)
        self._num_latched = len(samples)

    def write(self, item: Item) -> None:
        """Append a message, whatever it is, and book it."""
        channel = self._channels.of(item.sample, item.type_name)
        if channel is None:
            self.ledger.count_refused(item)
            return
        finding = item.finding or channel.inspect(item.sample.data)
        try:
            self._append(channel, item.sample, item.sample.received_ns)
        except OSError:
            self.ledger.count_refused(item)
            raise
        self.ledger.count_received(item, finding)

    def write_beside(self, sample: WireSample) -> None:
        """Append something the recorder made itself; it is in no account."""
        channel = self._channels.of(sample, sample.type_name)
        if channel is not None:
            self._append(channel, sample, sample.received_ns)

    def _append(self, channel: Channel, sample: WireSample, stamp_ns: int) -> None:
        log_ns = channel.later(stamp_ns)
        source_ns = sample.source_ns
        self._parts.writer.write_foreign(
            sample.topic,
            sample.data,
            schema_record=channel.record,
            message_encoding=sample.message_encoding,
            log_time_ns=log_ns,
            publish_time_ns=source_ns if source_ns is not None and source_ns >= 0 else log_ns,
            sequence=sample.sequence,
        )

    def tick(self, now_ns: int, health: dict[str, int]) -> None:
        """Write what has waited long enough, and the ledger of the seconds that are over.

        Args:
            now_ns: The recorder's clock.
            health: Numbers that go into each ledger record.
        """
        # A message may wait in the queue while its second ends: give it one second more.
        before = second_of(now_ns) - 1
        if before > self._closed_second:
            self._closed_second = before
            self._write_ledger(before, now_ns, health)
        if self._parts.is_full(now_ns):
            self._parts.roll(now_ns)
            self._repeat_latched(now_ns)
        self._parts.tick()

    def _write_ledger(self, before: int | None, now_ns: int, health: dict[str, int]) -> None:
        closed = self.ledger.close_seconds(before)
        self._records.extend({**record, **health} for record in closed)
        while self._records:
            self._write_json(schema.DROPS_TOPIC, self._records[0], schema.DROPS, now_ns)
            self._records.popleft()

    def _write_json(
        self, topic: str, record: dict[str, Any], type_name: str, stamp_ns: int
    ) -> None:
        log_ns = self._channels.later(topic, stamp_ns)
        self._parts.writer.write_json(topic, record, type_name=type_name, log_time_ns=log_ns)

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
        topic = f"/{self.info.cell or 'recorder'}/event"
        self._write_json(topic, record, schema.EVENT, stamp_ns)
        self.outcome = outcome or self.outcome

    def note_clock_step(self, step_ns: int, *, stamp_ns: int) -> None:
        """Write down that the system clock has jumped; log times have not."""
        self._clock_steps_ns.append(step_ns)
        self.write_event("clock_step", stamp_ns=stamp_ns, data={"step_ns": step_ns})

    def pause(self, command: Command) -> None:
        """Leave out, and count as no loss, what comes after this command."""
        self.write_event("paused", stamp_ns=command.received_ns)
        self.ledger.pause(command.ticket)
        self._paused_ns.append([command.received_ns])

    def resume(self, command: Command) -> None:
        """Record and count again what comes after this command."""
        self.ledger.resume(command.ticket)
        self._paused_ns[-1].append(command.received_ns)
        self.write_event("resumed", stamp_ns=command.received_ns)

    def refuse(self, entries: Iterable[Item | Dropped]) -> None:
        """Book messages that came before the end and can no longer be written."""
        for entry in entries:
            if isinstance(entry, Item):
                self.ledger.count_refused(entry)
            else:
                self.ledger.count_dropped(entry)

    def close(
        self,
        *,
        end_ns: int,
        reason: str,
        outcome: metadata.Outcome | None,
        health: dict[str, int],
    ) -> Path:
        """Write the accounts, finish the file and give it its final name.

        May be called again after an OSError, when there is space.
        """
        self._write_ledger(None, end_ns, health)
        if not self._is_summed_up:
            self._sum_up(end_ns, reason, outcome or self.outcome)
            self._is_summed_up = True
        return self._parts.close()

    def _sum_up(self, end_ns: int, reason: str, outcome: metadata.Outcome | None) -> None:
        writer = self._parts.writer
        if outcome is not None:
            writer.add_metadata("outcome", metadata.to_strings(outcome))
        writer.add_metadata("drops", self.ledger.to_metadata())
        recorder = {
            "settings": asdict(self._config),
            "start_ns": self.start_ns,
            "end_ns": end_ns,
            "stopped_by": reason,
            "latched_messages_repeated": self._num_latched,
            "clock_steps_ns": self._clock_steps_ns,
            "paused": [[*span, end_ns][:2] for span in self._paused_ns],
            "parts": self.num_parts,
            **{name: ask() for name, ask in self._others.items()},
        }
        values = {name: json.dumps(value, default=str) for name, value in recorder.items()}
        writer.add_metadata("recorder", values)

    def discard(self) -> None:
        """Remove the file: the take was not wanted."""
        self._parts.discard()

    def abandon(self) -> None:
        """Stop without finishing; the ``.part`` file stays."""
        self._parts.abandon()
