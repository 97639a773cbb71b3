"""The data section of an MCAP file being written: records, chunks, and the summary at its end."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import zstandard
from mcap import records

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.format import (
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    Buffer,
    FileSummary,
    crc32,
    encoded,
    num_bytes,
)
from bridge.episode.mcap.part_file import PartFile
from bridge.episode.mcap.walk import attachment_entry

ZSTD_LEVEL = 1
"""Level 3 packs noisy depth 20 % tighter at twice the CPU time (the recorder study, section 2)."""
LARGE_PACKING = zstandard.ZstdCompressionParameters(
    strategy=zstandard.STRATEGY_FAST,
    window_log=19,
    hash_log=11,
    chain_log=11,
    search_log=1,
    min_match=7,
    target_length=0,
    write_content_size=True,
)
"""Level 1 with a hash table that leaves room in the first-level cache: on noisy depth 15 to 25 %
less CPU time for 5 % more bytes (``docs/decisions/0003-mcap-files.md``)."""


Index = dict[int, list[int]]
"""By channel: log time and offset of each message, one after the other."""


@dataclass(frozen=True)
class EncodedChunk:
    """A chunk record ready to be written."""

    buffers: list[Buffer]
    entry: records.ChunkIndex
    """What the summary will say of it; where it lies is known when it is written."""
    index: Index


class OpenChunk:
    """One group's messages in memory. ``size`` counts the bytes, 0 when there are none.

    Payloads stay where they are: their owner must not change them before they are written.
    """

    def __init__(self, *, compress: bool, is_small: bool) -> None:
        """Begin empty; the small messages of many topics share a group."""
        self.size = 0
        self.opened_s = 0.0
        """When the first message came, for the owner to set and read."""
        self.number = 0
        """Of this chunk among those of its group."""
        self.is_small = is_small
        self._compressor: zstandard.ZstdCompressor | None = None
        if compress:
            about = {"level": ZSTD_LEVEL} if is_small else {"compression_params": LARGE_PACKING}
            self._compressor = zstandard.ZstdCompressor(**about)
        self._clear()

    def _clear(self) -> None:
        self.size = 0
        self._pieces: list[Buffer] = []
        self._index: Index = {}
        self._start_ns = 0
        self._end_ns = 0

    @property
    def has_messages(self) -> bool:
        """False when empty, or when it holds definitions only."""
        return bool(self._index)

    def define(self, records: bytes) -> None:
        """Append schema and channel records, before the first message that needs them."""
        self.size += len(records)
        self._pieces.append(records)

    def add(
        self,
        channel_id: int,
        sequence: int,
        log_time_ns: int,
        publish_time_ns: int,
        data: Buffer,
        length: int,
    ) -> None:
        """Append one message whose payload has ``length`` bytes.

        Raises:
            struct.error: When a number does not fit its field; nothing is appended then.
        """
        head = MESSAGE_HEAD.pack(
            MESSAGE, MESSAGE_FIELDS + length, channel_id, sequence, log_time_ns, publish_time_ns
        )
        entries = self._index.get(channel_id)
        if entries is None:
            entries = self._index[channel_id] = []
            if len(self._index) == 1:
                self._start_ns = self._end_ns = log_time_ns
        entries += (log_time_ns, self.size)
        if log_time_ns > self._end_ns:
            self._end_ns = log_time_ns
        elif log_time_ns < self._start_ns:
            self._start_ns = log_time_ns
        self.size += len(head) + length
        self._pieces += (head, data)

    def encode(self) -> EncodedChunk:
        """Return the messages as a chunk record and begin anew."""
        data, compression, crc = self._pieces, "", 0
        if self.is_small or self._compressor is not None:  # many pieces cost more than a copy
            data = [b"".join(data)]
        for piece in data:
            crc = crc32(piece, crc)
        if self._compressor is not None:
            packed = self._compressor.compress(data[0])
            if len(packed) < self.size:
                data, compression = [packed], "zstd"
        entry = records.ChunkIndex(
            chunk_length=0,
            chunk_start_offset=0,
            compression=compression,
            compressed_size=sum(map(num_bytes, data)),
            message_end_time=self._end_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=self._start_ns,
            uncompressed_size=self.size,
        )
        head = mcap_format.chunk_head(entry, crc)
        entry.chunk_length = len(head) + entry.compressed_size
        made = EncodedChunk([head, *data], entry, self._index)
        self._clear()
        self.number += 1
        return made


class DataSection:
    """The growing file with its summary. Every method raises OSError and then has done nothing."""

    def __init__(self, file: PartFile) -> None:
        """Take over an open file."""
        self.file = file
        self.summary = FileSummary()

    def add_chunks(self, chunks: Sequence[EncodedChunk]) -> None:
        """Write chunks, each with its message indexes, all or none."""
        start = self.file.offset
        buffers: list[Buffer] = []
        for chunk in chunks:
            entry = chunk.entry
            entry.chunk_start_offset, indexes = start, b""
            start += entry.chunk_length
            for channel_id, entries in chunk.index.items():
                entry.message_index_offsets[channel_id] = start + len(indexes)
                indexes += mcap_format.message_index(channel_id, entries)
            entry.message_index_length = len(indexes)
            start += len(indexes)
            buffers += [*chunk.buffers, indexes]
        self.file.append(buffers)
        for chunk in chunks:
            entry = chunk.entry
            counts = {number: len(entries) // 2 for number, entries in chunk.index.items()}
            self.summary.chunk_indexes.append(entry)
            self.summary.add_messages(counts, entry.message_start_time, entry.message_end_time)

    def add_attachment(self, entry: records.Attachment) -> None:
        """Write an attachment."""
        offset = self.file.offset
        self.file.append([encoded(entry)])
        length = self.file.offset - offset
        self.summary.attachment_indexes.append(attachment_entry(offset, length, entry))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        offset, entry = self.file.offset, records.Metadata(name, dict(values))
        self.file.append([encoded(entry)])
        self.summary.metadata_indexes.append(
            records.MetadataIndex(offset, self.file.offset - offset, name)
        )

    def seal(self) -> None:
        """Write the end of the data, the summary and the footer."""
        data_end = encoded(records.DataEnd(self.file.crc))
        self.file.append([data_end, self.summary.encode(self.file.offset + len(data_end))])
