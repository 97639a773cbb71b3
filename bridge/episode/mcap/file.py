"""One finished MCAP file: its summary, its metadata, and where its messages lie."""

from collections import deque
from collections.abc import Iterator
from pathlib import Path

from mcap import records
from mcap.summary import Summary

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.damaged import RecordFile
from bridge.episode.mcap.data_walk import DataWalk
from bridge.episode.mcap.walk import (
    BrokenRecordError,
    ByteStream,
    RecordSpan,
    attachment_of,
    parse,
    read_body,
    read_footer,
    read_header,
    read_summary,
    walk,
)
from bridge.errors import EpisodeError


def rebuild_summary(stream: ByteStream, data_end: int) -> Summary:
    """Read the whole data section once; every chunk is unpacked and its CRC checked."""
    found = DataWalk(RecordFile(stream, data_end), fault=_refuse, doubt=lambda text: None)
    deque(found.messages(), maxlen=0)
    found.seen.sum_up()
    return found.seen


def _refuse(text: str) -> None:
    raise BrokenRecordError(text)


def damaged(path: Path, error: BaseException) -> EpisodeError:
    """Make one message of what reading a file's bytes raised."""
    return EpisodeError(
        path=path,
        found=f"damaged ({type(error).__name__}: {str(error)[:120]})",
        hint="Run robot-gst check on it; robot-gst recover keeps what is readable.",
    )


class McapFile:
    """What a reader must know of one file before it reads messages."""

    def __init__(self, path: Path) -> None:
        """Read header, summary and metadata. A summary that is left out is built from the data."""
        self.path = path
        with path.open("rb") as stream:
            self.header = read_header(stream)
            self.footer, self._footer_at = read_footer(stream)
            self.data_end = self.footer.summary_start or self._footer_at
            summary = read_summary(stream, self.footer, self._footer_at)
            if summary is None or not _is_complete(summary):
                summary = rebuild_summary(stream, self.data_end)
            self.summary = summary
            self.metadata: list[records.Metadata] = []
            for entry in summary.metadata_indexes:
                place = self.indexed(stream, entry.offset, mcap_format.METADATA)
                self.metadata.append(parse(place.opcode, read_body(stream, place)))  # type: ignore[arg-type]

    def indexed(self, stream: ByteStream, offset: int, opcode: int) -> RecordSpan:
        """Return the place of the record an index points at."""
        place = next(walk(stream, offset, self.data_end), None)
        if place is None or place.opcode != opcode:
            kind = "chunk" if opcode == mcap_format.CHUNK else "such record"
            raise BrokenRecordError(f"the index points at byte {offset}, where no {kind} lies")
        return place

    def attachments(self, name: str | None = None) -> Iterator[records.Attachment]:
        """Yield attachments, all or those of one name; each is held in memory."""
        with self.path.open("rb") as stream:
            for entry in self.summary.attachment_indexes:
                if name in (None, entry.name):
                    place = self.indexed(stream, entry.offset, mcap_format.ATTACHMENT)
                    yield attachment_of(read_body(stream, place), place.offset)

    def schema_of(self, channel: records.Channel) -> records.Schema | None:
        """Return the schema of a channel, or None where it has none."""
        return self.summary.schemas.get(channel.schema_id)


def _is_complete(summary: Summary) -> bool:
    """Whether the summary repeats and indexes everything its statistics count."""
    counts = summary.statistics
    if counts is None:
        return False
    known = {channel.schema_id for channel in summary.channels.values()} - {0}
    return (
        len(summary.chunk_indexes) == counts.chunk_count
        and len(summary.attachment_indexes) == counts.attachment_count
        and len(summary.metadata_indexes) == counts.metadata_count
        and len(summary.channels) >= counts.channel_count
        and set(counts.channel_message_counts) <= set(summary.channels)
        and known <= set(summary.schemas)
    )
