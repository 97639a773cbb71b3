"""Write one episode: ``<name>.mcap.part`` while open, renamed when complete.

Nothing half-written ever carries the final name; a crash leaves the ``.part`` file, which
``recover`` reads. ``docs/decisions/0003-mcap-files.md`` says why the chunks are our own.
"""

import contextlib
import json
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap import records

from bridge.episode import metadata, provenance, schema
from bridge.episode.chunk_queue import ChunkQueue
from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.data_section import DataSection, EncodedChunk, OpenChunk
from bridge.episode.mcap.format import Buffer, FileSummary, num_bytes
from bridge.episode.mcap.part_file import BackgroundSync, cannot_write, open_part


@dataclass(slots=True)
class Channel:
    """One topic with one schema, and the chunk its messages go to."""

    id: int
    type_name: str
    definition: bytes
    group: OpenChunk | None = None
    is_large: bool = False
    next_sequence: int = 0
    defined_in: int = -1
    """Number of the last chunk of its group that holds its definition."""


About = tuple[tuple[str, str], ...]


class Channels:
    """Finds or makes the channel of a message, and tells the summary of new ones.

    A topic whose schema changes its text, not only its name, gets a second channel.
    """

    def __init__(self, summary: FileSummary) -> None:
        """Begin without channels."""
        self._summary = summary
        self._schemas: dict[schema.Schema, tuple[int, bytes]] = {}
        self._channels: dict[tuple[str, schema.Schema | None, str, About], Channel] = {}

    def find(
        self, topic: str, record: schema.Schema | None, message_encoding: str, about: About = ()
    ) -> Channel:
        """Return the channel of a topic."""
        encoding = message_encoding if record is None else record.message_encoding
        key = (topic, record, encoding, about)
        channel = self._channels.get(key)
        if channel is None:
            channel_id = len(self._channels) + 1
            schema_id, definition = (0, b"") if record is None else self._schema(record)
            entry = records.Channel(channel_id, topic, encoding, dict(about), schema_id)
            self._summary.channels[channel_id] = entry
            definition += mcap_format.encoded(entry)
            channel = Channel(channel_id, "" if record is None else record.name, definition)
            self._channels[key] = channel
        return channel

    def _schema(self, record: schema.Schema) -> tuple[int, bytes]:
        if record not in self._schemas:
            schema_id = len(self._schemas) + 1
            entry = records.Schema(schema_id, record.data, record.schema_encoding, record.name)
            encoded = mcap_format.encoded(entry)
            self._schemas[record] = (schema_id, encoded)
            self._summary.schemas[schema_id] = entry
        return self._schemas[record]


# A reader of one small topic must not unpack images, and bytes that are packed already (JPEG,
# PNG, H.264) cost CPU time without getting smaller. So each large stream has chunks of its own
# and all small topics share theirs (the recorder study, sections 1.1 and 1.6).

LARGE_BYTES = 1 << 16
"""A topic with a message of this size counts as a large stream from then on."""

_LARGE_TYPES = frozenset(
    {
        schema.IMAGE,
        schema.COMPRESSED_IMAGE,
        "foxglove.CompressedImage",
        "foxglove.CompressedVideo",
        "foxglove.RawImage",
    }
)
_PACKED_TYPES = frozenset(
    {schema.COMPRESSED_IMAGE, "foxglove.CompressedImage", "foxglove.CompressedVideo"}
)
_DEPTH_ENCODINGS = (b"16UC1\0", b"mono16\0", b"32FC1\0")
_HEAD_BYTES = 512
"""An encoding's name stands near the front of an image message."""


def is_worth_compressing(type_name: str, front: bytes) -> bool:
    """Judge a stream by its type and the front of its first message: zstd for depth and unknown.

    Raw colour is left as it is: zstd takes a quarter off it for more CPU time than JPEG.
    """
    if type_name in _PACKED_TYPES:
        return b"compressedDepth rvl" in front
    if type_name == schema.IMAGE:
        return any(encoding in front for encoding in _DEPTH_ENCODINGS)
    return True


PROFILE = "ros2"
LIBRARY = "robot-gst"


@dataclass(frozen=True, kw_only=True)
class WriterConfig:
    """How an episode reaches the disk."""

    chunk_bytes: int = 1 << 17
    """A chunk is written before it grows beyond this many bytes; one damaged bit costs a chunk."""
    flush_s: float | None = None
    """A live writer's ``tick`` writes messages older than this [s]; None fills chunks first."""
    sync_s: float | None = None
    """Force data to the disk this often, in a thread [s]; None only at the end."""
    backlog_bytes: int = 16 << 20
    """Of a live writer: so much may wait for the disk before a call does."""
    compress: bool = True
    """Pack depth and small topics with zstd level 1."""


