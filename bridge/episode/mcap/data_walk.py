"""Walk through the data section of an MCAP file and compare what it says of itself.

The walk believes no summary and no index. Memory holds one record at a time, and the index.
"""

import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple

from mcap import records

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.damaged import Contents, RecordFile
from bridge.episode.mcap.format import MESSAGE, MESSAGE_HEAD, RECORD_HEAD, FileSummary
from bridge.episode.mcap.scan import Chunk, Damage, IndexSpan, Plain, TopMessage, scan
from bridge.episode.mcap.walk import (
    MessageHead,
    attachment_entry,
    chunk_entry,
    message_head,
    records_in,
)

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
        self.seen = FileSummary()
        self._file, self._fault, self._doubt = file, fault, doubt
        self._chunk: records.ChunkIndex | None = None
        self._contents = Contents()
        """Of that chunk."""
        self._num_loose = 0

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
                    self._num_loose += 1
                    log_ns = found.log_time_ns
                    self.seen.add_messages({found.channel_id: 1}, log_ns, log_ns)
                    yield from self._message(self._file.read(found.offset, found.length), 0)
                case Plain():
                    self._take_plain(found)
                    end = found if found.opcode == mcap_format.DATA_END else None
        self._end_chunk()
        if end is None:
            self._doubt("the end of its data is not marked")
        elif end.end < self._file.size:
            self._doubt(f"a record at byte {end.end}, behind the end of the data")
        if self.seen.chunk_indexes and self._num_loose:
            self._doubt(f"{self._num_loose} messages outside chunks, where the index shows none")

    def _take_plain(self, found: Plain) -> None:
        match found.record:
            case records.Attachment() as record:
                entry = attachment_entry(found.offset, found.length, record)
                self.seen.attachment_indexes.append(entry)
            case records.Metadata(name=name):
                place = records.MetadataIndex(found.offset, found.length, name)
                self.seen.metadata_indexes.append(place)
            case records.DataEnd(data_section_crc=crc):
                if crc not in (0, self._file.crc(0, found.offset)):
                    self._doubt("its data has another CRC than it declares")
            case record:
                self._define(record)

    def _message(self, data: bytes, at: int) -> Iterator[ScannedMessage]:
        head = message_head(data, at)
        channel = self.seen.channels.get(head.channel_id)
        if channel is None:
            self._fault(f"a message of channel {head.channel_id}, which was not announced")
            return
        start = at + MESSAGE_HEAD.size
        payload = data[start : start + head.length]
        yield ScannedMessage(channel, self.seen.schemas.get(channel.schema_id), head, payload)

    def _define(self, record: records.McapRecord | None) -> None:
        """Take a schema or channel record, and say what is wrong with it."""
        schemas, channels = self.seen.schemas, self.seen.channels
        if isinstance(record, records.Schema):
            if schemas.setdefault(record.id, record) != record:
                self._fault(f"schema {record.id} is announced twice with different contents")
        elif isinstance(record, records.Channel):
            number, schema_id = record.id, record.schema_id
            if schema_id and schema_id not in schemas:
                self._fault(f"channel {number} uses schema {schema_id}, not announced before")
            if channels.setdefault(number, record) != record:
                self._fault(f"channel {number} is announced twice with different contents")

    def _walk_chunk(self, found: Chunk) -> Iterator[ScannedMessage]:
        self._chunk = chunk_entry(found.offset, found.length, found.packed)
        self._contents = found.contents
        data = found.records
        for record in found.contents.definitions:
            self._define(record)
        for opcode, at, _ in records_in(data):
            if opcode == MESSAGE:
                yield from self._message(data, at)
        counts = {number: len(each) // 2 for number, each in found.contents.index.items()}
        self.seen.add_messages(counts, *found.contents.time_range())
        times = found.contents.time_range()
        said = (found.packed.message_start_time, found.packed.message_end_time)
        if times != said:
            whose = f"the chunk at byte {found.offset}"
            self._doubt(f"{whose} says its messages are from {said}, they are from {times}")

    def _check_index(self, span: IndexSpan) -> None:
        body = self._file.read(span.offset, span.length)[RECORD_HEAD.size :]
        channel_id, length = _INDEX_HEAD.unpack_from(body)
        numbers = struct.unpack_from(f"<{length // 8}Q", body, _INDEX_HEAD.size)
        said = sorted(zip(numbers[::2], numbers[1::2], strict=True))
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
        self.seen.chunk_indexes.append(self._chunk)
        self._chunk = None
