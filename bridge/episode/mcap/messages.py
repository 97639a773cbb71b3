"""Yield the messages of one or several MCAP files in log order, chunk by chunk.

Chunks may overlap in time. Each is unpacked when its first log time comes up and forgotten after
its last message; one without a wanted topic is never read.
"""

import heapq
from collections.abc import Iterator, Sequence, Set
from typing import NamedTuple

from mcap import records

from bridge.episode.mcap.file import McapFile, damaged
from bridge.episode.mcap.format import CHUNK, MESSAGE, MESSAGE_HEAD
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
    try:
        with file.path.open("rb") as stream:
            yield from _in_order(_Open(file, stream, select))
    except DAMAGE as error:
        raise damaged(file.path, error) from error


class _Open(NamedTuple):
    """A file while it is read."""

    file: McapFile
    stream: ByteStream
    select: Selection

    def wanted_channels(self) -> set[int]:
        topics, channels = self.select.topics, self.file.summary.channels.values()
        return {item.id for item in channels if topics is None or item.topic in topics}

    def is_wanted(self, channel_id: int, log_ns: int, wanted: Set[int]) -> bool:
        """Whether a message is wanted; raises BrokenRecordError for one of no channel."""
        if channel_id not in self.file.summary.channels:
            message = f"a message is of channel {channel_id}, which was never announced"
            raise BrokenRecordError(message)
        return channel_id in wanted and self.select.overlaps(log_ns, log_ns)


class _Loaded(NamedTuple):
    """The wanted messages of a chunk, or of what lies outside chunks."""

    data: bytes | None
    """The chunk's; None: each message is read from the file in its turn."""
    places: list[tuple[int, int]]
    """Log time of each message and where its record begins, the last one first."""


def _in_order(opened: _Open) -> Iterator[Stored]:
    queue = _sources(opened)
    heapq.heapify(queue)
    while queue:
        _, offset, source = heapq.heappop(queue)
        if isinstance(source, records.ChunkIndex):
            source = _load(opened, source)
        else:
            limit = queue[0][:2] if queue else (NEVER, 0)
            while source.places and (source.places[-1][0], offset) < limit:
                yield _stored(opened, source.data, source.places.pop()[1])
        if source.places:
            heapq.heappush(queue, (source.places[-1][0], offset, source))


def _sources(opened: _Open) -> list[tuple[int, int, records.ChunkIndex | _Loaded]]:
    """List where wanted messages lie: when the first comes up, and at which place in the file."""
    wanted = opened.wanted_channels()
    found: list[tuple[int, int, records.ChunkIndex | _Loaded]] = []
    for index in opened.file.summary.chunk_indexes:
        listed = index.message_index_offsets  # a chunk without an index may hold any channel
        if (not listed or wanted & listed.keys()) and opened.select.overlaps(
            index.message_start_time, index.message_end_time
        ):
            found.append((index.message_start_time, index.chunk_start_offset, index))
    loose = [
        (item.log_time_ns, item.at)
        for item in (opened.file.loose() if wanted else ())
        if opened.is_wanted(item.channel_id, item.log_time_ns, wanted)
    ]
    if loose:
        loose.sort(reverse=True)
        found.append((*loose[-1], _Loaded(None, loose)))
    return found


def _load(opened: _Open, index: records.ChunkIndex) -> _Loaded:
    """Unpack a chunk, its CRC checked, and list what is wanted of it."""
    offset, wanted, places = index.chunk_start_offset, opened.wanted_channels(), []
    chunk = parse_chunk(read_body(opened.stream, opened.file.indexed(opened.stream, offset, CHUNK)))
    data = unpack_chunk(chunk, whose=f"the chunk at byte {offset}")
    for opcode, at, _ in records_in(data):
        if opcode == MESSAGE:
            head = message_head(data, at, at)
            if opened.is_wanted(head.channel_id, head.log_time_ns, wanted):
                places.append((head.log_time_ns, at))
    places.sort(reverse=True)
    return _Loaded(data, places)


def _stored(opened: _Open, data: bytes | None, at: int) -> Stored:
    if data is None:
        opened.stream.seek(at)
        front, start = opened.stream.read(MESSAGE_HEAD.size), 0
        head = message_head(front, 0, at)
        payload = opened.stream.read(head.length)
    else:
        head, start = message_head(data, at, at), at + MESSAGE_HEAD.size
        payload = data[start : start + head.length]
    channel = opened.file.summary.channels[head.channel_id]
    return Stored(
        opened.file, channel, head.log_time_ns, head.publish_time_ns, head.sequence, payload
    )
