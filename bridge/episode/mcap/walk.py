"""Walk through MCAP bytes record by record, believing no length and no size that is claimed.

Nothing here needs a summary. What is read into memory is one record at a time; what lies in a
chunk is unpacked by ``packed``.
"""

import struct
import zlib
from collections.abc import Iterator
from io import BufferedReader, BytesIO
from typing import Any, NamedTuple

import lz4.frame
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.summary import Summary

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.format import (
    CHUNK_FIELDS,
    FOOTER_FIELDS,
    MAGIC,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    RECORD_HEAD,
    Buffer,
    crc32,
)

ByteStream = BufferedReader | BytesIO
"""An open file, or bytes that act as one."""

_CLASSES: dict[int, Any] = {
    mcap_format.HEADER: records.Header,
    mcap_format.FOOTER: records.Footer,
    mcap_format.SCHEMA: records.Schema,
    mcap_format.CHANNEL: records.Channel,
    mcap_format.CHUNK: records.Chunk,
    mcap_format.MESSAGE_INDEX: records.MessageIndex,
    mcap_format.CHUNK_INDEX: records.ChunkIndex,
    mcap_format.ATTACHMENT_INDEX: records.AttachmentIndex,
    mcap_format.STATISTICS: records.Statistics,
    mcap_format.METADATA: records.Metadata,
    mcap_format.METADATA_INDEX: records.MetadataIndex,
    mcap_format.SUMMARY_OFFSET: records.SummaryOffset,
    mcap_format.DATA_END: records.DataEnd,
}
DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    EOFError,
    OSError,
    MemoryError,
    RuntimeError,  # lz4's own
)
"""What reading bytes that are not what they claim to be may raise."""


class BrokenRecordError(ValueError):
    """A record is not what it claims to be. The reader makes a sentence with the file's name."""


class RecordSpan(NamedTuple):
    """Where a record lies."""

    opcode: int
    offset: int
    """Of its opcode, from the start of the file."""
    length: int

    @property
    def end(self) -> int:
        """Where the next record begins."""
        return self.offset + RECORD_HEAD.size + self.length


def attachment_entry(
    offset: int, length: int, record: records.Attachment
) -> records.AttachmentIndex:
    """Make the index entry of an attachment."""
    return records.AttachmentIndex(
        offset=offset,
        length=length,
        log_time=record.log_time,
        create_time=record.create_time,
        data_size=len(record.data),
        name=record.name,
        media_type=record.media_type,
    )


def walk(stream: ByteStream, start: int, end: int) -> Iterator[RecordSpan]:
    """Yield the places of all records between two offsets; the stream may be used in between."""
    at = start
    while at < end:
        stream.seek(at)
        head = stream.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            raise BrokenRecordError(f"the record at byte {at} is cut off")
        opcode, length = RECORD_HEAD.unpack(head)
        if opcode == 0:
            raise BrokenRecordError(f"the record at byte {at} is of kind 0, which there is not")
        if length > end - at - RECORD_HEAD.size:
            message = f"the record at byte {at} claims {length} bytes, {end - at} are left"
            raise BrokenRecordError(message)
        place = RecordSpan(opcode, at, length)
        yield place
        at = place.end


def read_body(stream: ByteStream, place: RecordSpan) -> bytes:
    """Return a record's bytes without opcode and length."""
    stream.seek(place.offset + RECORD_HEAD.size)
    body = stream.read(place.length)
    if len(body) < place.length:
        raise BrokenRecordError(f"the record at byte {place.offset} is cut off")
    return body


