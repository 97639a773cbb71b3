"""Read one episode: metadata, topics, raw messages; ``streams`` decodes them."""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import zstandard
from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader
from mcap.summary import Summary

from bridge.episode import metadata, schema
from bridge.errors import EpisodeError, PathNotFoundError, SchemaVersionError

DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    EOFError,
    KeyError,
    IndexError,
    OverflowError,
    OSError,
    MemoryError,  # a damaged length asks for terabytes
    RuntimeError,  # lz4's own
)
"""What the ``mcap`` package raises on bytes that are not what they claim to be."""

Record = TypeVar("Record", metadata.EpisodeInfo, metadata.Outcome, metadata.Derived)


@dataclass(frozen=True, kw_only=True)
class RawMessage:
    """One message as stored."""

    topic: str
    type_name: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True, kw_only=True)
class TopicSummary:
    """What a topic holds."""

    topic: str
    type_name: str
    message_encoding: str
    count: int


class Episode:
    """An opened, finished episode file. Cheap to make: only the summary is read."""

    def __init__(self, path: Path, summary: Summary, records: dict[str, dict[str, Any]]) -> None:
        """Use ``Episode.open``."""
        self.path = path
        self._summary = summary
        self._records = records

    @staticmethod
    def open(path: Path) -> "Episode":
        """Open a finished MCAP file.

        Raises:
            PathNotFoundError: When the file is not there.
            EpisodeError: When it is no MCAP file, or was never finished.
            SchemaVersionError: When it was written by a newer major version.
        """
        if not path.is_file():
            raise PathNotFoundError(path=path, what="episode", hint="robot-gst ls RUN lists them.")
        try:
            with path.open("rb") as stream:
                reader = make_reader(stream)
                summary = reader.get_summary()
                records = {
                    record.name: metadata.from_strings(record.metadata)
                    for record in reader.iter_metadata()
                }
        except DAMAGE as error:
            raise EpisodeError(
                path=path,
                found=f"not a finished MCAP file ({type(error).__name__}: {str(error)[:120]})",
                hint="If a recorder was killed while writing it, its readable part is still there.",
            ) from error
        if summary is None:
            raise EpisodeError(
                path=path, found="no summary section", hint="The writer did not finish the file."
            )
        found = records.get("episode", {}).get("schema_version", metadata.SCHEMA_VERSION)
        if isinstance(found, int) and found > metadata.SCHEMA_VERSION:
            raise SchemaVersionError(
                path=path, name="episode metadata", found=found, known=metadata.SCHEMA_VERSION
            )
        return Episode(path, summary, records)

    @property
    def info(self) -> metadata.EpisodeInfo:
        """Who, what and when; a foreign MCAP file counts as imported."""
        found = self._metadata("episode", metadata.EpisodeInfo)
        return found or metadata.EpisodeInfo(id=self.path.stem, kind="imported")

    @property
    def outcome(self) -> metadata.Outcome | None:
        """What the operator said at the end, if anything."""
        return self._metadata("outcome", metadata.Outcome)

    @property
    def derived(self) -> metadata.Derived | None:
        """What this episode was made from, or None for a recorded one."""
        return self._metadata("derived", metadata.Derived)

    def _metadata(self, name: str, of_type: type[Record]) -> Record | None:
        if name not in self._records:
            return None
        try:
            return metadata.build(of_type, self._records[name])
        except (TypeError, ValueError) as error:
            raise EpisodeError(
                path=self.path,
                found=f"its metadata record {name!r} cannot be read ({error})",
                hint="docs/episode_format.md lists the fields; another program wrote them.",
            ) from error

    @property
    def metadata_records(self) -> dict[str, dict[str, Any]]:
        """All metadata records by name, values parsed where they are JSON."""
        return self._records

    @property
    def start_ns(self) -> int:
        """First log time, 0 without messages."""
        return self._summary.statistics.message_start_time if self._summary.statistics else 0

    @property
    def end_ns(self) -> int:
        """Last log time, 0 without messages."""
        return self._summary.statistics.message_end_time if self._summary.statistics else 0

    @property
    def duration_s(self) -> float:
        """Seconds between the first and the last log time."""
        return (self.end_ns - self.start_ns) * 1e-9

    def topics(self) -> dict[str, TopicSummary]:
        """Return every topic with its type and number of messages."""
        statistics = self._summary.statistics
        counts = statistics.channel_message_counts if statistics else {}
        topics: dict[str, TopicSummary] = {}
        for channel in self._summary.channels.values():
            record = self._summary.schemas.get(channel.schema_id)
            before = topics.get(channel.topic)
            topics[channel.topic] = TopicSummary(
                topic=channel.topic,
                type_name=record.name if record else "",
                message_encoding=channel.message_encoding,
                count=counts.get(channel.id, 0) + (before.count if before else 0),
            )
        return dict(sorted(topics.items()))

    def topics_of_type(self, type_name: str) -> list[str]:
        """Topics that carry one message type; stand-in truth is never among them."""
        return [
            topic
            for topic, summary in self.topics().items()
            if summary.type_name == type_name and not schema.is_truth(topic)
        ]

    def messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[RawMessage]:
        """Yield messages in log order with CRCs checked, optionally of some topics only.

        ``start_ns`` (included) and ``end_ns`` (excluded) bound the log time.
        """
        wanted = None if topics is None else list(topics)
        if wanted == []:
            return
        try:
            with self.path.open("rb") as stream:
                reader: McapReader = make_reader(stream, validate_crcs=True)
                for record, channel, message in reader.iter_messages(
                    topics=wanted, starting_at=start_ns, ending_before=end_ns
                ):
                    yield RawMessage(
                        topic=channel.topic,
                        type_name=record.name if record else "",
                        log_time_ns=message.log_time,
                        publish_time_ns=message.publish_time,
                        sequence=message.sequence,
                        data=message.data,
                    )
        except DAMAGE as error:
            raise self._damaged(error) from error

    def _damaged(self, error: BaseException) -> EpisodeError:
        return EpisodeError(
            path=self.path,
            found=f"damaged ({type(error).__name__}: {str(error)[:120]})",
            hint="Run robot-gst check on it.",
        )

    def attachment(self, name: str) -> bytes | None:
        """Return the bytes of an attachment, or None."""
        try:
            with self.path.open("rb") as stream:
                for item in make_reader(stream).iter_attachments():
                    if item.name == name:
                        return item.data
        except DAMAGE as error:
            raise self._damaged(error) from error
        return None
