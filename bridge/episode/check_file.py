"""Walk through one MCAP file from front to back and compare everything it says of itself.

The walk believes neither summary nor index; they are compared with what it finds. Memory holds one
record at a time, and the index.
"""

import struct
import zlib
from array import array
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt64
from mcap import records
from mcap.summary import Summary

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.file import (
    Seen,
    read_footer,
    read_header,
    read_summary,
)
from bridge.episode.mcap.format import MAGIC, MESSAGE, MESSAGE_HEAD, RECORD_HEAD
from bridge.episode.mcap.walk import (
    DAMAGE,
    PIECE_BYTES,
    BrokenRecordError,
    ByteStream,
    MessageHead,
    RecordSpan,
    attachment_entry,
    attachment_of,
    chunk_entry,
    message_head,
    parse,
    parse_chunk,
    read_body,
    records_in,
    unpack_chunk,
    walk,
)


def summary_faults(
    stream: ByteStream, seen: Seen, summary: Summary | None, footer: records.Footer, footer_at: int
) -> Iterator[str]:
    """Yield a sentence for every place where summary and data disagree.

    What a writer may leave out (statistics, repeated records, an index as a whole) is no fault.
    """
    if summary is None:
        return
    in_data = len(seen.schemas), len(seen.channels)
    # Topics nobody spoke on may stand in the summary only, counted or not (libmcap 1.1).
    for schema in summary.schemas.values():
        if seen.schemas.setdefault(schema.id, schema) != schema:
            yield f"the summary's schema {schema.id} ({schema.name}) is not that of the data"
    for channel in summary.channels.values():
        if seen.channels.setdefault(channel.id, channel) != channel:
            yield f"the summary's channel {channel.id} ({channel.topic}) is not that of the data"
    if summary.statistics is not None:
        yield from _statistics_faults(seen, summary.statistics, *in_data)
    yield from _index_faults("chunk", summary.chunk_indexes, seen.chunks, "chunk_start_offset")
    yield from _index_faults("attachment", summary.attachment_indexes, seen.attachments, "offset")
    yield from _index_faults("metadata", summary.metadata_indexes, seen.metadata, "offset")
    if footer.summary_offset_start:
        yield from _offset_faults(stream, footer, footer_at)


def _statistics_faults(
    seen: Seen, said: records.Statistics, num_schemas: int, num_channels: int
) -> Iterator[str]:
    num_attachments = len(seen.attachments) + seen.num_broken_attachments
    pairs = {
        "messages": (said.message_count, sum(seen.counts.values())),
        "schemas": (said.schema_count, _either(said.schema_count, seen.schemas, num_schemas)),
        "channels": (said.channel_count, _either(said.channel_count, seen.channels, num_channels)),
        "attachments": (said.attachment_count, num_attachments),
        "metadata records": (said.metadata_count, len(seen.metadata)),
        "chunks": (said.chunk_count, seen.num_chunks),
    }
    for what, (count, found) in pairs.items():
        if count != found:
            yield f"the summary says {count} {what}, {found} were read"
    times = (said.message_start_time, said.message_end_time)
    # Log time 0 means "none yet" to the Go writer, which then states the next one.
    start_ns = said.message_start_time if seen.start_ns == 0 else seen.start_ns
    if seen.counts and times != (start_ns, seen.end_ns):
        yield f"the summary says messages from {times}, they are from {(start_ns, seen.end_ns)}"
    for channel_id in sorted(said.channel_message_counts.keys() | seen.counts.keys()):
        count = said.channel_message_counts.get(channel_id, 0)
        found = seen.counts.get(channel_id, 0)
        if count != found and said.channel_message_counts:
            channel = seen.channels.get(channel_id)
            name = channel.topic if channel else f"channel {channel_id}"
            yield f"{name}: the summary says {count} messages, {found} were read"


def _either(said: int, everywhere: Collection[int], in_data: int) -> int:
    """Return the count that agrees, if one does."""
    return in_data if said == in_data else len(everywhere)


def _index_faults(what: str, said: list, found: list, key: str) -> Iterator[str]:  # type: ignore[type-arg]
    if not said:
        return  # a file without this index
    there = {getattr(entry, key): entry for entry in found}
    for entry in said:
        at = getattr(entry, key)
        other = there.pop(at, None)
        if other is None:
            yield f"the {what} index points at byte {at}, where none lies"
        elif other != entry:
            names = [n for n in vars(entry) if getattr(entry, n) != getattr(other, n)]
            yield f"the {what} index of byte {at} is wrong about {', '.join(names)}"
    for at in there:
        yield f"the {what} at byte {at} is not in the index"


