"""Walk through an MCAP file record by record, finished or not, whoever wrote it.

Nothing but the front of the file is believed: no summary, no index. Damage is stepped over where
a later chunk can be found. Memory is bounded by one chunk.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

from mcap.records import Chunk as ChunkRecord
from mcap.records import McapRecord

from bridge.episode.mcap import format as mcap
from bridge.episode.mcap.damaged import BLOCK_BYTES, Contents, RecordFile, read_plain, walk_records
from bridge.episode.mcap.walk import (
    MAX_CHUNK_BYTES,
    BrokenRecordError,
    attachment_of,
    chunk_bytes,
    parse_chunk,
    unpack_chunk,
)


@dataclass(frozen=True, kw_only=True)
class Span:
    """Where a record lies."""

    offset: int
    length: int

    @property
    def end(self) -> int:
        """The first byte after it."""
        return self.offset + self.length


@dataclass(frozen=True, kw_only=True)
class Plain(Span):
    """A header, schema, channel, metadata, attachment, data end or private record, whole."""

    opcode: int
    raw: bytes
    record: McapRecord | None
    """What it says; None of a private one."""


@dataclass(frozen=True, kw_only=True)
class Chunk(Span):
    """A chunk whose CRC and structure are right."""

    raw: bytes
    packed: ChunkRecord
    records: bytes
    """Unpacked."""
    contents: Contents


@dataclass(frozen=True, kw_only=True)
class TopMessage(Span):
    """A message outside chunks."""

    channel_id: int
    log_time_ns: int


@dataclass(frozen=True, kw_only=True)
class IndexSpan(Span):
    """A message index, not looked into."""


@dataclass(frozen=True, kw_only=True)
class Damage(Span):
    """Bytes that were stepped over, or the cut end of the file."""

    what: str
    at_end: bool = False


Found: TypeAlias = Plain | Chunk | TopMessage | IndexSpan | Damage


MAX_PLAIN_BYTES = 64 << 20
"""Headers, schemas, channels and metadata beyond this are refused."""
_FRONT_BYTES = 64
"""Enough for every fixed part of a record."""
_SUMMARY_ONLY = frozenset(
    {
        mcap.FOOTER,
        mcap.CHUNK_INDEX,
        mcap.ATTACHMENT_INDEX,
        mcap.STATISTICS,
        mcap.METADATA_INDEX,
        mcap.SUMMARY_OFFSET,
    }
)
_KINDS = {
    mcap.HEADER: "header",
    mcap.SCHEMA: "schema",
    mcap.CHANNEL: "channel",
    mcap.MESSAGE: "message",
    mcap.CHUNK: "chunk",
    mcap.MESSAGE_INDEX: "message index",
    mcap.ATTACHMENT: "attachment",
    mcap.METADATA: "metadata record",
    mcap.DATA_END: "end of the data",
}
PRIVATE = 0x80
"""Opcodes from here on belong to applications; every reader skips those it does not know."""


def scan(file: RecordFile) -> Iterator[Found]:
    """Return what the file holds, in order, without a gap; ends at DataEnd or the last damage."""
    position = len(mcap.MAGIC)
    before: Found | None = None
    if file.read(0, position) != mcap.MAGIC:
        damage = _step_over(file, 0, "it does not begin like an MCAP file")
        yield damage
        position = damage.end
    while position < file.size:
        try:
            found = _read_record(file, position)
            if isinstance(found, TopMessage) and isinstance(before, (Chunk, IndexSpan, Damage)):
                _refuse_renamed_index(file, found)
        except BrokenRecordError as error:
            found = _read_damaged(file, position, str(error))
        if found is None:
            return
        yield found
        if isinstance(found, Plain) and found.opcode == mcap.DATA_END:
            return
        before, position = found, found.end


def _read_record(file: RecordFile, offset: int) -> Found | None:
    """Read the record at an offset; None where the summary begins without an end of the data."""
    front = file.read(offset, _FRONT_BYTES)
    if len(front) < mcap.RECORD_HEAD.size:
        raise BrokenRecordError("the file ends inside a record")
    opcode, size = mcap.RECORD_HEAD.unpack_from(front)
    if opcode in _SUMMARY_ONLY:
        return None
    if opcode == 0 or (opcode not in _KINDS and opcode < PRIVATE):
        raise BrokenRecordError(f"there is no record of kind {opcode}")
    length = mcap.RECORD_HEAD.size + size
    kind = _KINDS.get(opcode, "private record")
    if offset + length > file.size:
        raise BrokenRecordError(f"the file ends inside a {kind}")
    if opcode == mcap.CHUNK:
        return _read_chunk(file, offset, front)
    if opcode == mcap.MESSAGE:
        return _read_message(offset, length, front)
    if opcode == mcap.MESSAGE_INDEX:
        return _read_index(offset, length, front)
    if opcode == mcap.ATTACHMENT:
        raw = file.read(offset, length)
        record = attachment_of(raw[mcap.RECORD_HEAD.size :], offset)
        return Plain(offset=offset, length=length, opcode=opcode, raw=raw, record=record)
    if length > MAX_PLAIN_BYTES:
        raise BrokenRecordError(f"a {kind} claims {length} bytes")
    raw = file.read(offset, length)
    return Plain(offset=offset, length=length, opcode=opcode, raw=raw, record=read_plain(raw))


def _read_chunk(file: RecordFile, offset: int, front: bytes) -> Chunk:
    length = chunk_bytes(front)
    if not length:
        message = "a chunk is damaged: its lengths contradict each other, or are beyond all limits"
        raise BrokenRecordError(message)
    raw = file.read(offset, length)
    packed = parse_chunk(raw[mcap.RECORD_HEAD.size :])
    records = unpack_chunk(packed)
    return Chunk(
        offset=offset,
        length=length,
        raw=raw,
        packed=packed,
        records=records,
        contents=walk_records(records),
    )


def _read_message(offset: int, length: int, front: bytes) -> TopMessage:
    if not mcap.MESSAGE_HEAD.size <= length <= MAX_CHUNK_BYTES:
        raise BrokenRecordError(f"a message claims {length} bytes")
    _, _, channel_id, _, log_time_ns, _ = mcap.MESSAGE_HEAD.unpack_from(front)
    return TopMessage(offset=offset, length=length, channel_id=channel_id, log_time_ns=log_time_ns)


_INDEX_FRONT = struct.Struct("<BQHI")
"""Opcode, length, channel, bytes of the entries that follow."""
_INDEX_ENTRY_BYTES = 16


def _read_index(offset: int, length: int, front: bytes) -> IndexSpan:
    """A message whose opcode was altered must not pass for an index: it would be lost unsaid."""
    size = _index_bytes(front)
    if size % _INDEX_ENTRY_BYTES or _INDEX_FRONT.size + size > length:
        raise BrokenRecordError("a message index is damaged: its lengths contradict each other")
    return IndexSpan(offset=offset, length=length)


def _refuse_renamed_index(file: RecordFile, found: TopMessage) -> None:
    """An index whose opcode was altered must not pass for a message that nobody sent."""
    size = _index_bytes(file.read(found.offset, _FRONT_BYTES))
    if size and size % _INDEX_ENTRY_BYTES == 0 and _INDEX_FRONT.size + size == found.length:
        raise BrokenRecordError("a message index calls itself a message")


def _index_bytes(front: bytes) -> int:
    if len(front) < _INDEX_FRONT.size:
        raise BrokenRecordError("the file ends inside a message index")
    return int(_INDEX_FRONT.unpack_from(front)[3])


def _read_damaged(file: RecordFile, offset: int, what: str) -> Found | None:
    """Step over damage; a cut message index at the end costs nothing."""
    length = _trusted_length(file, offset)
    if length:
        end = offset + length
        return Damage(
            offset=offset, length=length, what=f"at byte {offset} {what}", at_end=end >= file.size
        )
    damage = _step_over(file, offset, what)
    if not damage.at_end:
        return damage
    front = file.read(offset, _FRONT_BYTES)
    if front[0] == mcap.DATA_END:
        return None
    if front[0] == mcap.MESSAGE_INDEX:
        return IndexSpan(offset=offset, length=damage.length)
    return damage


def _trusted_length(file: RecordFile, offset: int) -> int:
    """Length of a damaged record, 0 unless another record or the end of the file follows it."""
    front = file.read(offset, mcap.RECORD_HEAD.size)
    if len(front) < mcap.RECORD_HEAD.size:
        return 0
    opcode, size = mcap.RECORD_HEAD.unpack_from(front)
    end = offset + mcap.RECORD_HEAD.size + size
    if opcode not in _KINDS or end > file.size:
        return 0
    following = file.read(end, 1)
    known = not following or following[0] in _KINDS or following[0] in _SUMMARY_ONLY
    return end - offset if known else 0


def _step_over(file: RecordFile, offset: int, what: str) -> Damage:
    """Find the next thing that looks like a chunk after a damaged place."""
    following = _next_chunk(file, offset)
    return Damage(
        offset=offset,
        length=(file.size if following is None else following) - offset,
        what=f"at byte {offset} {what}",
        at_end=following is None,
    )


def _next_chunk(file: RecordFile, offset: int) -> int | None:
    """Return where the next thing that looks like a chunk begins, after ``offset``."""
    start = offset + 1
    while start < file.size:
        window = file.read(start, BLOCK_BYTES + _FRONT_BYTES)
        at = window.find(mcap.CHUNK, 0, BLOCK_BYTES)
        while at >= 0:
            length = chunk_bytes(window[at : at + _FRONT_BYTES])
            if length and start + at + length <= file.size:
                return start + at
            at = window.find(mcap.CHUNK, at + 1, BLOCK_BYTES)
        start += BLOCK_BYTES
    return None
