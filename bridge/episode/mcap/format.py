"""How MCAP records look in bytes: one small function per record, used by writer and recovery.

Layouts follow the MCAP specification, version 0. Numbers are little-endian, times are nanoseconds,
a text is its UTF-8 bytes after their number. Offsets count from the start of the file.
"""

import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from types import MappingProxyType
from typing import TypeAlias

MAGIC = b"\x89MCAP0\r\n"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(0x01, 0x09)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX = range(0x09, 0x0E)
SUMMARY_OFFSET, DATA_END = 0x0E, 0x0F

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and the number of bytes that follow."""
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; the payload follows."""
MESSAGE_FIELDS = MESSAGE_HEAD.size - RECORD_HEAD.size
CHUNK_FIELDS = struct.Struct("<QQQI")
"""First and last log time, size and CRC of the records inside before compression."""
ATTACHMENT_FIELDS = struct.Struct("<QQ")
FOOTER_FIELDS = struct.Struct("<QQI")
"""Start of the summary, start of its offsets, CRC of the summary."""

Buffer: TypeAlias = bytes | bytearray | memoryview
Payload: TypeAlias = Buffer | Sequence[Buffer]
"""Bytes, whole or in pieces that follow each other."""


@dataclass(frozen=True, kw_only=True)
class ChunkPlace:
    """What a chunk index record says of one chunk."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    index_offsets: Mapping[int, int]
    """Where the message index of each channel lies."""
    index_length: int
    compression: str
    compressed_size: int
    uncompressed_size: int


def num_bytes(data: Buffer) -> int:
    """Return the size of a buffer, whatever its items are."""
    return data.nbytes if isinstance(data, memoryview) else len(data)


def record(opcode: int, *parts: bytes) -> bytes:
    """Join the parts to one record."""
    body = b"".join(parts)
    return RECORD_HEAD.pack(opcode, len(body)) + body


def text(value: str) -> bytes:
    """Encode a text with its length."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def text_map(values: Mapping[str, str]) -> bytes:
    """Encode a map of texts with its length in bytes."""
    data = b"".join(text(name) + text(value) for name, value in values.items())
    return struct.pack("<I", len(data)) + data


def header(profile: str, library: str) -> bytes:
    """Encode the first record of a file."""
    return record(HEADER, text(profile), text(library))


def schema(schema_id: int, name: str, encoding: str, data: bytes) -> bytes:
    """Encode a schema; ids start at 1."""
    size = struct.pack("<I", len(data))
    return record(SCHEMA, struct.pack("<H", schema_id), text(name), text(encoding), size, data)


def channel(
    channel_id: int,
    schema_id: int,
    topic: str,
    message_encoding: str,
    about: Mapping[str, str] = MappingProxyType({}),
) -> bytes:
    """Encode a channel with its metadata; schema id 0 is none."""
    ids = struct.pack("<HH", channel_id, schema_id)
    return record(CHANNEL, ids, text(topic), text(message_encoding), text_map(about))


def chunk_head(
    *, start_ns: int, end_ns: int, size: int, crc: int, compression: str, data_size: int
) -> bytes:
    """Encode everything of a chunk that stands before its data."""
    fields = CHUNK_FIELDS.pack(start_ns, end_ns, size, crc) + text(compression)
    fields += struct.pack("<Q", data_size)
    return RECORD_HEAD.pack(CHUNK, len(fields) + data_size) + fields


def message_index(channel_id: int, entries: list[int]) -> bytes:
    """Encode where a channel's messages lie in a chunk: log time, offset, log time, offset ..."""
    head = struct.pack("<HI", channel_id, 8 * len(entries))
    return record(MESSAGE_INDEX, head, struct.pack(f"<{len(entries)}Q", *entries))


def chunk_index(place: ChunkPlace) -> bytes:
    """Encode a chunk index."""
    offsets = b"".join(struct.pack("<HQ", *item) for item in place.index_offsets.items())
    return record(
        CHUNK_INDEX,
        struct.pack(
            "<QQQQI", place.start_ns, place.end_ns, place.offset, place.length, len(offsets)
        ),
        offsets,
        struct.pack("<Q", place.index_length),
        text(place.compression),
        struct.pack("<QQ", place.compressed_size, place.uncompressed_size),
    )


def attachment(
    name: str, data: bytes, *, media_type: str, log_time_ns: int, create_time_ns: int
) -> list[Buffer]:
    """Encode an attachment as buffers to be written one after the other."""
    fields = ATTACHMENT_FIELDS.pack(log_time_ns, create_time_ns) + text(name) + text(media_type)
    fields += struct.pack("<Q", len(data))
    crc = zlib.crc32(data, zlib.crc32(fields))
    head = RECORD_HEAD.pack(ATTACHMENT, len(fields) + len(data) + 4) + fields
    return [head, data, struct.pack("<I", crc)]


