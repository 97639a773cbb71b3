"""Gather what the summary at the end of an MCAP file says, while the file grows."""

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.format import ChunkPlace


class Summary:
    """Schemas, channels, statistics and indexes of one file."""

    def __init__(self) -> None:
        """Begin with an empty file."""
        self.schemas: dict[int, bytes] = {}
        self.channels: dict[int, bytes] = {}
        self.message_counts: dict[int, int] = {}
        self.start_ns: int | None = None
        self.end_ns = 0
        self._chunks: list[bytes] = []
        self._attachments: list[bytes] = []
        self._metadata: list[bytes] = []

    def add_chunk(self, place: ChunkPlace, counts: dict[int, int]) -> None:
        """Book a chunk that is in the file, with its number of messages by channel."""
        self._chunks.append(mcap_format.chunk_index(place))
        if counts:
            self.add_messages(counts, start_ns=place.start_ns, end_ns=place.end_ns)

    def add_messages(self, counts: dict[int, int], *, start_ns: int, end_ns: int) -> None:
        """Book messages by channel, the first and the last log time among them."""
        for channel_id, count in counts.items():
            self.message_counts[channel_id] = self.message_counts.get(channel_id, 0) + count
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = max(self.end_ns, end_ns)

    def add_attachment(
        self,
        name: str,
        *,
        media_type: str,
        log_time_ns: int,
        create_time_ns: int,
        data_size: int,
        offset: int,
        length: int,
    ) -> None:
        """Book an attachment record that is in the file."""
        self._attachments.append(
            mcap_format.attachment_index(
                name,
                media_type=media_type,
                log_time_ns=log_time_ns,
                create_time_ns=create_time_ns,
                data_size=data_size,
                offset=offset,
                length=length,
            )
        )

    def add_metadata(self, name: str, *, offset: int, length: int) -> None:
        """Book a metadata record that is in the file."""
        self._metadata.append(mcap_format.metadata_index(name, offset=offset, length=length))

    def encode(self, start: int) -> bytes:
        """Return everything from the summary to the end of the file.

        Args:
            start: Where it begins in the file, right after the data-end record.
        """
        counts = dict(sorted(self.message_counts.items()))
        statistics = mcap_format.statistics(
            schemas=len(self.schemas),
            channels=len(self.channels),
            attachments=len(self._attachments),
            metadata_records=len(self._metadata),
            chunks=len(self._chunks),
            start_ns=self.start_ns or 0,
            end_ns=self.end_ns,
            message_counts=counts,
        )
        groups = (
            (mcap_format.SCHEMA, b"".join(self.schemas.values())),
            (mcap_format.CHANNEL, b"".join(self.channels.values())),
            (mcap_format.STATISTICS, statistics),
            (mcap_format.CHUNK_INDEX, b"".join(self._chunks)),
            (mcap_format.ATTACHMENT_INDEX, b"".join(self._attachments)),
            (mcap_format.METADATA_INDEX, b"".join(self._metadata)),
        )
        return mcap_format.summary_section(groups, start)
