"""Walk through one MCAP file from front to back and compare everything it says of itself.

The walk believes neither summary nor index; they are compared with what it finds. Memory holds one
record at a time, and the index.
"""

import struct
import zlib
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt64
from mcap import records

from bridge.episode.check_summary import Seen, summary_faults
from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.file import read_footer, read_header, read_summary
from bridge.episode.mcap.format import MAGIC, MESSAGE, MESSAGE_HEAD, RECORD_HEAD
from bridge.episode.mcap.packed import (
    MessageHead,
    message_head,
    parse_chunk,
    records_in,
    unpack_chunk,
)
from bridge.episode.mcap.rebuild import attachment_entry, chunk_entry
from bridge.episode.mcap.walk import (
    DAMAGE,
    PIECE_BYTES,
    BrokenRecordError,
    ByteStream,
    Place,
    attachment_of,
    parse,
    read_body,
    walk,
)

_INDEX_HEAD = struct.Struct("<HI")
NEVER = 1 << 64
"""After every log time there can be."""


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
                data_end = footer.summary_start or footer_at
                yield from self._walk_data(stream, data_end)
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

    def _take(self, place: Place, body: bytes) -> Iterator[ScannedMessage]:
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

    def _define(self, place: Place, record: records.McapRecord | None) -> None:
        for text in self.seen.define(place, record):
            self._fault(text)

    def _walk_chunk(self, place: Place, body: bytes) -> Iterator[ScannedMessage]:
        self._end_chunk()
        whose = f"the chunk at byte {place.offset}"
        self.seen.num_chunks += 1
        chunk = parse_chunk(body)
        self._chunk = chunk_entry(place, chunk)
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
                self._define(Place(opcode, at, length), parse(opcode, data[start : start + length]))
        found = (first_ns, last_ns) if self._entries else (0, 0)
        if found != (chunk.start_ns, chunk.end_ns):
            said = (chunk.start_ns, chunk.end_ns)
            self._fault(f"{whose} says its messages are from {said}, they are from {found}")

    def _note(self, head: MessageHead) -> None:
        entries = self._entries.get(head.channel_id)
        if entries is None:
            entries = self._entries[head.channel_id] = array("Q")
        entries.append(head.log_time_ns)
        entries.append(head.at)

    def _check_index(self, place: Place, body: bytes) -> None:
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

    def _add_attachment(self, stream: ByteStream, place: Place) -> None:
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

    def _check_data_end(self, stream: ByteStream, place: Place) -> None:
        record = parse(place.opcode, read_body(stream, place))
        if isinstance(record, records.DataEnd) and record.data_section_crc not in (0, self._crc):
            self._fault("its data has another CRC than it declares")


def _index_entries(body: bytes) -> tuple[int, UInt64[np.ndarray, "entries 2"]]:
    """Read a message index: its channel, and log time and offset of each message."""
    if len(body) < _INDEX_HEAD.size:
        message = f"a message index of {len(body)} bytes"
        raise BrokenRecordError(message)
    channel_id, length = _INDEX_HEAD.unpack_from(body)
    if length % 16 or length > len(body) - _INDEX_HEAD.size:
        message = f"a message index of {len(body)} bytes claims {length} bytes of entries"
        raise BrokenRecordError(message)
    entries = np.frombuffer(body, dtype="<u8", count=length // 8, offset=_INDEX_HEAD.size)
    return channel_id, entries.astype(np.uint64).reshape(-1, 2)


def _in_order(entries: UInt64[np.ndarray, "entries 2"]) -> UInt64[np.ndarray, "entries 2"]:
    return entries[np.lexsort((entries[:, 1], entries[:, 0]))]
