"""Yield the messages of one or several MCAP files in log order, holding few chunks at a time.

Chunks may overlap in time. Each is unpacked when its first log time comes up and forgotten after
its last message; one without a wanted topic is never read. Where so many overlap that their data
would pass ``MEMORY_BYTES``, the one needed last is forgotten and unpacked again in its turn.
"""

import heapq
from array import array
from collections.abc import Iterable, Iterator, Sequence, Set
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64, UInt16, UInt64
from mcap import records

from bridge.episode.mcap.file import LooseMessages, McapFile, damaged
from bridge.episode.mcap.format import CHUNK, MESSAGE, MESSAGE_FIELDS, MESSAGE_HEAD, RECORD_HEAD
from bridge.episode.mcap.walk import (
    DAMAGE,
    BrokenRecordError,
    ByteStream,
    MessageHead,
    message_head,
    parse_chunk,
    read_body,
    records_in,
    unpack_chunk,
    walk,
)

NUM_CHANNEL_IDS = 1 << 16


class MessageTable(NamedTuple):
    """The messages of one chunk, in the order in which they lie there."""

    log_times_ns: UInt64[np.ndarray, " num_messages"]
    channel_ids: UInt16[np.ndarray, " num_messages"]
    starts: Int64[np.ndarray, " num_messages"]
    """Where each record begins in the chunk's data."""


def mask_of(channel_ids: Iterable[int]) -> Bool[np.ndarray, " num_channel_ids"]:
    """Return a mask over all channel ids there can be, true at these."""
    mask = np.zeros(NUM_CHANNEL_IDS, dtype=bool)
    mask[list(channel_ids)] = True
    return mask


def _refuse_strays(
    channel_ids: UInt16[np.ndarray, " num_messages"],
    announced: Bool[np.ndarray, " num_channel_ids"],
) -> None:
    """Raise BrokenRecordError when a message is of a channel that was never announced."""
    is_known = announced[channel_ids]
    if not is_known.all():
        channel_id = int(channel_ids[int(np.argmin(is_known))])
        raise BrokenRecordError(f"a message is of channel {channel_id}, which was never announced")


def message_table(data: bytes) -> MessageTable:
    """List the messages in a chunk."""
    times_ns, channel_ids, starts = array("Q"), array("H"), array("q")
    at, end, unpack = 0, len(data), MESSAGE_HEAD.unpack_from
    while at < end:  # nearly all are whole messages, for which this is one step each
        if data[at] == MESSAGE and end - at >= MESSAGE_HEAD.size:
            _, length, channel_id, _, log_time_ns, _ = unpack(data, at)
            if length >= MESSAGE_FIELDS and at + RECORD_HEAD.size + length <= end:
                times_ns.append(log_time_ns)
                channel_ids.append(channel_id)
                starts.append(at)
                at += RECORD_HEAD.size + length
                continue
        at += RECORD_HEAD.size + next(records_in(data, at))[2]
    return MessageTable(
        np.array(times_ns, dtype=np.uint64),
        np.array(channel_ids, dtype=np.uint16),
        np.array(starts, dtype=np.int64),
    )


MEMORY_BYTES = 256 << 20
"""Unpacked chunks held at a time; one chunk may be larger."""
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


class _OpenFile:
    """A file while it is read: opened at its first message, closed after its last."""

    def __init__(self, file: McapFile, number: int, select: Selection) -> None:
        self.file = file
        self.number = number
        self.select = select
        self.wanted_channels = {
            channel_id
            for channel_id, channel in file.summary.channels.items()
            if select.topics is None or channel.topic in select.topics
        }
        self._announced = mask_of(file.summary.channels)
        self._chosen = mask_of(self.wanted_channels)
        self.pending = 0
        self._stream: ByteStream | None = None

    def stream(self) -> ByteStream:
        if self._stream is None:
            self._stream = self.file.path.open("rb")
        return self._stream

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def wanted(
        self,
        log_times_ns: UInt64[np.ndarray, " num_messages"],
        channel_ids: UInt16[np.ndarray, " num_messages"],
    ) -> Bool[np.ndarray, " num_messages"]:
        """Say of each message whether it is wanted; raises BrokenRecordError for a stray one."""
        _refuse_strays(channel_ids, self._announced)
        wanted: Bool[np.ndarray, " num_messages"] = self._chosen[channel_ids]
        if self.select.start_ns is not None:
            wanted &= log_times_ns >= self.select.start_ns
        if self.select.end_ns is not None:
            wanted &= log_times_ns < self.select.end_ns
        return wanted


class _Chunk:
    """One chunk, or messages outside: where it lies and, in its time, what is wanted of it."""

    def __init__(
        self,
        file: _OpenFile,
        place: records.ChunkIndex | LooseMessages,
        *,
        offset: int,
        size: int,
        next_ns: int,
    ) -> None:
        self.file = file
        self.place = place
        self.offset = offset
        self.next_ns = next_ns
        self.size = size
        self.is_done = False
        self._data = b""
        self._wanted: _Wanted | None = None
        self._position = 0

    @property
    def is_loaded(self) -> bool:
        return self._wanted is not None

    def load(self) -> None:
        stream = self.file.stream()
        if isinstance(self.place, LooseMessages):
            stream.seek(self.offset)
            self._data = stream.read(self.size)
            table = message_table(self._data)
        else:
            self._data, table = read_chunk(stream, self.place, self.file.file.data_end)
        self.size = len(self._data)
        self._wanted = _wanted_of(table, self.file)
        self._look_ahead()

    def unload(self) -> None:
        self._data, self._wanted = b"", None

    def _look_ahead(self) -> None:
        times_ns = self._wanted.times_ns if self._wanted else ()
        self.is_done = self._position >= len(times_ns)
        if not self.is_done:
            self.next_ns = int(times_ns[self._position])

    def take_until(self, limit_ns: int, wins_tie: bool) -> Iterator[tuple[MessageHead, bytes]]:
        """Yield messages before the limit, or at it where this chunk comes first."""
        data, wanted, position = self._data, self._wanted or _Wanted(), self._position
        times_ns, places = wanted.times_ns, wanted.places
        while position < len(times_ns):
            time_ns = times_ns[position]
            if time_ns >= limit_ns and (time_ns > limit_ns or not wins_tie):
                break
            at = places[position]
            position += 1
            head = message_head(data, at, at)
            start = at + MESSAGE_HEAD.size
            yield head, data[start : start + head.length]
        self._position = position
        self._look_ahead()