def _offset_faults(stream: ByteStream, footer: records.Footer, footer_at: int) -> Iterator[str]:
    for place in walk(stream, footer.summary_offset_start, footer_at):
        record = parse(place.opcode, read_body(stream, place))
        if not isinstance(record, records.SummaryOffset):
            yield f"a record of kind {place.opcode} among the summary's offsets"
            continue
        start, end = record.group_start, record.group_start + record.group_length
        is_inside = footer.summary_start <= start <= end <= footer.summary_offset_start
        if not is_inside or not _are_all(record.group_opcode, stream, start, end):
            yield f"the summary's offset of records of kind {record.group_opcode} is wrong"


def _are_all(opcode: int, stream: ByteStream, start: int, end: int) -> bool:
    """Whether whole records of one kind, or none, lie between two offsets."""
    try:
        return all(place.opcode == opcode for place in walk(stream, start, end))
    except BrokenRecordError:
        return False


_INDEX_HEAD = struct.Struct("<HI")
NEVER = 1 << 64


class Faults:
    """The first faults of each kind of place; a damaged file could have millions."""

    def __init__(self, limit: int = 20) -> None:
        """List at most ``limit``."""
        self.listed: list[str] = []
        self.count = 0
        self._limit = limit

    def add(self, text: str) -> None:
        """Take one more."""
        self.count += 1
        if len(self.listed) < self._limit:
            self.listed.append(text)


class ScannedMessage(NamedTuple):
    """One message in file order."""

    channel: records.Channel
    schema: records.Schema | None
    head: MessageHead
    data: bytes


class FileCheck:
    """The walk through one file. Use ``messages`` to the end, then read ``faults``."""

    def __init__(self, path: Path, faults: Faults) -> None:
        """Faults are added to those given."""
        self.path = path
        self.faults = faults
        self.seen = Seen()
        self.library = ""
        self._crc = 0
        self._chunk: records.ChunkIndex | None = None
        self._entries: dict[int, array[int]] = {}
        """By channel: log time and offset of its messages in the chunk, one after the other."""
        self._indexed: set[int] = set()

    def _fault(self, text: str) -> None:
        self.faults.add(f"{self.path.name}: {text}")

    def messages(self) -> Iterator[ScannedMessage]:
        """Yield every message that can be read, in file order; damage is listed, not raised."""
        try:
            with self.path.open("rb") as stream:
                self.library = read_header(stream).library
                footer, footer_at = read_footer(stream)
                yield from self._walk_data(stream, footer.summary_start or footer_at)
                summary = read_summary(stream, footer, footer_at)
                for text in summary_faults(stream, self.seen, summary, footer, footer_at):
                    self._fault(text)
        except DAMAGE as error:
            self._fault(f"damaged: {error}" if str(error) else f"damaged ({type(error).__name__})")

    def _walk_data(self, stream: ByteStream, data_end: int) -> Iterator[ScannedMessage]:
        stream.seek(0)
        self._crc = zlib.crc32(stream.read(len(MAGIC)))
        ended = False
        for place in walk(stream, len(MAGIC), data_end):
            if ended:
                self._fault(f"a record at byte {place.offset}, behind the end of the data")
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
            self._fault("the end of its data is not marked")

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
            self._fault(f"{whose} says its messages are from {said}, they are from {found}")

    def _note(self, head: MessageHead) -> None:
        entries = self._entries.get(head.channel_id)
        if entries is None:
            entries = self._entries[head.channel_id] = array("Q")
        entries.append(head.log_time_ns)
        entries.append(head.at)

    def _check_index(self, place: RecordSpan, body: bytes) -> None:
        channel_id, said = _index_entries(body)
        if self._chunk is None:
            self._fault(f"the message index at byte {place.offset} follows no chunk")
            return
        self._chunk.message_index_offsets[channel_id] = place.offset
        self._chunk.message_index_length += place.end - place.offset
        self._indexed.add(channel_id)
        found = np.array(self._entries.get(channel_id, ()), dtype=np.uint64).reshape(-1, 2)
        if not np.array_equal(_in_order(said), _in_order(found)):
            self._fault(
                f"the message index at byte {place.offset} does not point at the messages of "
                f"channel {channel_id} in its chunk"
            )

    def _end_chunk(self) -> None:
        if self._chunk is None:
            return
        absent = self._entries.keys() - self._indexed
        if self._indexed and absent:
            at = self._chunk.chunk_start_offset
            self._fault(f"the chunk at byte {at} has no index of channels {sorted(absent)}")
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
            self._fault("its data has another CRC than it declares")


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
