"""Chunks being filled: messages of one group, until the group is written as one MCAP record."""

from dataclasses import dataclass

import zstandard

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.checksum import crc32, joined_crc
from bridge.episode.mcap.format import MESSAGE, MESSAGE_FIELDS, MESSAGE_HEAD, Buffer, Payload

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
less CPU time for 5 % more bytes (``docs/decisions/0011-own-chunk-writer.md``)."""


@dataclass(frozen=True, kw_only=True)
class EncodedChunk:
    """A chunk record ready to be written."""

    buffers: list[Buffer]
    length: int
    crc: int
    """CRC-32 of the whole record."""
    start_ns: int
    end_ns: int
    compression: str
    compressed_size: int
    uncompressed_size: int
    index: dict[int, list[int]]
    """By channel: log time and offset of each message, one after the other."""


class OpenChunk:
    """One group's messages in memory. ``size`` counts the bytes, 0 when there are none.

    Groups of small messages are gathered in one buffer, because thousands of pieces cost more than
    the copy. Large payloads stay where they are: their owner must not change them before they are
    written.
    """

    def __init__(self, *, compress: bool, gather: bool) -> None:
        """Begin empty. ``gather`` is for small messages."""
        self.size = 0
        self.opened_s = 0.0
        """When the first message came, for the owner to set and read."""
        self._compressor = _compressor(gather=gather) if compress else None
        self._gather = gather
        self._clear()

    def _clear(self) -> None:
        self.size = 0
        self._buffer = bytearray()
        self._pieces: list[Buffer] = []
        self._index: dict[int, list[int]] = {}
        self._start_ns = 0
        self._end_ns = 0

    @property
    def has_messages(self) -> bool:
        """False when empty, or when it holds definitions only."""
        return bool(self._index)

    def define(self, records: bytes) -> None:
        """Append schema and channel records, before the first message that needs them."""
        self.size += len(records)
        if self._gather:
            self._buffer += records
        else:
            self._pieces.append(records)

    def add(
        self,
        channel_id: int,
        sequence: int,
        log_time_ns: int,
        publish_time_ns: int,
        data: Payload,
        length: int,
    ) -> None:
        """Append one message whose payload has ``length`` bytes.

        Raises:
            struct.error: When a number does not fit its field; nothing is appended then.
        """
        head = MESSAGE_HEAD.pack(
            MESSAGE,
            MESSAGE_FIELDS + length,
            channel_id,
            sequence,
            log_time_ns,
            publish_time_ns,
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
        if self._gather:
            self._buffer += head
            if isinstance(data, Buffer):
                self._buffer += data
            else:
                for piece in data:
                    self._buffer += piece
        else:
            self._pieces.append(head)
            if isinstance(data, Buffer):
                self._pieces.append(data)
            else:
                self._pieces.extend(data)

    def encode(self) -> EncodedChunk:
        """Return the messages as a chunk record and begin anew."""
        pieces: list[Buffer] = [self._buffer] if self._gather else self._pieces
        crc = 0
        for piece in pieces:
            crc = crc32(piece, crc)
        data, data_crc, compression = pieces, crc, ""
        if self._compressor is not None:
            packed = self._compressor.compress(pieces[0] if self._gather else b"".join(pieces))
            if len(packed) < self.size:
                data, data_crc, compression = [packed], crc32(packed, 0), "zstd"
        data_size = len(data[0]) if compression else self.size
        head = mcap_format.chunk_head(
            start_ns=self._start_ns,
            end_ns=self._end_ns,
            size=self.size,
            crc=crc,
            compression=compression,
            data_size=data_size,
        )
        encoded = EncodedChunk(
            buffers=[head, *data],
            length=len(head) + data_size,
            crc=joined_crc(crc32(head, 0), data_crc, data_size),
            start_ns=self._start_ns,
            end_ns=self._end_ns,
            compression=compression,
            compressed_size=data_size,
            uncompressed_size=self.size,
            index=self._index,
        )
        self._clear()
        return encoded


def _compressor(*, gather: bool) -> zstandard.ZstdCompressor:
    if gather:
        return zstandard.ZstdCompressor(level=ZSTD_LEVEL, write_content_size=True)
    return zstandard.ZstdCompressor(compression_params=LARGE_PACKING)
