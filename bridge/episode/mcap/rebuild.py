"""Build the summary a file lacks from its data, as other writers may leave it out."""

from mcap import records
from mcap.summary import Summary

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.format import MAGIC, MESSAGE_HEAD
from bridge.episode.mcap.packed import (
    ChunkHead,
    message_head,
    parse_chunk,
    records_in,
    unpack_chunk,
)
from bridge.episode.mcap.walk import (
    BrokenRecordError,
    ByteStream,
    Place,
    attachment_of,
    parse,
    read_body,
    walk,
)


def rebuild_summary(stream: ByteStream, data_end: int) -> Summary:
    """Read the whole data section once; every chunk is unpacked and its CRC checked.

    Raises:
        BrokenRecordError: When a record or chunk is damaged.
    """
    builder = _Builder()
    for place in walk(stream, len(MAGIC), data_end):
        builder.add(stream, place)
    return builder.finish()


def chunk_entry(place: Place, chunk: ChunkHead) -> records.ChunkIndex:
    """Make the index entry of a chunk; its message indexes are yet to be added."""
    return records.ChunkIndex(
        chunk_length=place.end - place.offset,
        chunk_start_offset=place.offset,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_start_time=chunk.start_ns,
        message_end_time=chunk.end_ns,
        message_index_length=0,
        message_index_offsets={},
        uncompressed_size=chunk.size,
    )


def metadata_entry(place: Place, record: records.Metadata) -> records.MetadataIndex:
    """Make the index entry of a metadata record."""
    return records.MetadataIndex(
        offset=place.offset, length=place.end - place.offset, name=record.name
    )


def attachment_entry(
    place: Place, record: records.Attachment, data_size: int
) -> records.AttachmentIndex:
    """Make the index entry of an attachment."""
    return records.AttachmentIndex(
        offset=place.offset,
        length=place.end - place.offset,
        log_time=record.log_time,
        create_time=record.create_time,
        data_size=data_size,
        name=record.name,
        media_type=record.media_type,
    )


class _Builder:
    def __init__(self) -> None:
        self.summary = Summary()
        self._counts: dict[int, int] = {}
        self._start_ns: int | None = None
        self._end_ns = 0
        self._chunk: records.ChunkIndex | None = None

    def add(self, stream: ByteStream, place: Place) -> None:
        """Take one record of the data section."""
        if place.opcode == mcap_format.MESSAGE:
            stream.seek(place.offset)
            head = message_head(stream.read(MESSAGE_HEAD.size), 0, 0)
            self._count(head.channel_id, head.log_time_ns)
        elif place.opcode == mcap_format.CHUNK:
            self._add_chunk(stream, place)
        elif place.opcode == mcap_format.ATTACHMENT:
            self._add_attachment(stream, place)
        elif place.opcode in (
            mcap_format.SCHEMA,
            mcap_format.CHANNEL,
            mcap_format.METADATA,
            mcap_format.MESSAGE_INDEX,
        ):
            self._note(place, parse(place.opcode, read_body(stream, place)))
        if place.opcode not in (mcap_format.CHUNK, mcap_format.MESSAGE_INDEX):
            self._chunk = None

    def _note(self, place: Place, record: records.McapRecord | None) -> None:
        if isinstance(record, records.Metadata):
            self.summary.metadata_indexes.append(metadata_entry(place, record))
        elif isinstance(record, records.MessageIndex) and self._chunk is not None:
            self._chunk.message_index_offsets[record.channel_id] = place.offset
            self._chunk.message_index_length += place.end - place.offset
        else:
            self._define(record)

    def _define(self, record: records.McapRecord | None) -> None:
        if isinstance(record, records.Schema):
            self.summary.schemas[record.id] = record
        elif isinstance(record, records.Channel):
            self.summary.channels[record.id] = record

    def _count(self, channel_id: int, log_time_ns: int) -> None:
        if channel_id not in self.summary.channels:
            message = f"a message is of channel {channel_id}, which was never announced"
            raise BrokenRecordError(message)
        self._counts[channel_id] = self._counts.get(channel_id, 0) + 1
        earliest = log_time_ns if self._start_ns is None else self._start_ns
        self._start_ns = min(earliest, log_time_ns)
        self._end_ns = max(self._end_ns, log_time_ns)

    def _add_chunk(self, stream: ByteStream, place: Place) -> None:
        chunk = parse_chunk(read_body(stream, place))
        data = unpack_chunk(chunk, whose=f"the chunk at byte {place.offset}")
        for opcode, at, length in records_in(data):
            if opcode == mcap_format.MESSAGE:
                head = message_head(data, at, at)
                self._count(head.channel_id, head.log_time_ns)
            else:
                body = at + mcap_format.RECORD_HEAD.size
                self._define(parse(opcode, data[body : body + length]))
        self._chunk = chunk_entry(place, chunk)
        self.summary.chunk_indexes.append(self._chunk)

    def _add_attachment(self, stream: ByteStream, place: Place) -> None:
        found, data_size = attachment_of(stream, place, keep=False)
        self.summary.attachment_indexes.append(attachment_entry(place, found, data_size))

    def finish(self) -> Summary:
        """Return the summary with its statistics."""
        summary = self.summary
        summary.statistics = records.Statistics(
            attachment_count=len(summary.attachment_indexes),
            channel_count=len(summary.channels),
            channel_message_counts=self._counts,
            chunk_count=len(summary.chunk_indexes),
            message_count=sum(self._counts.values()),
            message_start_time=self._start_ns or 0,
            message_end_time=self._end_ns,
            metadata_count=len(summary.metadata_indexes),
            schema_count=len(summary.schemas),
        )
        return summary
