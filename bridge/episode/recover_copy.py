"""Carry everything whole from a broken MCAP file into a new one.

Chunks are copied byte for byte. Messages outside chunks are put into chunks, because readers that
use the index see nothing else. Message indexes, summary and footer are made anew.
"""

from pathlib import Path

from bridge.episode.mcap import format as mcap
from bridge.episode.mcap.checksum import crc32
from bridge.episode.mcap.chunks import EncodedChunk, OpenChunk
from bridge.episode.mcap.data_section import DataSection
from bridge.episode.mcap.found import (
    AttachmentSpan,
    Chunk,
    CutChunk,
    Found,
    Plain,
    TopMessage,
)
from bridge.episode.mcap.parse import Contents, Cursor, parse_channel, parse_schema_id
from bridge.episode.mcap.part_file import PartFile
from bridge.episode.mcap.record_file import RecordFile
from bridge.episode.recover_tally import unknown_topic

CHUNK_BYTES = 1 << 20
LIBRARY = "robot-gst recover"


class CopyTarget:
    """The new file."""

    def __init__(self, source: RecordFile, path: Path) -> None:
        """Create ``path``; OSError when it exists or cannot be written."""
        self._source = source
        self.section = DataSection(PartFile.create(path))
        self._loose = OpenChunk(compress=False, gather=True)
        self._made_schemas: set[int] = set()
        self._made_channels: set[int] = set()

    def take(self, found: Found) -> None:
        """Copy one thing; index spans, damage and the old end are left behind."""
        if self.section.file.offset == 0:
            is_header = isinstance(found, Plain) and found.opcode == mcap.HEADER
            header = found.raw if is_header else mcap.header("", LIBRARY)  # type: ignore[union-attr]
            self.section.file.append([mcap.MAGIC + header])
        match found:
            case Plain():
                self._take_plain(found)
            case Chunk():
                self._define(found.contents)
                self.section.add_chunk(verbatim(found))
            case CutChunk():
                self._define(found.contents)
                self.section.add_chunk(salvaged(found.records, found.contents))
            case TopMessage():
                self._take_message(found)
            case AttachmentSpan():
                self._take_attachment(found)
            case _:
                pass

    def finish(self, metadata_name: str, values: dict[str, str]) -> PartFile:
        """Write the rest and sync; the caller verifies, renames and closes."""
        self._flush_loose()
        self.section.add_metadata(metadata_name, values)
        self.section.seal()
        self.section.file.sync_data()
        return self.section.file

    def _take_plain(self, found: Plain) -> None:
        if found.opcode == mcap.HEADER:
            return
        if found.opcode in (mcap.SCHEMA, mcap.CHANNEL):
            self._book(found.raw)
        offset = self.section.file.offset
        self.section.file.append([found.raw])
        if found.opcode == mcap.METADATA:
            name = Cursor(found.raw, mcap.RECORD_HEAD.size).text()
            self.section.summary.add_metadata(name, offset=offset, length=found.length)

    def _book(self, raw: bytes) -> None:
        """Tell the summary of a definition; the first one of an id counts."""
        summary = self.section.summary
        if raw[0] == mcap.SCHEMA:
            _define_once(summary.schemas, self._made_schemas, parse_schema_id(raw), raw)
            return
        channel = parse_channel(raw)
        _define_once(summary.channels, self._made_channels, channel.id, raw)
        if channel.schema_id and channel.schema_id not in summary.schemas:
            self._make(mcap.schema(channel.schema_id, "unknown", "", b""))
            self._made_schemas.add(channel.schema_id)

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
        if channel_id not in self.section.summary.channels:
            self._make(mcap.channel(channel_id, 0, unknown_topic(channel_id), ""))
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
            self.section.add_chunk(self._loose.encode())

    def _take_attachment(self, found: AttachmentSpan) -> None:
        offset = self.section.file.offset
        for block in self._source.blocks(found.offset, found.length):
            self.section.file.append([block])
        self.section.summary.add_attachment(
            found.name,
            media_type=found.media_type,
            log_time_ns=found.log_time_ns,
            create_time_ns=found.create_time_ns,
            data_size=found.data_size,
            offset=offset,
            length=found.length,
        )


def _define_once(known: dict[int, bytes], made: set[int], number: int, raw: bytes) -> None:
    if number not in known or number in made:
        made.discard(number)
        known[number] = raw


def verbatim(found: Chunk) -> EncodedChunk:
    """Return a chunk as it stands in the file."""
    start_ns, end_ns = found.contents.time_range()
    return EncodedChunk(
        buffers=[found.raw],
        length=found.length,
        crc=crc32(found.raw, 0),
        start_ns=start_ns,
        end_ns=end_ns,
        compression=found.head.compression,
        compressed_size=found.head.data_bytes,
        uncompressed_size=found.head.uncompressed_size,
        index=found.contents.index,
    )


def salvaged_head(records: bytes, contents: Contents) -> bytes:
    """Return the head of an unpacked chunk with the records that were saved from a cut one."""
    start_ns, end_ns = contents.time_range()
    return mcap.chunk_head(
        start_ns=start_ns,
        end_ns=end_ns,
        size=len(records),
        crc=crc32(records, 0),
        compression="",
        data_size=len(records),
    )


def salvaged(records: bytes, contents: Contents) -> EncodedChunk:
    """Return the records saved from a cut chunk as a whole one."""
    head = salvaged_head(records, contents)
    start_ns, end_ns = contents.time_range()
    return EncodedChunk(
        buffers=[head, records],
        length=len(head) + len(records),
        crc=crc32(records, crc32(head, 0)),
        start_ns=start_ns,
        end_ns=end_ns,
        compression="",
        compressed_size=len(records),
        uncompressed_size=len(records),
        index=contents.index,
    )
