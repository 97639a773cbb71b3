"""Carry everything whole from a broken MCAP file into a new one.

Chunks are copied byte for byte. Messages outside chunks are put into chunks, because readers that
use the index see nothing else. Message indexes, summary and footer are made anew.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Header, Metadata, Schema

from bridge.episode.mcap import format as mcap
from bridge.episode.mcap.damaged import (
    Contents,
    RecordFile,
    read_plain,
    summary_definitions,
)
from bridge.episode.mcap.data_section import DataSection, EncodedChunk, OpenChunk
from bridge.episode.mcap.format import Buffer
from bridge.episode.mcap.part_file import PartFile
from bridge.episode.mcap.scan import Chunk, Found, Plain, TopMessage, scan
from bridge.episode.mcap.walk import chunk_entry
from bridge.episode.metadata import Derived, EpisodeInfo, Outcome, build, from_strings
from bridge.episode.recovery_report import unknown_topic

CHUNK_BYTES = 1 << 20
UNKNOWN_LIBRARY = "unknown; recovered by robot-gst"
"""Of a file whose header was lost: its messages are held to no promise of ours."""


def each_chunk_once(source: RecordFile) -> Iterator[Found]:
    """Return what a file holds; a chunk that lies there twice is given once."""
    there: set[tuple[int, int]] = set()
    for found in scan(source):
        if isinstance(found, Chunk) and found.packed.uncompressed_crc:
            key = found.packed.uncompressed_crc, found.packed.uncompressed_size
            if key in there:
                continue
            there.add(key)
        yield found


_RECORDS: dict[str, type] = {"episode": EpisodeInfo, "outcome": Outcome, "derived": Derived}
DAMAGED = ".damaged"
"""Behind the name of a metadata record of ours that cannot be read; no CRC covers those."""


def is_readable(name: str, values: dict[str, str]) -> bool:
    """Whether a metadata record, if it is one of ours, holds what it should."""
    if name not in _RECORDS:
        return True
    try:
        build(_RECORDS[name], from_strings(values))
    except ValueError:
        return False
    return True


class CopyTarget:
    """The new file."""

    def __init__(self, source: RecordFile, path: Path) -> None:
        """Create ``path``; OSError when it exists or cannot be written."""
        self._source = source
        self.section = DataSection(PartFile.create(path))
        self._loose = OpenChunk(compress=False, is_small=True)
        self._made_schemas: set[int] = set()
        self._made_channels: set[int] = set()
        self.looked_up: list[bytes] = []
        """Definitions that were lost where they were needed, and found elsewhere."""
        self._elsewhere: dict[tuple[int, int], bytes] | None = None

    def take(self, found: Found) -> None:
        """Copy one thing; index spans, damage and the old end are left behind."""
        if self.section.file.offset == 0:
            is_header = isinstance(found, Plain) and found.opcode == mcap.HEADER
            header = found.raw if is_header else mcap.encoded(Header("", UNKNOWN_LIBRARY))  # type: ignore[union-attr]
            self.section.file.append([mcap.MAGIC + header])
        match found:
            case Plain():
                self._take_plain(found)
            case Chunk():
                self._define(found.contents)
                self.section.add_chunks([verbatim(found)])
            case TopMessage():
                self._take_message(found)

    def finish(self, metadata_name: str, values: dict[str, str]) -> PartFile:
        """Write the rest and sync; the caller verifies, renames and closes."""
        self._flush_loose()
        self.section.add_metadata(metadata_name, values)
        self.section.seal()
        self.section.file.sync_data()
        return self.section.file

    def _take_plain(self, found: Plain) -> None:
        if found.opcode in (mcap.HEADER, mcap.DATA_END):
            return
        if isinstance(found.record, Attachment):
            self.section.add_attachment(found.record)
            return
        if isinstance(found.record, Metadata):
            name, values = found.record.name, found.record.metadata
            self.section.add_metadata(name if is_readable(name, values) else name + DAMAGED, values)
            return
        if found.opcode in (mcap.SCHEMA, mcap.CHANNEL):
            if self._contradicts(found.raw):
                return
            self._book(found.raw)
        self.section.file.append([found.raw])

    def _contradicts(self, raw: bytes) -> bool:
        """Whether a definition is not the one that its id had before."""
        summary, record = self.section.summary, read_plain(raw)
        if isinstance(record, Schema):
            return summary.schemas.get(record.id, record) != record
        return isinstance(record, Channel) and summary.channels.get(record.id, record) != record

    def _book(self, raw: bytes) -> None:
        """Tell the summary of a definition; the first one of an id counts."""
        summary, record = self.section.summary, read_plain(raw)
        if isinstance(record, Schema):
            _define_once(summary.schemas, self._made_schemas, record)
        elif isinstance(record, Channel):
            _define_once(summary.channels, self._made_channels, record)
            schema_id = record.schema_id
            if schema_id and schema_id not in summary.schemas:
                if self._look_up(mcap.SCHEMA, schema_id):
                    return
                self._make(mcap.encoded(Schema(schema_id, b"", "", "unknown")))
                self._made_schemas.add(schema_id)

    def _look_up(self, opcode: int, number: int) -> bool:
        """Define what was lost here and stands in the summary or in another chunk."""
        if self._elsewhere is None:
            self._elsewhere = _definitions(self._source)
        raw = self._elsewhere.get((opcode, number))
        if raw is None:
            return False
        self.looked_up.append(raw)
        self._make(raw)
        return True

    def _make(self, raw: bytes) -> None:
        """Define a schema or channel whose own definition was lost; readers refuse without."""
        self._book(raw)
        self.section.file.append([raw])

    def _define(self, contents: Contents) -> None:
        for raw in contents.definitions:
            self._book(raw)
        for channel_id in contents.index:
            self._require_channel(channel_id)

    def _require_channel(self, channel_id: int) -> None:
        if channel_id in self.section.summary.channels:
            return
        if not self._look_up(mcap.CHANNEL, channel_id):
            self._make(mcap.encoded(Channel(channel_id, unknown_topic(channel_id), "", {}, 0)))
            self._made_channels.add(channel_id)

    def _take_message(self, found: TopMessage) -> None:
        self._require_channel(found.channel_id)
        if self._loose.size + found.length > CHUNK_BYTES:
            self._flush_loose()
        raw = self._source.read(found.offset, found.length)
        _, _, channel_id, sequence, log_ns, publish_ns = mcap.MESSAGE_HEAD.unpack_from(raw)
        data = memoryview(raw)[mcap.MESSAGE_HEAD.size :]
        self._loose.add(channel_id, sequence, log_ns, publish_ns, data, len(data))

    def _flush_loose(self) -> None:
        if self._loose.has_messages:
            self.section.add_chunks([self._loose.encode()])


def _definitions(source: RecordFile) -> dict[tuple[int, int], bytes]:
    """Return every schema and channel of a file by kind and id: of its summary, or of its data."""
    records = summary_definitions(source)
    if not records:
        for found in scan(source):
            if isinstance(found, Chunk):
                records += found.contents.definitions
            elif isinstance(found, Plain) and found.opcode in (mcap.SCHEMA, mcap.CHANNEL):
                records.append(found.raw)
    definitions: dict[tuple[int, int], bytes] = {}
    for raw in records:
        definitions.setdefault((raw[0], _id_of(raw)), raw)
    return definitions


def _id_of(raw: bytes) -> int:
    """Return the number of a schema or channel."""
    record = read_plain(raw)
    return record.id if isinstance(record, Schema | Channel) else 0


def _define_once(known: dict[int, Any], made: set[int], record: Schema | Channel) -> None:
    if record.id not in known or record.id in made:
        made.discard(record.id)
        known[record.id] = record


_TIMES = struct.Struct("<QQ")


def has_wrong_times(found: Chunk) -> bool:
    """Whether a chunk's head states other times than its messages; no CRC covers them."""
    return _TIMES.unpack_from(found.raw, mcap.RECORD_HEAD.size) != found.contents.time_range()


def verbatim(found: Chunk) -> EncodedChunk:
    """Return a chunk as it stands in the file, with the times of its messages in its head."""
    start_ns, end_ns = found.contents.time_range()
    at = mcap.RECORD_HEAD.size
    buffers: list[Buffer] = [found.raw]
    if has_wrong_times(found):
        front = bytes(found.raw[:at]) + _TIMES.pack(start_ns, end_ns)
        buffers = [front, memoryview(found.raw)[len(front) :]]
    entry = chunk_entry(0, found.length, found.packed)
    entry.message_start_time, entry.message_end_time = start_ns, end_ns
    return EncodedChunk(buffers, entry, found.contents.index)
