"""Finish a broken MCAP file where it lies, for a disk without room for a copy.

Only the end of the file is touched: what is whole stays, the torn rest is cut off, and the closing
part is written. Killed at any moment, it can be done again.
"""

from bridge.episode.mcap import format as mcap
from bridge.episode.mcap.data_section import DataSection
from bridge.episode.mcap.found import (
    AttachmentSpan,
    Chunk,
    CutChunk,
    Damage,
    DataEnd,
    Found,
    IndexSpan,
    Plain,
    TopMessage,
)
from bridge.episode.mcap.parse import Contents, Cursor, parse_channel, parse_schema_id
from bridge.episode.mcap.part_file import PartFile
from bridge.episode.mcap.record_file import RecordFile
from bridge.episode.recover_copy import salvaged, salvaged_head, verbatim


class NeedsCopyError(Exception):
    """The damage is not at the end only. Never leaves recovery."""


class InPlaceTarget:
    """The same file. ``take`` everything first; nothing is written before ``finish``."""

    def __init__(self, source: RecordFile, part: PartFile) -> None:
        """Book into ``part``, which is the source itself opened for writing."""
        self._source = source
        self.section = DataSection(part)
        self._end = 0
        self._chunk: Chunk | None = None
        self._indexes: list[IndexSpan] = []
        self._cut: CutChunk | None = None

    def take(self, found: Found) -> None:
        """Book one thing.

        Raises:
            NeedsCopyError: For damage with something whole after it, and for definitions that
                were lost with it.
        """
        match found:
            case IndexSpan():
                self._indexes.append(found)
            case Damage():
                if not found.at_end:
                    raise NeedsCopyError
            case CutChunk() if found.head.compression == "":
                self._define(found.contents)
                self._cut = found
            case CutChunk() | DataEnd():
                pass
            case _:
                self._close_chunk()
                self._take_whole(found)
                self._end = found.end

    def _take_whole(self, found: Chunk | Plain | TopMessage | AttachmentSpan) -> None:
        summary = self.section.summary
        match found:
            case Chunk():
                self._define(found.contents)
                self._chunk = found
            case Plain() if found.opcode == mcap.METADATA:
                name = Cursor(found.raw, mcap.RECORD_HEAD.size).text()
                summary.add_metadata(name, offset=found.offset, length=found.length)
            case Plain() if found.opcode in (mcap.SCHEMA, mcap.CHANNEL):
                self._book(found.raw)
            case TopMessage():
                self._require(found.channel_id)
                stamp_ns = found.log_time_ns
                summary.add_messages({found.channel_id: 1}, start_ns=stamp_ns, end_ns=stamp_ns)
            case AttachmentSpan():
                summary.add_attachment(
                    found.name,
                    media_type=found.media_type,
                    log_time_ns=found.log_time_ns,
                    create_time_ns=found.create_time_ns,
                    data_size=found.data_size,
                    offset=found.offset,
                    length=found.length,
                )

    def _book(self, raw: bytes) -> None:
        summary = self.section.summary
        if raw[0] == mcap.SCHEMA:
            summary.schemas.setdefault(parse_schema_id(raw), raw)
            return
        channel = parse_channel(raw)
        if channel.schema_id and channel.schema_id not in summary.schemas:
            raise NeedsCopyError
        summary.channels.setdefault(channel.id, raw)

    def _define(self, contents: Contents) -> None:
        for raw in contents.definitions:
            self._book(raw)
        for channel_id in contents.index:
            self._require(channel_id)

    def _require(self, channel_id: int) -> None:
        if channel_id not in self.section.summary.channels:
            raise NeedsCopyError

    def _close_chunk(self) -> None:
        """Tell the summary of a chunk, and of its message indexes if all of them are right."""
        chunk, self._chunk = self._chunk, None
        indexes, self._indexes = self._indexes, []
        if chunk is None:
            return
        offsets = {}
        for span in indexes:
            raw = self._source.read(span.offset, span.length)
            for channel_id, entries in chunk.contents.index.items():
                if raw == mcap.message_index(channel_id, entries):
                    offsets[channel_id] = span.offset
        right = offsets.keys() == chunk.contents.index.keys()
        index_length = indexes[-1].end - chunk.end if indexes and right else 0
        encoded = verbatim(chunk)
        self.section.book(encoded, chunk.offset, offsets if right else {}, index_length)

    def finish(self, metadata_name: str, values: dict[str, str]) -> PartFile:
        """Cut off what is torn, write the rest and sync.

        Raises:
            OSError: When there is no room even for that; what was whole still is.
        """
        file = self.section.file
        if self._cut is not None:
            self._close_chunk()
            self._end = self._cut.offset
            head = salvaged_head(self._cut.records, self._cut.contents)
            file.overwrite(self._cut.offset, head)
            self._end += len(head) + len(self._cut.records)
        file.truncate(self._end, self._source.crc(0, self._end))
        if self._cut is not None:
            self.section.add_indexes(
                salvaged(self._cut.records, self._cut.contents), self._cut.offset
            )
        elif self._chunk is not None:
            self.section.add_indexes(verbatim(self._chunk), self._chunk.offset)
        self.section.add_metadata(metadata_name, values)
        self.section.seal()
        file.sync_data()
        return file
