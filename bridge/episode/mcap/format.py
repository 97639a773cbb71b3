"""How MCAP records look in bytes: those that must be quick, and the `mcap` package's for others.

Layouts follow the MCAP specification, version 0. Numbers are little-endian, times are nanoseconds,
a text is its UTF-8 bytes after their number. Offsets count from the start of the file.
"""

import struct
import zlib
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TypeAlias

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.summary import Summary

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
FOOTER_FIELDS = struct.Struct("<QQI")
"""Start of the summary, start of its offsets, CRC of the summary."""

Buffer: TypeAlias = bytes | bytearray | memoryview


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


def encoded(entry: records.McapRecord) -> bytes:
    """Encode a record that is small or rare: any but messages, chunks and their indexes."""
    builder = RecordBuilder()
    entry.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def chunk_head(entry: records.ChunkIndex, crc: int) -> bytes:
    """Encode everything of a chunk that stands before its data; ``crc`` is that of its records."""
    fields = CHUNK_FIELDS.pack(
        entry.message_start_time, entry.message_end_time, entry.uncompressed_size, crc
    )
    fields += text(entry.compression) + struct.pack("<Q", entry.compressed_size)
    return RECORD_HEAD.pack(CHUNK, len(fields) + entry.compressed_size) + fields


def message_index(channel_id: int, entries: list[int]) -> bytes:
    """Encode where a channel's messages lie in a chunk: log time, offset, log time, offset ..."""
    head = struct.pack("<HI", channel_id, 8 * len(entries))
    return record(MESSAGE_INDEX, head, struct.pack(f"<{len(entries)}Q", *entries))


class FileSummary(Summary):
    """The summary of a file whose data is being written, or read from front to back."""

    def __init__(self) -> None:
        """Begin with an empty file."""
        super().__init__()
        self.message_counts: dict[int, int] = {}
        self.start_ns: int | None = None
        self.end_ns = 0

    def add_messages(self, counts: Mapping[int, int], start_ns: int, end_ns: int) -> None:
        """Book messages by channel, the first and the last log time among them."""
        for channel_id, count in counts.items():
            self.message_counts[channel_id] = self.message_counts.get(channel_id, 0) + count
        if counts:
            self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
            self.end_ns = max(self.end_ns, end_ns)

    def sum_up(self) -> records.Statistics:
        """Make the statistics."""
        self.statistics = records.Statistics(
            attachment_count=len(self.attachment_indexes),
            channel_count=len(self.channels),
            channel_message_counts=dict(sorted(self.message_counts.items())),
            chunk_count=len(self.chunk_indexes),
            message_count=sum(self.message_counts.values()),
            message_start_time=self.start_ns or 0,
            message_end_time=self.end_ns,
            metadata_count=len(self.metadata_indexes),
            schema_count=len(self.schemas),
        )
        return self.statistics

    def encode(self, start: int) -> bytes:
        """Return everything from the summary to the end of the file."""
        definitions = (self.schemas.values(), self.channels.values(), [self.sum_up()])
        indexes = (self.chunk_indexes, self.attachment_indexes, self.metadata_indexes)
        body, offsets = b"", b""
        for group in filter(None, (*definitions, *indexes)):
            data = b"".join(map(encoded, group))
            offsets += encoded(records.SummaryOffset(data[0], start + len(body), len(data)))
            body += data
        head = RECORD_HEAD.pack(FOOTER, FOOTER_FIELDS.size)
        head += struct.pack("<QQ", start, start + len(body))
        crc = zlib.crc32(head, zlib.crc32(offsets, zlib.crc32(body)))
        return body + offsets + head + struct.pack("<I", crc) + MAGIC


def _fastest() -> Callable[[Buffer, int], int]:
    """Return the native function where it is built and the processor has the instruction."""
    try:
        native = import_module("bridge.episode._crc32")
    except ImportError:
        return zlib.crc32
    return native.crc32 if native.is_fast() else zlib.crc32


crc32 = _fastest()
"""``crc32(data, value)`` continues from ``value``, 0 at first, as ``zlib.crc32`` does."""