class EpisodeWriter:
    """Append messages to a new episode file. For one thread.

    Topics start with a slash. ``log_time_ns`` is when the message was received,
    ``publish_time_ns`` when its source made it. The caller must not change a payload afterwards.

    Every call may raise OSError for a disk that is full or broken, also on behalf of an earlier
    call; a live writer says it with ``tick``, and takes messages while it has room. The message of
    the failed call is not taken, everything before is kept: in the file up to its last whole
    record, and in memory. When there is space again, calls and ``close`` succeed and nothing is
    lost. After a failed background sync nothing succeeds any more, for the disk may hold holes:
    ``abandon`` and ``recover`` what is there.
    """

    def __init__(
        self,
        path: Path,
        *,
        config: WriterConfig = WriterConfig(),
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create ``<path>.part``, locked; refuses to replace an existing episode.

        A writer without ``flush_s`` makes what can be made again, and replaces the ``.part`` of a
        dead one. A live writer refuses: such a part is for ``recover``.

        Raises:
            UsageError: When the episode exists, or is being written, or waits to be recovered.
        """
        self.path = path
        self.part_path = path.with_name(path.name + ".part")
        self.config = config
        self._monotonic = monotonic
        self._file = open_part(path, replace_dead=config.flush_s is None)
        self._section = DataSection(self._file)
        header = mcap_format.encoded(records.Header(PROFILE, LIBRARY))
        try:
            self._file.append([mcap_format.MAGIC + header])
        except OSError as error:
            self.part_path.unlink(missing_ok=True)
            self._file.close()
            raise cannot_write(self.part_path, error) from error
        self._channels = Channels(self._section.summary)
        self._small = OpenChunk(compress=config.compress, is_small=True)
        self._groups = [self._small]
        self._pending: deque[EncodedChunk] = deque()
        self._queue: ChunkQueue | None = None
        if config.flush_s is not None:
            self._queue = ChunkQueue(self._section, monotonic=monotonic)
        self._sync = BackgroundSync(self._file, config.sync_s) if config.sync_s else None
        self._open = True

    @property
    def backlog_bytes(self) -> int:
        """Bytes of large messages that wait for the disk."""
        return 0 if self._queue is None else self._queue.bulk_bytes

    @property
    def lag_s(self) -> float:
        """How long the oldest small message has been waiting to be on a disk [s]."""
        since_s = None if self._queue is None else self._queue.oldest_s()
        if since_s is None and self._small.has_messages:
            since_s = self._small.opened_s
        return 0.0 if since_s is None else max(0.0, self._monotonic() - since_s)

    @property
    def busy_s(self) -> float:
        """How long the disk has been at the write under way [s]."""
        return 0.0 if self._queue is None else self._queue.busy_s()

    def write(
        self,
        topic: str,
        data: Buffer | Mapping[str, Any],
        *,
        type_name: str = "",
        schema_record: schema.Schema | None = None,
        message_encoding: str = "",
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int | None = None,
        about: About = (),
    ) -> None:
        """Append one serialised message, or a record as JSON, of a type this project knows.

        Of other types the schema is given, or none; the bytes are kept as they are. Without a time
        it was sent when it was logged; without a number it counts on.
        """
        if type_name:
            schema_record = schema.schema_for(type_name)
            if schema_record is None:
                raise ValueError(f"no schema for {type_name!r}; give the schema of other types")
        if not isinstance(data, Buffer):
            data = json.dumps(data, separators=(",", ":")).encode()
        channel = self._channels.find(topic, schema_record, message_encoding, about)
        length = num_bytes(data)
        if self._pending or self._file.failed:
            self.wait_for_disk()
        group = channel.group
        if group is None or (length >= LARGE_BYTES and not channel.is_large):
            group = self._assign_group(channel, data, length)
        if group.size + length > self.config.chunk_bytes and group.has_messages:
            self._flush(group)
        if self.config.flush_s is not None and not group.has_messages:
            group.opened_s = self._monotonic()
        if channel.defined_in != group.number:  # every chunk can be read by itself
            group.define(channel.definition)
            channel.defined_in = group.number
        if sequence is None:
            sequence = channel.next_sequence
        group.add(
            channel.id,
            sequence & 0xFFFF_FFFF,
            log_time_ns,
            log_time_ns if publish_time_ns is None else publish_time_ns,
            data,
            length,
        )
        channel.next_sequence = sequence + 1

    def _assign_group(self, channel: Channel, data: Buffer, length: int) -> OpenChunk:
        group = self._small
        if channel.type_name in _LARGE_TYPES or length >= LARGE_BYTES:
            if channel.group is not None:  # keeps the topic's order in the file
                self._flush(channel.group)
            head = bytes(memoryview(data).cast("B")[:_HEAD_BYTES])
            compress = self.config.compress and is_worth_compressing(channel.type_name, head)
            group = OpenChunk(compress=compress, is_small=False)
            self._groups.append(group)
            channel.is_large = True
        channel.group = group
        channel.defined_in = -1
        return group

    def _flush(self, group: OpenChunk) -> None:
        if self._queue is None:
            if group.has_messages:
                self._pending.append(group.encode())
            self.wait_for_disk()
            return
        if group.has_messages:
            self._queue.wait_for_room(group.size, 2 * self.config.backlog_bytes)
            since_s = group.opened_s
            self._queue.add(group.encode(), is_small=group.is_small, since_s=since_s)

    def _refuse_failed(self) -> None:
        """Raise what the disk said on behalf of an earlier call."""
        failed = self._file.failed
        if failed:
            raise OSError(failed.errno, failed.strerror, str(self.part_path)) from failed
        if self._queue is not None:
            self._queue.raise_error()

    def wait_for_disk(self) -> None:
        """Return when every chunk that was closed is in the file; those the disk refuses stay."""
        self._refuse_failed()
        if self._queue is not None:
            self._queue.drain()
        while self._pending:
            self._section.add_chunks([self._pending[0]])
            self._pending.popleft()

    def attach(self, name: str, data: bytes, *, media_type: str, log_time_ns: int) -> None:
        """Add an attachment, for example ``robot.urdf``; it is in the file at once."""
        self.wait_for_disk()
        self._section.add_attachment(
            records.Attachment(log_time_ns, log_time_ns, name, media_type, data)
        )

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record of plain strings; it is in the file at once."""
        self.wait_for_disk()
        self._section.add_metadata(name, values)

    def describe(
        self,
        info: metadata.EpisodeInfo,
        *,
        outcome: metadata.Outcome | None = None,
        derived: metadata.Derived | None = None,
    ) -> None:
        """Add the ``episode`` and ``software`` records, and the others where given."""
        self.add_metadata("episode", metadata.to_strings(info))
        self.add_metadata("software", provenance.software())
        for name, record in (("outcome", outcome), ("derived", derived)):
            if record is not None:
                self.add_metadata(name, metadata.to_strings(record))

    def tick(self) -> None:
        """Write the chunks that have been waiting for ``flush_s``; call it often."""
        if self.config.flush_s is None or self._queue is None:
            self.wait_for_disk()
            return
        self._refuse_failed()
        before_s = self._monotonic() - self.config.flush_s
        for group in self._groups:
            if group.has_messages and group.opened_s <= before_s:
                self._flush(group)

    def refuse_removed(self) -> None:
        """Raise OSError where somebody removed or replaced the file."""
        self._file.refuse_removed()

    def close(self) -> Path:
        """Finish, sync to disk and give the file its final name."""
        if not self._open:
            return self.path
        for group in self._groups:
            self._flush(group)
        self.wait_for_disk()
        offset, crc = self._file.offset, self._file.crc
        self._section.seal()
        try:
            self._file.publish(self.path)
        except OSError:
            self._file.truncate(offset, crc)
            raise
        self._stop()
        return self.path

    def abandon(self) -> None:
        """Stop without finishing; the ``.part`` file stays for recovery."""
        if self._open:
            if self._queue is not None:
                with contextlib.suppress(OSError):  # what the disk still takes of what waits for it
                    self.wait_for_disk()
            self._stop()

    def discard(self) -> None:
        """Stop and remove the ``.part`` file: the take was not wanted."""
        if self._open:
            self.part_path.unlink(missing_ok=True)
            self._stop()

    def _stop(self) -> None:
        self._open = False
        if self._queue is not None:
            self._queue.end()
        if self._sync is not None:
            self._sync.stop()
        self._file.close()

    def __enter__(self) -> "EpisodeWriter":
        """Use as a context manager: closes on success, abandons on an exception."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close, or leave the ``.part`` file when an exception is passing through."""
        try:
            if error is None:
                self.close()
        finally:
            self.abandon()
