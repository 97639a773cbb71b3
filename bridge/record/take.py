"""One episode while it is being recorded. Used by the writer thread only."""

import contextlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bridge.episode import metadata, schema
from bridge.episode.writer import EpisodeWriter
from bridge.record.config import RecorderConfig
from bridge.record.inspection import inspect, resolve_type
from bridge.record.intake import Dropped, Received, second_of
from bridge.record.ledger import Ledger
from bridge.wire.session import WireSample


class Take:
    """Writes messages as they came, books losses, and finishes the file."""

    def __init__(
        self, path: Path, info: metadata.EpisodeInfo, config: RecorderConfig, start_ns: int
    ) -> None:
        """Create the episode file and say in it who and what it is.

        Raises:
            UsageError: When the episode exists already.
            BridgeError: When the folder cannot be written.
        """
        self.info = info
        self.ledger = Ledger()
        self.start_ns = start_ns
        self.outcome: metadata.Outcome | None = None
        self._config = config
        self._channels: set[tuple[str, str]] = set()
        self._last_ns = start_ns
        self._num_latched = 0
        self._closed_second = second_of(start_ns)
        self._writer = EpisodeWriter(path)
        self._writer.describe(info)

    @property
    def part_path(self) -> Path:
        """The file while it is open."""
        return self._writer.part_path

    def _log_ns(self, received_ns: int) -> int:
        """Log times never run backwards, also when two network threads deliver at once."""
        self._last_ns = max(self._last_ns, received_ns)
        return self._last_ns

    def write_latched(self, samples: list[WireSample]) -> None:
        """Repeat what was said before the episode began and still holds."""
        for sample in samples:
            self._append(sample, self.start_ns)
        self._num_latched = len(samples)

    def write(self, entry: Received) -> None:
        """Append a message as it came, whatever it is, and book it."""
        sample = entry.sample
        type_name = resolve_type(sample.topic, sample.type_name)
        channel = (sample.topic, type_name)
        if channel not in self._channels and len(self._channels) >= self._config.max_topics:
            self.ledger.count_refused(entry)
            return
        self._channels.add(channel)
        finding = inspect(type_name, sample.message_encoding, sample.data)
        self._append(sample, self._log_ns(sample.received_ns))
        self.ledger.count_received(entry, finding)

    def _append(self, sample: WireSample, log_time_ns: int) -> None:
        type_name = resolve_type(sample.topic, sample.type_name)
        source_ns = sample.source_ns
        self._writer.write_foreign(
            sample.topic,
            sample.data,
            schema_record=_schema_record(type_name, sample.message_encoding),
            message_encoding=sample.message_encoding,
            log_time_ns=log_time_ns,
            publish_time_ns=source_ns if source_ns is not None and source_ns >= 0 else log_time_ns,
            sequence=sample.sequence,
        )

    def count_dropped(self, dropped: Dropped) -> None:
        """Book messages the queue had no room for."""
        self.ledger.count_dropped(dropped)

    def tick(self, now_ns: int) -> None:
        """Write the ledger of the seconds that are over."""
        # A message may wait in the queue while its second ends: give it one second more.
        before = second_of(now_ns) - 1
        if before > self._closed_second:
            self._closed_second = before
            self._write_ledger(before, now_ns)

    def _write_ledger(self, before: int | None, now_ns: int) -> None:
        for record in self.ledger.close_seconds(before):
            self._writer.write_json(
                schema.DROPS_TOPIC,
                record,
                type_name=schema.DROPS,
                log_time_ns=self._log_ns(now_ns),
            )

    def write_event(
        self, kind: str, *, stamp_ns: int, text: str = "", outcome: metadata.Outcome | None = None
    ) -> None:
        """Append a mark or a label to the cell's events; a label is the outcome from now on."""
        cell = self.info.cell or "recorder"
        record: dict[str, Any] = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind}
        if text:
            record["text"] = text
        if outcome is not None:
            self.outcome = outcome
            record["outcome"] = asdict(outcome)
        self._writer.write_json(
            f"/{cell}/event", record, type_name=schema.EVENT, log_time_ns=self._log_ns(stamp_ns)
        )

    def close(self, *, end_ns: int, reason: str, outcome: metadata.Outcome | None) -> Path:
        """Write the accounts, finish the file and give it its final name."""
        outcome = outcome or self.outcome
        self._write_ledger(None, end_ns)
        if outcome is not None:
            self._writer.add_metadata("outcome", metadata.to_strings(outcome))
        self._writer.add_metadata("drops", self.ledger.to_metadata())
        recorder = {
            "settings": asdict(self._config),
            "start_ns": self.start_ns,
            "end_ns": end_ns,
            "stopped_by": reason,
            "latched_messages_repeated": self._num_latched,
        }
        values = {name: json.dumps(value) for name, value in recorder.items()}
        self._writer.add_metadata("recorder", values)
        return self._writer.close()

    def discard(self) -> None:
        """Remove the file: the take was not wanted."""
        self._writer.discard()

    def abandon(self) -> None:
        """Stop without finishing; the ``.part`` file stays."""
        with contextlib.suppress(OSError):  # the disk that failed may fail again
            self._writer.abandon()


def _schema_record(type_name: str, message_encoding: str) -> schema.Schema | None:
    """The schema to register: a known one, one with a name only, or none.

    MCAP reads an empty schema encoding as "no schema available", which keeps the name.
    """
    known = schema.schema_for(type_name) if type_name else None
    if known is not None and message_encoding in ("", known.message_encoding):
        return known
    if not type_name:
        return None
    return schema.Schema(
        name=type_name, schema_encoding="", message_encoding=message_encoding, data=b""
    )
