"""Walk through the data section of an MCAP file and compare what it says of itself.

The walk believes no summary and no index. Memory holds one record at a time, and the index.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap import records
from mcap.summary import Summary

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.damaged import Contents, RecordFile, read_plain
from bridge.episode.mcap.format import MESSAGE, MESSAGE_HEAD, RECORD_HEAD
from bridge.episode.mcap.scan import (
    AttachmentSpan,
    Chunk,
    Damage,
    DataEnd,
    IndexSpan,
    Plain,
    TopMessage,
    scan,
)
from bridge.episode.mcap.walk import (
    MessageHead,
    attachment_entry,
    chunk_entry,
    message_head,
    records_in,
)


@dataclass(kw_only=True)
class Seen:
    """What a walk through the data section found."""

    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int = 0
    chunks: list[records.ChunkIndex] = field(default_factory=list)
    """Of the chunks whose head can be read."""
    num_chunks: int = 0
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)

    def count(self, head: MessageHead) -> None:
        """Take a message."""
        self.counts[head.channel_id] = self.counts.get(head.channel_id, 0) + 1
        if self.start_ns is None or head.log_time_ns < self.start_ns:
            self.start_ns = head.log_time_ns
        self.end_ns = max(self.end_ns, head.log_time_ns)

    def define(self, record: records.McapRecord | None) -> Iterator[str]:
        """Take a schema or channel record; yields what is wrong with it."""
        if isinstance(record, records.Schema):
            if record.id == 0:
                yield "a schema has the id 0, which means none"
            if self.schemas.setdefault(record.id, record) != record:
                yield f"schema {record.id} is announced twice with different contents"
        elif isinstance(record, records.Channel):
            if record.schema_id and record.schema_id not in self.schemas:
                yield f"channel {record.id} uses schema {record.schema_id}, not announced before"
            if self.channels.setdefault(record.id, record) != record:
                yield f"channel {record.id} is announced twice with different contents"

    def to_summary(self) -> Summary:
        """Make the summary that such a file should have."""
        summary = Summary()
        summary.schemas, summary.channels = self.schemas, self.channels
        summary.chunk_indexes, summary.attachment_indexes = self.chunks, self.attachments
        summary.metadata_indexes = self.metadata
        summary.statistics = records.Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=self.counts,
            chunk_count=len(self.chunks),
            message_count=sum(self.counts.values()),
            message_start_time=self.start_ns or 0,
            message_end_time=self.end_ns,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )
        return summary


_INDEX_HEAD = struct.Struct("<HI")


class ScannedMessage(NamedTuple):
    """One message in file order."""

    channel: records.Channel
    schema: records.Schema | None
    head: MessageHead
    data: bytes


class DataWalk:
    """The walk through one data section. Use ``messages`` to the end, then read ``seen``."""

    def __init__(
        self, file: RecordFile, *, fault: Callable[[str], None], doubt: Callable[[str], None]
    ) -> None:
        """``fault`` hears of what cannot be read, ``doubt`` of what contradicts the data."""
        self.seen = Seen()
        self._file, self._fault, self._doubt = file, fault, doubt
        self._chunk: records.ChunkIndex | None = None
        self._contents = Contents()
        """Of that chunk."""

    def messages(self) -> Iterator[ScannedMessage]:
        """Yield every message that can be read, in file order."""
        end = None
        for found in scan(self._file):
            if not isinstance(found, IndexSpan):
                self._end_chunk()
            match found:
                case Damage():
                    self._fault(found.what)
                case Chunk():
                    yield from self._walk_chunk(found)
                case IndexSpan():
                    self._check_index(found)
                case TopMessage():
                    yield from self._message(self._file.read(found.offset, found.length), 0)
                case AttachmentSpan():
                    self.seen.attachments.append(
                        attachment_entry(found.offset, found.length, found.record)
                    )
                case Plain(record=records.Metadata(name=name)):
                    entry = records.MetadataIndex(found.offset, found.length, name)
                    self.seen.metadata.append(entry)
                case Plain():
                    self._define(found.record)
                case DataEnd():
                    end = found
        self._end_chunk()
        self._check_end(end)

    def _check_end(self, end: DataEnd | None) -> None:
        if end is None:
            self._doubt("the end of its data is not marked")
            return
        if end.end < self._file.size:
            self._doubt(f"a record at byte {end.end}, behind the end of the data")
        crc = int.from_bytes(self._file.read(end.end - 4, 4), "little")
        if crc not in (0, self._file.crc(0, end.offset)):
            self._doubt("its data has another CRC than it declares")

    def _message(self, data: bytes, at: int) -> Iterator[ScannedMessage]:
        head = message_head(data, at, at)
        channel = self.seen.channels.get(head.channel_id)
        if channel is None:
            self._fault(f"a message of channel {head.channel_id}, which was not announced")
            return
        self.seen.count(head)
        start = at + MESSAGE_HEAD.size
        payload = data[start : start + head.length]
        yield ScannedMessage(channel, self.seen.schemas.get(channel.schema_id), head, payload)

    def _define(self, record: records.McapRecord | None) -> None:
        for text in self.seen.define(record):
            self._fault(text)

    def _walk_chunk(self, found: Chunk) -> Iterator[ScannedMessage]:
        self.seen.num_chunks += 1
        self._chunk = chunk_entry(found.offset, found.length, found.head)
        self._contents = found.contents
        data = found.records
        for opcode, at, length in records_in(data):
            if opcode == MESSAGE:
                yield from self._message(data, at)
            elif opcode in (mcap_format.SCHEMA, mcap_format.CHANNEL):
                self._define(read_plain(data[at : at + RECORD_HEAD.size + length]))
        times, said = found.contents.time_range(), (found.head.start_ns, found.head.end_ns)
        if times != said:
            whose = f"the chunk at byte {found.offset}"
            self._doubt(f"{whose} says its messages are from {said}, they are from {times}")

    def _check_index(self, span: IndexSpan) -> None:
        body = self._file.read(span.offset, span.length)[RECORD_HEAD.size :]
        channel_id, said = _index_entries(body)
        if self._chunk is None:
            self._doubt(f"the message index at byte {span.offset} follows no chunk")
            return
        self._chunk.message_index_offsets[channel_id] = span.offset
        self._chunk.message_index_length += span.length
        entries = self._contents.index.get(channel_id, [])
        if said != sorted(zip(entries[::2], entries[1::2], strict=True)):
            self._doubt(
                f"the message index at byte {span.offset} does not point at the messages of "
                f"channel {channel_id} in its chunk"
            )

    def _end_chunk(self) -> None:
        if self._chunk is None:
            return
        indexed = self._chunk.message_index_offsets
        absent = self._contents.index.keys() - indexed
        if indexed and absent:
            at = self._chunk.chunk_start_offset
            self._doubt(f"the chunk at byte {at} has no index of channels {sorted(absent)}")
        self.seen.chunks.append(self._chunk)
        self._chunk = None


def _index_entries(body: bytes) -> tuple[int, list[tuple[int, int]]]:
    """Read a message index: its channel, and log time and offset of each message, in order."""
    channel_id, length = _INDEX_HEAD.unpack_from(body)
    numbers = struct.unpack_from(f"<{length // 8}Q", body, _INDEX_HEAD.size)
    return channel_id, sorted(zip(numbers[::2], numbers[1::2], strict=True))
