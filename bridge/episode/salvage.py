"""Carry everything whole from a broken MCAP file into a new one.

Chunks are copied byte for byte, behind the definitions of all of them. Messages outside chunks are
put into chunks, because readers that use the index see nothing else. Message indexes, summary and
footer are made anew.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

from mcap.records import Attachment, Header, Metadata

from bridge.episode.mcap import format as mcap
from bridge.episode.mcap.damaged import RecordFile
from bridge.episode.mcap.data_section import DataSection, EncodedChunk, OpenChunk
from bridge.episode.mcap.format import Buffer
from bridge.episode.mcap.part_file import PartFile
from bridge.episode.mcap.scan import Chunk, Found, Plain, TopMessage, scan
from bridge.episode.mcap.walk import chunk_entry
from bridge.episode.metadata import Derived, EpisodeInfo, Outcome, build, from_strings
from bridge.episode.recovery_report import RecoveryTally

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

    def __init__(self, source: RecordFile, path: Path, tally: RecoveryTally) -> None:
        """Create ``path``, with all definitions; OSError when it exists or cannot be written."""
        self._source = source
        self.section = DataSection(PartFile.create(path))
        self._loose = OpenChunk(compress=False, is_small=True)
        self.section.summary.schemas, self.section.summary.channels = tally.schemas, tally.channels
        header = tally.header or Header("", UNKNOWN_LIBRARY)
        front = [header, *tally.schemas.values(), *tally.channels.values()]
        self.section.file.append([mcap.MAGIC, *map(mcap.encoded, front)])

    def take(self, found: Found) -> None:
        """Copy one thing; definitions, index spans, damage and the old end are left behind."""
        match found:
            case Plain(record=Attachment() as attachment):
                self.section.add_attachment(attachment)
            case Plain(record=Metadata(name=name, metadata=values)):
                kept_as = name if is_readable(name, values) else name + DAMAGED
                self.section.add_metadata(kept_as, values)
            case Plain(record=None):
                self.section.file.append([found.raw])
            case Chunk():
                self.section.add_chunks([verbatim(found)])
            case TopMessage():
                self._take_message(found)

    def finish(self, metadata_name: str, values: dict[str, str]) -> None:
        """Write the rest and sync; the caller verifies, renames and closes."""
        self._flush_loose()
        self.section.add_metadata(metadata_name, values)
        self.section.seal()
        self.section.file.sync_data()

    def _take_message(self, found: TopMessage) -> None:
        if self._loose.size + found.length > CHUNK_BYTES:
            self._flush_loose()
        raw = self._source.read(found.offset, found.length)
        _, _, channel_id, sequence, log_ns, publish_ns = mcap.MESSAGE_HEAD.unpack_from(raw)
        data = memoryview(raw)[mcap.MESSAGE_HEAD.size :]
        self._loose.add(channel_id, sequence, log_ns, publish_ns, data, len(data))

    def _flush_loose(self) -> None:
        if self._loose.has_messages:
            self.section.add_chunks([self._loose.encode()])


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
