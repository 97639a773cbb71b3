"""Read MCAP records and chunks whose bytes may be anything: lengths are checked before use."""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import zstandard

from bridge.episode.mcap import format as mcap
from bridge.episode.mcap.format import (
    CHANNEL,
    CHUNK,
    CHUNK_FIELDS,
    MESSAGE,
    MESSAGE_FIELDS,
    RECORD_HEAD,
    SCHEMA,
    Buffer,
    crc32,
)
from bridge.errors import MissingDependencyError

BLOCK_BYTES = 1 << 20


class RecordFile:
    """Reads pieces of an open file."""

    def __init__(self, descriptor: int) -> None:
        """Use a descriptor that stays its owner's."""
        self.descriptor = descriptor
        self.size = os.fstat(descriptor).st_size

    def read(self, offset: int, size: int) -> bytes:
        """Return up to ``size`` bytes, fewer only at the end of the file."""
        size = min(size, self.size - offset)
        data = os.pread(self.descriptor, size, offset) if size > 0 else b""
        while len(data) < size:  # one call returns at most 2 GiB
            more = os.pread(self.descriptor, size - len(data), offset + len(data))
            if not more:
                break
            data += more
        return data

    def read_into(self, offset: int, room: memoryview) -> int:
        """Fill ``room`` and return how many bytes there were, fewer only at the end."""
        done = 0
        while done < len(room):
            count = os.preadv(self.descriptor, [room[done:]], offset + done)
            if not count:
                break
            done += count
        return done

    def blocks(self, offset: int, size: int) -> Iterator[bytes]:
        """Return a range in blocks."""
        end = min(offset + size, self.size)
        while offset < end:
            block = self.read(offset, min(BLOCK_BYTES, end - offset))
            if not block:
                return
            yield block
            offset += len(block)

    def crc(self, offset: int, size: int) -> int:
        """CRC-32 of a range."""
        crc = 0
        for block in self.blocks(offset, size):
            crc = crc32(block, crc)
        return crc


_FOOTER_BYTES = mcap.RECORD_HEAD.size + mcap.FOOTER_FIELDS.size + len(mcap.MAGIC)


def _summary_start(file: RecordFile) -> int | None:
    """Return where the summary of a file begins, None unless its CRC is right."""
    if file.size < 2 * _FOOTER_BYTES:
        return None
    footer = file.read(file.size - _FOOTER_BYTES, _FOOTER_BYTES)
    expected = mcap.RECORD_HEAD.pack(mcap.FOOTER, mcap.FOOTER_FIELDS.size)
    if not (footer.startswith(expected) and footer.endswith(mcap.MAGIC)):
        return None
    start, _, crc = mcap.FOOTER_FIELDS.unpack_from(footer, mcap.RECORD_HEAD.size)
    if not len(mcap.MAGIC) <= start <= file.size - _FOOTER_BYTES:
        return None
    is_right = crc == file.crc(start, file.size - start - len(mcap.MAGIC) - 4)
    return int(start) if is_right else None


def summary_definitions(file: RecordFile) -> list[bytes]:
    """Return the schemas and channels of a summary that is intact, none of another."""
    start = _summary_start(file)
    if start is None:
        return []
    return walk_records(file.read(start, file.size - _FOOTER_BYTES - start)).definitions


class FinishedData(NamedTuple):
    """Where the data of a finished file ends, and whether its CRC proves every byte of it."""

    end: int
    is_proved: bool


def finished_data(file: RecordFile) -> FinishedData | None:
    """Look at the end of a file; None unless its closing CRCs are right."""
    start = _summary_start(file)
    end = -1 if start is None else start - mcap.RECORD_HEAD.size - 4
    if start is None or end < len(mcap.MAGIC):
        return None
    data_end = file.read(end, start - end)
    crc = int.from_bytes(data_end[-4:], "little")
    if not data_end.startswith(mcap.RECORD_HEAD.pack(mcap.DATA_END, 4)):
        return None
    if crc not in (0, file.crc(0, end)):
        return None
    return FinishedData(end, is_proved=crc != 0)


# A megabyte asked of the system for every chunk costs 256 page faults, a third of the time a
# recovery takes; room that is used again costs none.


class Scratch:
    """Two buffers that grow as needed; what they hold is lost with the next chunk."""

    def __init__(self) -> None:
        """Begin without any room."""
        self._record = bytearray()
        self._unpacked = bytearray()

    def read(self, file: RecordFile, offset: int, size: int) -> memoryview:
        """Read up to ``size`` bytes, fewer only at the end of the file."""
        if len(self._record) < size:
            self._record = bytearray(size)
        room = memoryview(self._record)[:size]
        return room[: file.read_into(offset, room)]

    def unpack(self, frame: memoryview, size: int) -> memoryview | None:
        """Unpack a zstd frame of exactly ``size`` bytes; None when it is something else."""
        if len(self._unpacked) < size:
            self._unpacked = bytearray(size)
        room = memoryview(self._unpacked)[:size]
        reader = zstandard.ZstdDecompressor().stream_reader(frame)
        done = 0
        while done < size:
            count = reader.readinto(room[done:])
            if not count:
                return None
            done += count
        return None if reader.read(1) else room


