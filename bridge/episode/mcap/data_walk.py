"""Walk through the data section of an MCAP file and compare what it says of itself.

The walk believes no summary and no index. Memory holds one record at a time, and the index.
"""

import struct
import zlib
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt64
from mcap import records
from mcap.summary import Summary

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.format import MAGIC, MESSAGE, MESSAGE_HEAD, RECORD_HEAD
from bridge.episode.mcap.walk import (
    PIECE_BYTES,
    BrokenRecordError,
    ByteStream,
    MessageHead,
    RecordSpan,
    attachment_entry,
    attachment_of,
    chunk_entry,
    message_head,
    metadata_entry,
    parse,
    parse_chunk,
    read_body,
    records_in,
    unpack_chunk,
    walk,
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
    num_broken_attachments: int = 0
    metadata: list[records.MetadataIndex] = field(default_factory=list)

    def count(self, head: MessageHead) -> None:
        """Take a message."""
        self.counts[head.channel_id] = self.counts.get(head.channel_id, 0) + 1
        if self.start_ns is None or head.log_time_ns < self.start_ns:
            self.start_ns = head.log_time_ns
        self.end_ns = max(self.end_ns, head.log_time_ns)

    def define(self, place: RecordSpan, record: records.McapRecord | None) -> Iterator[str]:
        """Take a schema, channel or metadata record; yields what is wrong with it."""
        if isinstance(record, records.Metadata):
            self.metadata.append(metadata_entry(place, record))
        elif isinstance(record, records.Schema):
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
NEVER = 1 << 64


class ScannedMessage(NamedTuple):
    """One message in file order."""

    channel: records.Channel
    schema: records.Schema | None
    head: MessageHead
    data: bytes


class DataWalk:
    """The walk through one data section. Use ``messages`` to the end, then read ``seen``."""

    def __init__(
        self, stream: ByteStream, *, fault: Callable[[str], None], doubt: Callable[[str], None]
    ) -> None:
        """``fault`` hears of what cannot be read, ``doubt`` of what contradicts the data."""
        self.seen = Seen()
        self._stream, self._fault, self._doubt = stream, fault, doubt
        self._crc = 0
        self._chunk: records.ChunkIndex | None = None
        self._entries: dict[int, array[int]] = {}
        """By channel: log time and offset of its messages in the chunk, one after the other."""
        self._indexed: set[int] = set()

    def messages(self, data_end: int) -> Iterator[ScannedMessage]:
        """Yield every message that can be read, in file order."""
        stream = self._stream
        stream.seek(0)
        self._crc = zlib.crc32(stream.read(len(MAGIC)))
        ended = False
        for place in walk(stream, len(MAGIC), data_end):
            if ended:
                self._doubt(f"a record at byte {place.offset}, behind the end of the data")
                break
            if place.opcode not in (mcap_format.MESSAGE_INDEX, mcap_format.CHUNK):
                self._end_chunk()
            if place.opcode == mcap_format.DATA_END:
                self._end_chunk()
                self._check_data_end(stream, place)
                ended = True
            elif place.opcode == mcap_format.ATTACHMENT:
                self._add_attachment(stream, place)
            else:
                body = read_body(stream, place)
                head = RECORD_HEAD.pack(place.opcode, place.length)
                self._crc = zlib.crc32(body, zlib.crc32(head, self._crc))
                try:
                    yield from self._take(place, body)
                except BrokenRecordError as error:
                    self._fault(str(error))
        self._end_chunk()
        if not ended:
            self._doubt("the end of its data is not marked")

    def _take(self, place: RecordSpan, body: bytes) -> Iterator[ScannedMessage]:
        if place.opcode == MESSAGE:
            front = RECORD_HEAD.pack(place.opcode, place.length) + body[: MESSAGE_HEAD.size]
            head = message_head(front, 0, place.offset)
            yield from self._message(head, body[MESSAGE_HEAD.size - RECORD_HEAD.size :])
        elif place.opcode == mcap_format.CHUNK:
            yield from self._walk_chunk(place, body)
        elif place.opcode == mcap_format.MESSAGE_INDEX:
            self._check_index(place, body)
        else:
            self._define(place, parse(place.opcode, body))

    def _message(self, head: MessageHead, data: bytes) -> Iterator[ScannedMessage]:
        channel = self.seen.channels.get(head.channel_id)
        if channel is None:
            self._fault(f"a message of channel {head.channel_id}, which was not announced")
            return
        self.seen.count(head)
        yield ScannedMessage(channel, self.seen.schemas.get(channel.schema_id), head, data)

    def _define(self, place: RecordSpan, record: records.McapRecord | None) -> None:
        for text in self.seen.define(place, record):
            self._fault(text)

    def _walk_chunk(self, place: RecordSpan, body: bytes) -> Iterator[ScannedMessage]:
        self._end_chunk()
        whose = f"the chunk at byte {place.offset}"
        self.seen.num_chunks += 1
        chunk = parse_chunk(body)
        self._chunk = chunk_entry(place, chunk.head)
        data = unpack_chunk(chunk, whose=whose)
        first_ns, last_ns = NEVER, 0
        for opcode, at, length in records_in(data):
            start = at + RECORD_HEAD.size
            if opcode == MESSAGE:
                head = message_head(data, at, at)
                first_ns = min(first_ns, head.log_time_ns)
                last_ns = max(last_ns, head.log_time_ns)
                self._note(head)
                payload = at + MESSAGE_HEAD.size
                yield from self._message(head, data[payload : start + length])
            else:
                self._define(
                    RecordSpan(opcode, at, length), parse(opcode, data[start : start + length])
                )
        found = (first_ns, last_ns) if self._entries else (0, 0)
        if found != (chunk.head.start_ns, chunk.head.end_ns):
            said = (chunk.head.start_ns, chunk.head.end_ns)
            self._doubt(f"{whose} says its messages are from {said}, they are from {found}")

    def _note(self, head: MessageHead) -> None:
        entries = self._entries.get(head.channel_id)
        if entries is None:
            entries = self._entries[head.channel_id] = array("Q")
        entries.append(head.log_time_ns)
        entries.append(head.at)

    def _check_index(self, place: RecordSpan, body: bytes) -> None:
        channel_id, said = _index_entries(body)
        if self._chunk is None:
            self._doubt(f"the message index at byte {place.offset} follows no chunk")
            return
        self._chunk.message_index_offsets[channel_id] = place.offset
        self._chunk.message_index_length += place.end - place.offset
        self._indexed.add(channel_id)
        found = np.array(self._entries.get(channel_id, ()), dtype=np.uint64).reshape(-1, 2)
        if not np.array_equal(_in_order(said), _in_order(found)):
            self._doubt(
                f"the message index at byte {place.offset} does not point at the messages of "
                f"channel {channel_id} in its chunk"
            )

    def _end_chunk(self) -> None:
        if self._chunk is None:
            return
        absent = self._entries.keys() - self._indexed
        if self._indexed and absent:
            at = self._chunk.chunk_start_offset
            self._doubt(f"the chunk at byte {at} has no index of channels {sorted(absent)}")
        self.seen.chunks.append(self._chunk)
        self._chunk = None
        self._entries = {}
        self._indexed = set()

    def _add_attachment(self, stream: ByteStream, place: RecordSpan) -> None:
        try:
            found, data_size = attachment_of(stream, place, keep=False)
            self.seen.attachments.append(attachment_entry(place, found, data_size))
        except BrokenRecordError as error:
            self.seen.num_broken_attachments += 1
            self._fault(str(error))
        stream.seek(place.offset)
        left = place.end - place.offset
        while left:
            piece = stream.read(min(left, PIECE_BYTES))
            if not piece:
                break
            left -= len(piece)
            self._crc = zlib.crc32(piece, self._crc)

    def _check_data_end(self, stream: ByteStream, place: RecordSpan) -> None:
        record = parse(place.opcode, read_body(stream, place))
        if isinstance(record, records.DataEnd) and record.data_section_crc not in (0, self._crc):
            self._doubt("its data has another CRC than it declares")


def _index_entries(body: bytes) -> tuple[int, UInt64[np.ndarray, "entries 2"]]:
    """Read a message index: its channel, and log time and offset of each message."""
    if len(body) < _INDEX_HEAD.size:
        raise BrokenRecordError(f"a message index of {len(body)} bytes")
    channel_id, length = _INDEX_HEAD.unpack_from(body)
    if length % 16 or length > len(body) - _INDEX_HEAD.size:
        message = f"a message index of {len(body)} bytes claims {length} bytes of entries"
        raise BrokenRecordError(message)
    entries = np.frombuffer(body, dtype="<u8", count=length // 8, offset=_INDEX_HEAD.size)
    return channel_id, entries.astype(np.uint64).reshape(-1, 2)


def _in_order(entries: UInt64[np.ndarray, "entries 2"]) -> UInt64[np.ndarray, "entries 2"]:
    return entries[np.lexsort((entries[:, 1], entries[:, 0]))]