class _Wanted(NamedTuple):
    """Wanted messages of one chunk in log order. 16 bytes each, however many there are."""

    times_ns: array = array("Q")  # type: ignore[type-arg]
    places: array = array("Q")  # type: ignore[type-arg]


def _wanted_of(table: MessageTable, file: _OpenFile) -> _Wanted:
    mask = file.wanted(table.log_times_ns, table.channel_ids)
    times_ns, places = table.log_times_ns[mask], table.starts[mask]
    if (times_ns[1:] < times_ns[:-1]).any():
        order = np.argsort(times_ns, kind="stable")
        times_ns, places = times_ns[order], places[order]
    return _Wanted(array("Q", times_ns.tobytes()), array("Q", places.tobytes()))


def read_chunk(
    stream: ByteStream, index: records.ChunkIndex, data_end: int
) -> tuple[bytes, MessageTable]:
    """Unpack a chunk, its CRC checked, and list its messages."""
    offset = index.chunk_start_offset
    place = next(walk(stream, offset, data_end), None)
    if place is None or place.opcode != CHUNK:
        raise BrokenRecordError(f"the index points at byte {offset}, where no chunk lies")
    chunk = parse_chunk(read_body(stream, place))
    data = unpack_chunk(chunk, whose=f"the chunk at byte {offset}")
    return data, message_table(data)


_Entry = tuple[int, int, int, _Chunk]
"""Log time, number of the file, offset: the order of messages; then where they come from."""


def merged(files: Sequence[McapFile], select: Selection) -> Iterator[Stored]:
    """Yield the wanted messages in order of log time, then of file, then of place in the file."""
    opened = [_OpenFile(file, number, select) for number, file in enumerate(files)]
    heap: list[_Entry] = []
    for file in opened:
        try:
            for source in _sources(file):
                heap.append((source.next_ns, file.number, source.offset, source))
                file.pending += 1
        except DAMAGE as error:
            raise damaged(file.file.path, error) from error
    heapq.heapify(heap)
    try:
        yield from _drained(heap)
    finally:
        for file in opened:
            file.close()


def _sources(file: _OpenFile) -> Iterable[_Chunk]:
    for run in file.file.loose() if file.wanted_channels else ():
        is_wanted = not file.wanted_channels.isdisjoint(run.channel_ids)
        if is_wanted and file.select.overlaps(run.first_ns, run.last_ns):
            size = run.end - run.start
            yield _Chunk(file, run, offset=run.start, size=size, next_ns=run.first_ns)
    for index in file.file.summary.chunk_indexes:
        if not file.select.overlaps(index.message_start_time, index.message_end_time):
            continue
        if may_hold(index, file.wanted_channels):
            yield _Chunk(
                file,
                index,
                offset=index.chunk_start_offset,
                size=index.uncompressed_size,
                next_ns=index.message_start_time,
            )


def may_hold(index: records.ChunkIndex, channel_ids: Set[int]) -> bool:
    """Whether a chunk may hold messages of some channels; one without an index may hold any."""
    listed = index.message_index_offsets
    return not listed or not channel_ids.isdisjoint(listed)


def _drained(heap: list[_Entry]) -> Iterator[Stored]:
    held = _Held()
    while heap:
        *_, source = heapq.heappop(heap)
        file = source.file
        try:
            if source.is_loaded:
                limit = heap[0][:3] if heap else (NEVER, 0, 0)
                wins_tie = (file.number, source.offset) < limit[1:]
                channels = file.file.summary.channels
                for head, data in source.take_until(limit[0], wins_tie):
                    yield Stored(
                        file.file,
                        channels[head.channel_id],
                        head.log_time_ns,
                        head.publish_time_ns,
                        head.sequence,
                        data,
                    )
            else:
                held.load(source)
        except DAMAGE as error:
            raise damaged(file.file.path, error) from error
        if source.is_done:
            held.forget(source)
            file.pending -= 1
            if not file.pending:
                file.close()
        else:
            heapq.heappush(heap, (source.next_ns, file.number, source.offset, source))


class _Held:
    """The chunks whose data is in memory."""

    def __init__(self) -> None:
        self._sources: set[_Chunk] = set()
        self._bytes = 0

    def load(self, source: _Chunk) -> None:
        """Read a chunk, after those needed last made room for it."""
        while self._sources and self._bytes + source.size > MEMORY_BYTES:
            self.forget(max(self._sources, key=lambda held: held.next_ns))
        source.load()
        self._sources.add(source)
        self._bytes += source.size

    def forget(self, source: _Chunk) -> None:
        """Drop a chunk's data; it can be read again."""
        if source in self._sources:
            self._sources.remove(source)
            self._bytes -= source.size
        source.unload()