MAX_CHUNK_BYTES = 1 << 29
"""A chunk or message that claims more, packed or unpacked, is refused: memory is bounded."""

_INDEX_FIELDS = struct.Struct("<HxxxxQ")
"""Channel and log time of a message, after its record head."""
_CHUNK_HEAD_BYTES = RECORD_HEAD.size + CHUNK_FIELDS.size + 4
_COMPRESSIONS = ("", "lz4", "zstd")


class DamagedRecordError(Exception):
    """Bytes are not what they claim to be. Never leaves recovery."""


class Cursor:
    """Takes fields off the front of a record's bytes."""

    def __init__(self, data: bytes, position: int = 0) -> None:
        """Begin at a position."""
        self._data = data
        self.position = position

    def number(self, size: int) -> int:
        """Take an unsigned number of ``size`` bytes."""
        return int.from_bytes(self.data(size), "little")

    def data(self, size: int) -> bytes:
        """Take ``size`` bytes.

        Raises:
            DamagedRecordError: When there are fewer.
        """
        end = self.position + size
        if end > len(self._data):
            message = f"a field of {size} bytes reaches beyond its record"
            raise DamagedRecordError(message)
        found = self._data[self.position : end]
        self.position = end
        return found

    def text(self) -> str:
        """Take a text with its length."""
        try:
            return self.data(self.number(4)).decode()
        except UnicodeDecodeError as error:
            message = "a text is not UTF-8"
            raise DamagedRecordError(message) from error

    def text_map(self) -> dict[str, str]:
        """Take a map of texts with its length."""
        size = self.number(4)
        end = self.position + size
        found = {}
        while self.position < end:
            name = self.text()
            found[name] = self.text()
        if self.position != end:
            message = "a map of texts does not fill its length"
            raise DamagedRecordError(message)
        return found


@dataclass(frozen=True, kw_only=True)
class ChannelFields:
    """What is needed of a channel record."""

    id: int
    schema_id: int
    topic: str


def parse_schema_id(record: bytes) -> int:
    """Return the id of a whole schema record, checked to its end."""
    cursor = Cursor(record, RECORD_HEAD.size)
    schema_id = cursor.number(2)
    cursor.text()
    cursor.text()
    cursor.data(cursor.number(4))
    if schema_id == 0:
        message = "a schema has id 0"
        raise DamagedRecordError(message)
    return schema_id


def parse_channel(record: bytes) -> ChannelFields:
    """Return the fields of a whole channel record, checked to its end."""
    cursor = Cursor(record, RECORD_HEAD.size)
    channel_id, schema_id, topic = cursor.number(2), cursor.number(2), cursor.text()
    cursor.text()
    cursor.text_map()
    return ChannelFields(id=channel_id, schema_id=schema_id, topic=topic)


@dataclass(frozen=True, kw_only=True)
class ChunkHead:
    """What stands before a chunk's data."""

    head_bytes: int
    record_bytes: int
    """Of the whole record, as claimed; a cut chunk has fewer, foxglove's tail claims 2^64."""
    data_bytes: int
    uncompressed_size: int
    crc: int
    compression: str

    @property
    def is_consistent(self) -> bool:
        """Do the two lengths agree and the sizes stay within the limit?"""
        return (
            self.record_bytes == self.head_bytes + self.data_bytes
            and self.data_bytes <= MAX_CHUNK_BYTES
            and self.uncompressed_size <= MAX_CHUNK_BYTES
        )


def parse_chunk_head(front: bytes) -> ChunkHead:
    """Read a chunk's head from the first bytes of its record.

    Raises:
        DamagedRecordError: When they are too few or name an unknown compression.
    """
    if len(front) < _CHUNK_HEAD_BYTES or front[0] != CHUNK:
        message = "no chunk head"
        raise DamagedRecordError(message)
    cursor = Cursor(front, 1)
    length = cursor.number(8)
    _, _, size, crc = CHUNK_FIELDS.unpack(cursor.data(CHUNK_FIELDS.size))
    name_bytes = int.from_bytes(front[cursor.position : cursor.position + 4], "little")
    compression = cursor.text() if name_bytes <= len("zstd") else "?"
    if compression not in _COMPRESSIONS:
        message = f"its compression {compression!r} is not known"
        raise DamagedRecordError(message)
    data_bytes = cursor.number(8)
    return ChunkHead(
        head_bytes=cursor.position,
        record_bytes=RECORD_HEAD.size + length,
        data_bytes=data_bytes,
        uncompressed_size=size,
        crc=crc,
        compression=compression,
    )


