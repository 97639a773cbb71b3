"""Yield the messages of one or several MCAP files in log order, chunk by chunk.

Chunks may overlap in time. Each is unpacked when its first log time comes up and forgotten after
its last message; one without a wanted topic is never read.
"""

import heapq
import mmap
from collections.abc import Iterator, Sequence, Set
from typing import NamedTuple

from mcap import records

from bridge.episode.mcap.file import McapFile, damaged
from bridge.episode.mcap.format import CHUNK, MAGIC, MESSAGE, MESSAGE_HEAD, Buffer
from bridge.episode.mcap.walk import (
    DAMAGE,
    BrokenRecordError,
    ByteStream,
    message_head,
    parse_chunk,
    read_body,
    records_in,
    unpack_chunk,
)

NEVER = 1 << 64


class Stored(NamedTuple):
    """One message as it lies in a file."""

    file: McapFile
    channel: records.Channel
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


class Selection(NamedTuple):
    """Which messages are wanted."""

    topics: frozenset[str] | None = None
    """None for all."""
    start_ns: int | None = None
    end_ns: int | None = None

    def overlaps(self, start_ns: int, end_ns: int) -> bool:
        """Whether a stretch of time, ends included, holds a wanted one."""
        return (self.start_ns is None or end_ns >= self.start_ns) and (
            self.end_ns is None or start_ns < self.end_ns
        )


def merged(files: Sequence[McapFile], select: Selection) -> Iterator[Stored]:
    """Yield the wanted messages in order of log time, then of file, then of place in the file."""
    yield from heapq.merge(
        *(_messages_of(file, select) for file in files), key=lambda item: item.log_time_ns
    )


def _messages_of(file: McapFile, select: Selection) -> Iterator[Stored]:
    topics, channels = select.topics, file.summary.channels.values()
    wanted = {item.id for item in channels if topics is None or item.topic in topics}
    try:
        with file.path.open("rb") as stream:
            yield from _in_order(_Open(file, stream, select, wanted))
    except DAMAGE as error:
        raise damaged(file.path, error) from error


class _Open(NamedTuple):
    """A file while it is read."""

    file: McapFile
    stream: ByteStream
    select: Selection
    wanted: Set[int]
    """Channels."""

    def is_wanted(self, channel_id: int, log_ns: int) -> bool:
        """Whether a message is wanted; raises BrokenRecordError for one of no channel."""
        if channel_id not in self.file.summary.channels:
            message = f"a message is of channel {channel_id}, which was never announced"
            raise BrokenRecordError(message)
        return channel_id in self.wanted and self.select.overlaps(log_ns, log_ns)


class _Loaded(NamedTuple):
    """The wanted messages of a chunk, or of a file without chunks."""

    data: Buffer
    places: list[tuple[int, int]]
    """Log time of each message and where its record begins, the last one first."""


def _in_order(opened: _Open) -> Iterator[Stored]:
    queue: list[tuple[int, int, records.ChunkIndex | _Loaded]] = []
    for index in opened.file.summary.chunk_indexes:
        listed = index.message_index_offsets  # a chunk without an index may hold any channel
        if (not listed or opened.wanted & listed.keys()) and opened.select.overlaps(
            index.message_start_time, index.message_end_time
        ):
            queue.append((index.message_start_time, index.chunk_start_offset, index))
    heapq.heapify(queue)
    if not opened.file.summary.chunk_indexes and opened.wanted:
        queue.append((0, 0, _without_chunks(opened)))
    while queue:
        _, offset, source = heapq.heappop(queue)
        if isinstance(source, records.ChunkIndex):
            source = _unpacked(opened, source)
        else:
            limit = queue[0][:2] if queue else (NEVER, 0)
            while source.places and (source.places[-1][0], offset) < limit:
                yield _stored(opened, source.data, source.places.pop()[1])
        if source.places:
            heapq.heappush(queue, (source.places[-1][0], offset, source))


def _unpacked(opened: _Open, index: records.ChunkIndex) -> _Loaded:
    """Unpack a chunk, its CRC checked, and list what is wanted of it."""
    offset = index.chunk_start_offset
    chunk = parse_chunk(read_body(opened.stream, opened.file.indexed(opened.stream, offset, CHUNK)))
    return _loaded(opened, unpack_chunk(chunk, whose=f"the chunk at byte {offset}"), 0)


def _without_chunks(opened: _Open) -> _Loaded:
    """Look at the data of a file without chunks as at one chunk, and leave it on the disk."""
    data = mmap.mmap(opened.stream.fileno(), opened.file.data_end, access=mmap.ACCESS_READ)
    return _loaded(opened, memoryview(data), len(MAGIC))


def _loaded(opened: _Open, data: Buffer, start: int) -> _Loaded:
    places = []
    for opcode, at, _ in records_in(data, start):
        if opcode == MESSAGE:
            head = message_head(data, at)
            if opened.is_wanted(head.channel_id, head.log_time_ns):
                places.append((head.log_time_ns, at))
    places.sort(reverse=True)
    return _Loaded(data, places)


def _stored(opened: _Open, data: Buffer, at: int) -> Stored:
    head, start = message_head(data, at), at + MESSAGE_HEAD.size
    return Stored(
        opened.file,
        opened.file.summary.channels[head.channel_id],
        head.log_time_ns,
        head.publish_time_ns,
        head.sequence,
        bytes(data[start : start + head.length]),
    )
