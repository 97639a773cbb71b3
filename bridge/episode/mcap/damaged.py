"""Read pieces of an MCAP file that may be cut or damaged, and keep what is whole of them."""

import os
import struct
from dataclasses import dataclass, field

from mcap.records import McapRecord, Schema

from bridge.episode.mcap import format as mcap
from bridge.episode.mcap.format import CHANNEL, MESSAGE, RECORD_HEAD, SCHEMA, Buffer, crc32
from bridge.episode.mcap.walk import BrokenRecordError, ByteStream, parse, read_footer, records_in

BLOCK_BYTES = 1 << 20


class RecordFile:
    """Reads pieces of an open file."""

    def __init__(self, stream: ByteStream, size: int | None = None) -> None:
        """Use a stream that stays its owner's; with ``size`` only so many of its first bytes."""
        self.stream = stream
        self.size = stream.seek(0, os.SEEK_END) if size is None else size

    def read(self, offset: int, size: int) -> bytes:
        """Return up to ``size`` bytes, fewer only at the end of the file."""
        self.stream.seek(offset)
        return self.stream.read(max(0, min(size, self.size - offset)))

    def crc(self, offset: int, size: int) -> int:
        """CRC-32 of a range."""
        crc, end = 0, min(offset + size, self.size)
        for start in range(offset, end, BLOCK_BYTES):
            crc = crc32(self.read(start, min(BLOCK_BYTES, end - start)), crc)
        return crc


def _summary_places(file: RecordFile) -> tuple[int, int] | None:
    """Return where summary and footer of a file begin, None unless the summary's CRC is right."""
    try:
        footer, at = read_footer(file.stream)
    except BrokenRecordError:
        return None
    start, behind_crc = footer.summary_start, len(mcap.MAGIC) + 4
    is_intact = footer.summary_crc == file.crc(start, file.size - start - behind_crc)
    return (start, at) if is_intact and start >= len(mcap.MAGIC) else None


def summary_definitions(file: RecordFile) -> list[McapRecord | None]:
    """Return the schemas and channels of a summary that is intact, none of another."""
    places = _summary_places(file)
    try:
        data = file.read(places[0], places[1] - places[0]) if places else b""
        return walk_records(data).definitions
    except BrokenRecordError:
        return []


def finished_data(file: RecordFile) -> tuple[int, bool] | None:
    """Return where a file's data ends, and whether its CRC proves every byte of it.

    None unless the closing CRCs are right.
    """
    places = _summary_places(file)
    head = mcap.RECORD_HEAD.pack(mcap.DATA_END, 4)
    end = places[0] - len(head) - 4 if places else -1
    if end < len(mcap.MAGIC) or file.read(end, len(head)) != head:
        return None
    crc = int.from_bytes(file.read(end + len(head), 4), "little")
    return (end, crc != 0) if crc in (0, file.crc(0, end)) else None


_INDEX_FIELDS = struct.Struct("<HxxxxQ")
"""Channel and log time of a message, after its record head."""


def read_plain(record: bytes) -> McapRecord | None:
    """Return a whole header, schema, channel or metadata record, checked to its end."""
    found = parse(record[0], record[RECORD_HEAD.size :])
    if isinstance(found, Schema) and found.id == 0:
        raise BrokenRecordError("a schema has id 0")
    return found


@dataclass(kw_only=True)
class Contents:
    """What lies in a chunk."""

    index: dict[int, list[int]] = field(default_factory=dict)
    """By channel: log time and offset of each message, one after the other."""
    definitions: list[McapRecord | None] = field(default_factory=list)
    """Schemas and channels."""

    def time_range(self) -> tuple[int, int]:
        """First and last log time, zeros without messages [ns]."""
        times = [stamp for entries in self.index.values() for stamp in entries[::2]]
        return (min(times), max(times)) if times else (0, 0)


def walk_records(data: Buffer) -> Contents:
    """Find the records in a chunk's data, or a summary; raises where one is cut or wrong."""
    found = Contents()
    index = found.index
    for opcode, at, length in records_in(data):
        if opcode == MESSAGE:
            channel_id, log_time_ns = _INDEX_FIELDS.unpack_from(data, at + RECORD_HEAD.size)
            entries = index.get(channel_id)
            if entries is None:
                entries = index[channel_id] = []
            entries += (log_time_ns, at)
        elif opcode in (SCHEMA, CHANNEL):
            end = at + RECORD_HEAD.size + length
            found.definitions.append(read_plain(bytes(data[at:end])))
    return found