@dataclass(kw_only=True)
class Contents:
    """The whole records found from the front of a chunk's data."""

    size: int = 0
    """Bytes they fill."""
    index: dict[int, list[int]] = field(default_factory=dict)
    """By channel: log time and offset of each message, one after the other."""
    definitions: list[bytes] = field(default_factory=list)
    """Schema and channel records."""

    @property
    def num_messages(self) -> int:
        """Messages on all channels."""
        return sum(map(len, self.index.values())) // 2

    def time_range(self) -> tuple[int, int]:
        """First and last log time, zeros without messages [ns]."""
        times = [stamp for entries in self.index.values() for stamp in entries[::2]]
        return (min(times), max(times)) if times else (0, 0)


def walk_records(data: Buffer) -> Contents:
    """Find the records at the front of a chunk's data, up to the first that is cut or wrong."""
    found = Contents()
    position, size, index = 0, len(data), found.index
    while position + RECORD_HEAD.size <= size:
        opcode, length = RECORD_HEAD.unpack_from(data, position)
        end = position + RECORD_HEAD.size + length
        if end > size or opcode == 0:
            break
        if opcode == MESSAGE:
            if length < MESSAGE_FIELDS:
                break
            channel_id, log_time_ns = _INDEX_FIELDS.unpack_from(data, position + RECORD_HEAD.size)
            entries = index.get(channel_id)
            if entries is None:
                entries = index[channel_id] = []
            entries += (log_time_ns, position)
        elif opcode in (SCHEMA, CHANNEL):
            record = bytes(data[position:end])
            try:
                _ = parse_schema_id(record) if opcode == SCHEMA else parse_channel(record)
            except DamagedRecordError:
                break
            found.definitions.append(record)
        position = end
    found.size = position
    return found


def unpack_chunk(head: ChunkHead, data: memoryview, scratch: Scratch) -> Buffer:
    """Return a whole chunk's records.

    Raises:
        DamagedRecordError: When size or CRC are not as claimed.
        MissingDependencyError: When it is packed with lz4 and that is not installed.
    """
    records = _unpack_at_once(head, data, scratch)
    if records is None:
        records = unpack_front(head, bytes(data))
    if len(records) != head.uncompressed_size:
        message = f"its data unpacks to {len(records)} bytes instead of {head.uncompressed_size}"
        raise DamagedRecordError(message)
    if head.crc and crc32(records, 0) != head.crc:
        message = "its CRC is wrong"
        raise DamagedRecordError(message)
    return records


def _unpack_at_once(head: ChunkHead, data: memoryview, scratch: Scratch) -> Buffer | None:
    """Unpack the usual cases quickly: nothing, or one zstd frame that says how much it holds."""
    if head.compression == "":
        return data
    try:
        if (
            head.compression == "zstd"
            and zstandard.frame_content_size(data) == head.uncompressed_size
        ):
            return scratch.unpack(data, head.uncompressed_size)
    except (zstandard.ZstdError, MemoryError):
        pass
    return None


def unpack_front(head: ChunkHead, data: bytes) -> bytes:
    """Return as many records of a chunk as its data, perhaps cut, holds; nothing is verified."""
    if head.compression == "":
        return data
    limit = min(head.uncompressed_size or MAX_CHUNK_BYTES, MAX_CHUNK_BYTES)
    return (_unpack_zstd if head.compression == "zstd" else _unpack_lz4)(data, limit)


def _unpack_zstd(data: bytes, limit: int) -> bytes:
    unpacked = bytearray()
    try:
        with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as reader:
            while len(unpacked) <= limit:
                part = reader.read(min(limit + 1 - len(unpacked), 1 << 22))
                if not part:
                    break
                unpacked += part
    except (zstandard.ZstdError, MemoryError):
        pass  # what came before the damage is still good
    return bytes(unpacked)


def _unpack_lz4(data: bytes, limit: int) -> bytes:
    try:
        import lz4.frame  # noqa: PLC0415 - only other writers' files need it
    except ImportError as error:
        raise MissingDependencyError(
            package="lz4", extra="record", purpose="reading a chunk packed with lz4"
        ) from error
    unpacked = bytearray()
    try:
        reader = lz4.frame.LZ4FrameDecompressor()
        unpacked += reader.decompress(data, max_length=limit + 1)
        while not reader.eof and len(unpacked) <= limit:
            part = reader.decompress(b"", max_length=limit + 1 - len(unpacked))
            if not part:
                break
            unpacked += part
    except (RuntimeError, EOFError, MemoryError):
        pass
    return bytes(unpacked)
