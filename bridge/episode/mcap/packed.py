"""What lies packed in a chunk: its records, and the messages among them.

Like ``walk`` it believes no length and no size that is claimed. A chunk may grow to
``MAX_CHUNK_BYTES`` when it is unpacked.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

import lz4.frame
import zstandard

from bridge.episode.mcap.checksum import crc32
from bridge.episode.mcap.format import (
    CHUNK_FIELDS,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    RECORD_HEAD,
)
from bridge.episode.mcap.walk import BrokenRecordError

MAX_CHUNK_BYTES = 1 << 30
"""No chunk may unpack to more: a few bytes of zstd can claim terabytes."""


class ChunkHead(NamedTuple):
    """A chunk record, its data still packed."""

    start_ns: int
    end_ns: int
    size: int
    """Bytes of the records inside when unpacked."""
    crc: int
    """CRC-32 of those bytes, 0 for unknown."""
    compression: str
    data: memoryview


def parse_chunk(body: bytes) -> ChunkHead:
    """Read a chunk record.

    Raises:
        BrokenRecordError: When its fields run past its end.
    """
    try:
        start_ns, end_ns, size, crc = CHUNK_FIELDS.unpack_from(body, 0)
        at = CHUNK_FIELDS.size
        (length,) = struct.unpack_from("<I", body, at)
        at += 4
        compression = str(body[at : at + length], "utf-8")
        at += length
        (length,) = struct.unpack_from("<Q", body, at)
    except (struct.error, ValueError) as error:
        message = f"a chunk record of {len(body)} bytes cannot be read"
        raise BrokenRecordError(message) from error
    at += 8
    if length > len(body) - at:
        message = f"a chunk claims {length} bytes of data, {len(body) - at} are there"
        raise BrokenRecordError(message)
    data = memoryview(body)[at : at + length]
    return ChunkHead(start_ns, end_ns, size, crc, compression, data)


def unpack_chunk(chunk: ChunkHead, *, whose: str = "a chunk") -> bytes:
    """Decompress a chunk and compare its size and CRC.

    Raises:
        BrokenRecordError: When one of them is wrong, or it is too large to be believed.
    """
    if chunk.size > MAX_CHUNK_BYTES:
        message = f"{whose} claims {chunk.size} bytes, more than {MAX_CHUNK_BYTES}"
        raise BrokenRecordError(message)
    try:
        data = _decompress(chunk)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        message = f"{whose} cannot be unpacked ({error})"
        raise BrokenRecordError(message) from error
    if len(data) != chunk.size:
        message = f"{whose} has {len(data)} bytes, {chunk.size} are declared"
        raise BrokenRecordError(message)
    if chunk.crc and crc32(data, 0) != chunk.crc:
        message = f"{whose} has another CRC than it declares"
        raise BrokenRecordError(message)
    return data


def _decompress(chunk: ChunkHead) -> bytes:
    if chunk.compression == "":
        return bytes(chunk.data)
    if not chunk.size:
        return b""
    if chunk.compression == "zstd":
        declared = zstandard.get_frame_parameters(chunk.data).content_size
        if declared not in (chunk.size, zstandard.CONTENTSIZE_UNKNOWN):
            message = f"a zstd frame of {declared} bytes where {chunk.size} are declared"
            raise BrokenRecordError(message)
        return zstandard.decompress(chunk.data, max_output_size=chunk.size)
    if chunk.compression == "lz4":
        unpacker = lz4.frame.LZ4FrameDecompressor()
        return bytes(unpacker.decompress(chunk.data, max_length=chunk.size))
    message = f"compression {chunk.compression!r} is not known"
    raise BrokenRecordError(message)


class MessageHead(NamedTuple):
    """A message inside a buffer or file, its payload left where it is."""

    log_time_ns: int
    at: int
    """Where the record begins: in a chunk's data, or in the file."""
    length: int
    """Of the payload."""
    channel_id: int
    sequence: int
    publish_time_ns: int


def message_head(data: bytes | memoryview, at: int, where: int) -> MessageHead:
    """Read the front of the message record at ``at``; ``where`` becomes its ``at``."""
    _, length, channel_id, sequence, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(data, at)
    if length < MESSAGE_FIELDS:
        message = f"a message record of {length} bytes"
        raise BrokenRecordError(message)
    return MessageHead(log_ns, where, length - MESSAGE_FIELDS, channel_id, sequence, publish_ns)


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, offset and body length of each record in a chunk's unpacked data.

    Raises:
        BrokenRecordError: When a record claims more bytes than are left, or is of kind 0.
    """
    at, end = 0, len(data)
    head_bytes, unpack = RECORD_HEAD.size, RECORD_HEAD.unpack_from
    while at < end:
        if end - at < head_bytes:
            message = f"{end - at} bytes too many at the end of a chunk"
            raise BrokenRecordError(message)
        opcode, length = unpack(data, at)
        after = at + head_bytes + length
        if after > end or opcode == 0 or (opcode == MESSAGE and length < MESSAGE_FIELDS):
            message = f"a record of kind {opcode} in a chunk claims {length} of {end - at} bytes"
            raise BrokenRecordError(message)
        yield opcode, at, length
        at = after