def attachment_index(
    name: str,
    *,
    media_type: str,
    log_time_ns: int,
    create_time_ns: int,
    data_size: int,
    offset: int,
    length: int,
) -> bytes:
    """Encode where an attachment record of ``length`` bytes lies."""
    numbers = struct.pack("<QQQQQ", offset, length, log_time_ns, create_time_ns, data_size)
    return record(ATTACHMENT_INDEX, numbers, text(name), text(media_type))


def metadata(name: str, values: Mapping[str, str]) -> bytes:
    """Encode a metadata record."""
    return record(METADATA, text(name), text_map(values))


def metadata_index(name: str, *, offset: int, length: int) -> bytes:
    """Encode where a metadata record of ``length`` bytes lies."""
    return record(METADATA_INDEX, struct.pack("<QQ", offset, length), text(name))


def statistics(
    *,
    schemas: int,
    attachments: int,
    metadata_records: int,
    chunks: int,
    channels: int,
    start_ns: int,
    end_ns: int,
    message_counts: Mapping[int, int],
) -> bytes:
    """Encode the counts of a file; ``message_counts`` is by channel."""
    counts = b"".join(struct.pack("<HQ", *item) for item in message_counts.items())
    numbers = (sum(message_counts.values()), schemas, channels, attachments, metadata_records)
    times = (chunks, start_ns, end_ns, len(counts))
    return record(STATISTICS, struct.pack("<QHIII", *numbers), struct.pack("<IQQI", *times), counts)


def summary_offset(opcode: int, *, start: int, length: int) -> bytes:
    """Encode where the summary's records of one kind lie."""
    return record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, start, length))


def data_end(crc: int) -> bytes:
    """Encode the end of the data; ``crc`` is that of the whole file up to here, 0 for unknown."""
    return record(DATA_END, struct.pack("<I", crc))


def summary_section(groups: Iterable[tuple[int, bytes]], start: int) -> bytes:
    """Encode summary, offsets, footer and magic."""
    body, offsets = b"", b""
    for opcode, records in groups:
        if records:
            offsets += summary_offset(opcode, start=start + len(body), length=len(records))
            body += records
    if not body:
        start = 0
    offsets_start = start + len(body) if offsets else 0
    body += offsets
    head = RECORD_HEAD.pack(FOOTER, FOOTER_FIELDS.size) + struct.pack("<QQ", start, offsets_start)
    crc = zlib.crc32(head, zlib.crc32(body))
    return body + head + struct.pack("<I", crc) + MAGIC


# The CRC of a whole file is wanted beside the CRC of every chunk; reading each image twice would
# cost as much as writing it. A CRC-32 is a remainder of polynomials over GF(2): appending n bytes
# multiplies the first remainder by x^(8n). Bit 31 of the reflected form is the coefficient of x^0.


def _fastest() -> Callable[[Buffer, int], int]:
    """Return the native function where it is built and the processor has the instruction."""
    try:
        native = import_module("bridge.episode._crc32")
    except ImportError:
        return zlib.crc32
    return native.crc32 if native.is_fast() else zlib.crc32


crc32 = _fastest()
"""``crc32(data, value)`` continues from ``value``, 0 at first, as ``zlib.crc32`` does."""

_POLYNOMIAL = 0xEDB88320
_ONE = 1 << 31


def _times(a: int, b: int) -> int:
    """Multiply two polynomials modulo the CRC's."""
    product = 0
    while a:
        if a & _ONE:
            product ^= b
        a = (a << 1) & 0xFFFF_FFFF
        b = (b >> 1) ^ _POLYNOMIAL if b & 1 else b >> 1
    return product


def _powers() -> list[int]:
    """Return x^8, x^16, x^32, ... for lengths of up to 2^64 bytes."""
    power = _ONE >> 8
    found = []
    for _ in range(64):
        found.append(power)
        power = _times(power, power)
    return found


_X_POWERS = _powers()


@lru_cache(maxsize=512)
def _shift(num_bytes: int) -> int:
    factor, place = _ONE, 0
    while num_bytes:
        if num_bytes & 1:
            factor = _times(_X_POWERS[place], factor)
        num_bytes >>= 1
        place += 1
    return factor


def joined_crc(first: int, second: int, second_length: int) -> int:
    """Return the CRC-32 of two pieces from that of each."""
    return _times(_shift(second_length), first) ^ second
