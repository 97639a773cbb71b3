"""What a walk through an MCAP file can find, and where."""

from dataclasses import dataclass
from typing import TypeAlias

from bridge.episode.mcap.parse import ChunkHead, Contents


@dataclass(frozen=True, kw_only=True)
class Span:
    """Where a record lies."""

    offset: int
    length: int

    @property
    def end(self) -> int:
        """The first byte after it."""
        return self.offset + self.length


@dataclass(frozen=True, kw_only=True)
class Plain(Span):
    """A header, schema, channel, metadata or private record, whole."""

    opcode: int
    raw: bytes


@dataclass(frozen=True, kw_only=True)
class Chunk(Span):
    """A chunk whose CRC and structure are right."""

    raw: memoryview
    """The whole record, until the walk goes on."""
    head: ChunkHead
    contents: Contents


@dataclass(frozen=True, kw_only=True)
class CutChunk(Span):
    """The last chunk of a file that ends inside it, with the whole messages found in it.

    ``length`` goes to the end of the file. Nothing verified the messages but their structure.
    """

    head: ChunkHead
    records: bytes
    unpacked_size: int
    """Bytes that could be unpacked, the torn message at their end included."""
    contents: Contents


@dataclass(frozen=True, kw_only=True)
class TopMessage(Span):
    """A message outside chunks."""

    channel_id: int
    log_time_ns: int


@dataclass(frozen=True, kw_only=True)
class AttachmentSpan(Span):
    """An attachment whose CRC is right."""

    name: str
    media_type: str
    log_time_ns: int
    create_time_ns: int
    data_size: int


@dataclass(frozen=True, kw_only=True)
class IndexSpan(Span):
    """A message index, not looked into."""


@dataclass(frozen=True, kw_only=True)
class Damage(Span):
    """Bytes that were stepped over, or the cut end of the file."""

    what: str
    at_end: bool = False


@dataclass(frozen=True, kw_only=True)
class DataEnd(Span):
    """The writer got as far as the summary."""

    crc: int


Found: TypeAlias = (
    Plain | Chunk | CutChunk | TopMessage | AttachmentSpan | IndexSpan | Damage | DataEnd
)