class _Fields(ReadDataStream):
    """Takes the fields of one record off its bytes; what runs past their end is an error."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")


def parse(opcode: int, body: bytes) -> records.McapRecord | None:
    """Read a record other than messages and attachments; None for unknown opcodes."""
    kind = _CLASSES.get(opcode)
    if kind is None:
        return None
    try:
        found: records.McapRecord = kind.read(_Fields(BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError) as error:
        message = f"a {kind.__name__} record of {len(body)} bytes cannot be read"
        raise BrokenRecordError(message) from error
    return found


def attachment_of(body: bytes, at: int) -> records.Attachment:
    """Read the attachment whose record begins at byte ``at``, its CRC checked."""
    fields = _Fields(BytesIO(body))
    try:
        found: records.Attachment = records.Attachment.read(fields)
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise BrokenRecordError(f"the attachment at byte {at} cannot be read") from error
    end = fields.count - _U32.size
    if body[end : fields.count] not in (bytes(4), _U32.pack(zlib.crc32(body[:end]))):
        raise BrokenRecordError(f"attachment {found.name!r} has another CRC than it declares")
    return found


MAX_CHUNK_BYTES = 1 << 30
"""No chunk may unpack to more: a few bytes of zstd can claim terabytes."""


def chunk_bytes(front: bytes) -> int:
    """Length of the record that begins so; 0 unless it is a chunk whose lengths agree."""
    at = RECORD_HEAD.size + CHUNK_FIELDS.size + _U32.size
    try:
        opcode, length = RECORD_HEAD.unpack_from(front)
        _, _, size, _ = CHUNK_FIELDS.unpack_from(front, RECORD_HEAD.size)
        (name_bytes,) = _U32.unpack_from(front, at - _U32.size)
        (data_bytes,) = _U64.unpack_from(front, at + name_bytes)
    except struct.error:
        return 0
    is_known = opcode == mcap_format.CHUNK and front[at : at + name_bytes] in _COMPRESSIONS
    agree = at + name_bytes + _U64.size + data_bytes == RECORD_HEAD.size + length
    is_small = max(size, data_bytes) <= MAX_CHUNK_BYTES
    return RECORD_HEAD.size + int(length) if is_known and agree and is_small else 0


_COMPRESSIONS = (b"", b"lz4", b"zstd")


def chunk_entry(offset: int, length: int, chunk: records.Chunk) -> records.ChunkIndex:
    """Make the index entry of a chunk; its message indexes are yet to be added."""
    return records.ChunkIndex(
        chunk_length=length,
        chunk_start_offset=offset,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_start_time=chunk.message_start_time,
        message_end_time=chunk.message_end_time,
        message_index_length=0,
        message_index_offsets={},
        uncompressed_size=chunk.uncompressed_size,
    )


def parse_chunk(body: bytes) -> records.Chunk:
    """Read a chunk record; its data is left packed."""
    chunk: records.Chunk = parse(mcap_format.CHUNK, body)  # type: ignore[assignment]
    return chunk


def unpack_chunk(chunk: records.Chunk, *, whose: str = "a chunk") -> bytes:
    """Decompress a chunk and compare its size and CRC."""
    size, crc = chunk.uncompressed_size, chunk.uncompressed_crc
    if size > MAX_CHUNK_BYTES:
        raise BrokenRecordError(f"{whose} claims {size} bytes, more than {MAX_CHUNK_BYTES}")
    try:
        data = _decompress(chunk.compression, chunk.data, size)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise BrokenRecordError(f"{whose} cannot be unpacked ({error})") from error
    if len(data) != size:
        raise BrokenRecordError(f"{whose} has {len(data)} bytes, {size} are declared")
    if crc and crc32(data, 0) != crc:
        raise BrokenRecordError(f"{whose} has another CRC than it declares")
    return data


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    if compression == "" or not size:
        return data if compression == "" else b""
    if compression == "zstd":
        declared = zstandard.get_frame_parameters(data).content_size
        if declared not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            message = f"a zstd frame of {declared} bytes where {size} are declared"
            raise BrokenRecordError(message)
        return zstandard.decompress(data, max_output_size=size)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    raise BrokenRecordError(f"compression {compression!r} is not known")


class MessageHead(NamedTuple):
    """A message inside a buffer or file, its payload left where it is."""

    log_time_ns: int
    length: int
    channel_id: int
    sequence: int
    publish_time_ns: int


def message_head(data: Buffer, at: int) -> MessageHead:
    """Read the front of the message record at ``at``."""
    _, length, channel_id, sequence, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(data, at)
    if length < MESSAGE_FIELDS:
        raise BrokenRecordError(f"a message record of {length} bytes")
    return MessageHead(log_ns, length - MESSAGE_FIELDS, channel_id, sequence, publish_ns)


def records_in(data: Buffer, at: int = 0) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, offset and body length of each record in a chunk's data, or a summary."""
    end = len(data)
    head_bytes, unpack = RECORD_HEAD.size, RECORD_HEAD.unpack_from
    while at < end:
        if end - at < head_bytes:
            raise BrokenRecordError(f"{end - at} bytes too many behind the last record")
        opcode, length = unpack(data, at)
        after = at + head_bytes + length
        if after > end or opcode == 0 or (opcode == MESSAGE and length < MESSAGE_FIELDS):
            message = f"a record of kind {opcode} claims {length} of {end - at} bytes"
            raise BrokenRecordError(message)
        yield opcode, at, length
        at = after


