"""Append records to an MCAP file and book each in the summary, for the writer and for recovery."""

from collections.abc import Mapping

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.checksum import crc32, joined_crc
from bridge.episode.mcap.chunks import EncodedChunk
from bridge.episode.mcap.format import ChunkPlace
from bridge.episode.mcap.part_file import PartFile
from bridge.episode.mcap.summary import Summary


class DataSection:
    """The growing file with its summary. Every method raises OSError and then has done nothing."""

    def __init__(self, file: PartFile) -> None:
        """Take over an open file."""
        self.file = file
        self.summary = Summary()

    def begin(self, profile: str, library: str) -> None:
        """Write magic and header."""
        self.file.append([mcap_format.MAGIC + mcap_format.header(profile, library)])

    def add_chunk(self, chunk: EncodedChunk) -> None:
        """Write a chunk and its message indexes."""
        start = self.file.offset
        indexes, offsets = index_records(chunk.index, start + chunk.length)
        crc = joined_crc(self.file.crc, chunk.crc, chunk.length)
        self.file.append([*chunk.buffers, indexes], crc=crc32(indexes, crc))
        self.book(chunk, start, offsets, len(indexes))

    def add_indexes(self, chunk: EncodedChunk, start: int) -> None:
        """Write the message indexes of a chunk that lies at ``start``, at the end of the file."""
        indexes, offsets = index_records(chunk.index, self.file.offset)
        self.file.append([indexes])
        self.book(chunk, start, offsets, len(indexes))

    def book(
        self, chunk: EncodedChunk, start: int, offsets: dict[int, int], index_length: int
    ) -> None:
        """Tell the summary of a chunk at ``start`` with message indexes at ``offsets``."""
        place = ChunkPlace(
            start_ns=chunk.start_ns,
            end_ns=chunk.end_ns,
            offset=start,
            length=chunk.length,
            index_offsets=offsets,
            index_length=index_length,
            compression=chunk.compression,
            compressed_size=chunk.compressed_size,
            uncompressed_size=chunk.uncompressed_size,
        )
        counts = {channel_id: len(entries) // 2 for channel_id, entries in chunk.index.items()}
        self.summary.add_chunk(place, counts)

    def add_attachment(
        self, name: str, data: bytes, *, media_type: str, log_time_ns: int, create_time_ns: int
    ) -> None:
        """Write an attachment."""
        buffers = mcap_format.attachment(
            name,
            data,
            media_type=media_type,
            log_time_ns=log_time_ns,
            create_time_ns=create_time_ns,
        )
        offset = self.file.offset
        self.file.append(buffers)
        self.summary.add_attachment(
            name,
            media_type=media_type,
            log_time_ns=log_time_ns,
            create_time_ns=create_time_ns,
            data_size=len(data),
            offset=offset,
            length=self.file.offset - offset,
        )

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        offset = self.file.offset
        self.file.append([mcap_format.metadata(name, values)])
        self.summary.add_metadata(name, offset=offset, length=self.file.offset - offset)

    def seal(self) -> None:
        """Write the end of the data, the summary and the footer."""
        data_end = mcap_format.data_end(self.file.crc)
        summary = self.summary.encode(self.file.offset + len(data_end))
        self.file.append([data_end, summary])


def index_records(index: dict[int, list[int]], start: int) -> tuple[bytes, dict[int, int]]:
    """Return a chunk's message index records and where each lies, the first at ``start``."""
    records = [mcap_format.message_index(*item) for item in index.items()]
    offsets = {}
    for channel_id, encoded in zip(index, records, strict=True):
        offsets[channel_id] = start
        start += len(encoded)
    return b"".join(records), offsets