_FOOTER_BYTES = RECORD_HEAD.size + FOOTER_FIELDS.size + len(MAGIC)


def read_header(stream: ByteStream) -> records.Header:
    """Read magic and first record; raises BrokenRecordError."""
    if stream.read(len(MAGIC)) != MAGIC:
        raise BrokenRecordError("it does not begin as an MCAP file does")
    place = next(walk(stream, len(MAGIC), stream.seek(0, 2)), None)
    record = parse(place.opcode, read_body(stream, place)) if place else None
    if not isinstance(record, records.Header):
        raise BrokenRecordError("its first record is no header")
    return record


def read_footer(stream: ByteStream) -> tuple[records.Footer, int]:
    """Read the last record and say where it begins; raises BrokenRecordError."""
    at = stream.seek(0, 2) - _FOOTER_BYTES
    stream.seek(max(at, 0))
    tail = stream.read(_FOOTER_BYTES)
    if len(tail) < _FOOTER_BYTES or not tail.endswith(MAGIC):
        raise BrokenRecordError("it does not end as a finished MCAP file does")
    footer = parse(tail[0], tail[RECORD_HEAD.size : -len(MAGIC)])
    if not isinstance(footer, records.Footer):
        raise BrokenRecordError("its last record is no footer")
    if footer.summary_start > at:
        message = f"its summary should begin at byte {footer.summary_start}, behind its footer"
        raise BrokenRecordError(message)
    return footer, at


def read_summary(stream: ByteStream, footer: records.Footer, footer_at: int) -> Summary | None:
    """Read the summary section with its CRC checked, None where there is none."""
    if not footer.summary_start:
        return None
    stream.seek(footer.summary_start)
    # The CRC covers everything up to itself, the last field of the footer.
    section = stream.read(footer_at + RECORD_HEAD.size + 16 - footer.summary_start)
    if footer.summary_crc and zlib.crc32(section) != footer.summary_crc:
        raise BrokenRecordError("its summary has another CRC than it declares")
    summary = Summary()
    for opcode, at, length in records_in(section[: footer_at - footer.summary_start]):
        start = at + RECORD_HEAD.size
        _add(summary, parse(opcode, section[start : start + length]))
    return summary


def _add(summary: Summary, record: records.McapRecord | None) -> None:
    if isinstance(record, records.Statistics):
        summary.statistics = record
    elif isinstance(record, records.Schema):
        summary.schemas[record.id] = record
    elif isinstance(record, records.Channel):
        summary.channels[record.id] = record
    elif isinstance(record, records.AttachmentIndex):
        summary.attachment_indexes.append(record)
    elif isinstance(record, records.ChunkIndex):
        summary.chunk_indexes.append(record)
    elif isinstance(record, records.MetadataIndex):
        summary.metadata_indexes.append(record)
