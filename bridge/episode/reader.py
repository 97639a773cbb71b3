"""Read one episode: metadata, topics, raw messages; ``streams`` decodes them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from bridge.episode import metadata, schema
from bridge.episode.mcap.file import McapFile, damaged
from bridge.episode.mcap.gather import gathered
from bridge.episode.mcap.merge import Selection, merged
from bridge.episode.mcap.walk import DAMAGE
from bridge.episode.parts import open_parts
from bridge.episode.provenance import hash_files
from bridge.errors import EpisodeError, PathNotFoundError, SchemaVersionError

LAST_PART_WINS = ("outcome", "drops", "recorder", "split")
"""Metadata that only the end of an episode knows; every other record is that of its beginning."""

Record = TypeVar("Record", metadata.EpisodeInfo, metadata.Outcome, metadata.Derived)


class RawMessage(NamedTuple):
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
    """An opened, finished episode: one file, or several parts that are read as one.

    Cheap to make: only the summaries are read.
    """

    def __init__(self, files: tuple[McapFile, ...], missing_parts: tuple[Path, ...]) -> None:
        """Use ``Episode.open``."""
        self.path = files[0].path
        self.files = files
        self.missing_parts = missing_parts
        """Parts of a split episode that are not there or cannot be read."""
        self._texts = _joined_texts(files)
        self._records: dict[str, dict[str, Any]] = {}
        self._topics: dict[str, TopicSummary] | None = None

    @staticmethod
    def open(path: Path) -> "Episode":
        """Open a finished MCAP file, and the parts behind it where an episode was split.

        A part that is missing does not prevent reading the others: see ``missing_parts``.

        Raises:
            PathNotFoundError: When the file is not there.
            EpisodeError: When it is no MCAP file, or was never finished.
            SchemaVersionError: When it was written by a newer major version.
        """
        if not path.is_file():
            raise PathNotFoundError(path=path, what="episode", hint="robot-gst ls RUN lists them.")
        try:
            parts = open_parts(path)
        except DAMAGE as error:
            raise EpisodeError(
                path=path,
                found=f"not a finished MCAP file ({type(error).__name__}: {str(error)[:120]})",
                hint="If a recorder was killed while writing it: robot-gst recover FILE.",
            ) from error
        episode = Episode(parts.files, parts.missing)
        found = episode._record("episode").get("schema_version", metadata.SCHEMA_VERSION)
        if isinstance(found, int) and found > metadata.SCHEMA_VERSION:
            raise SchemaVersionError(
                path=path, name="episode metadata", found=found, known=metadata.SCHEMA_VERSION
            )
        return episode

    @property
    def parts(self) -> tuple[Path, ...]:
        """The files this episode is read from, in order."""
        return tuple(file.path for file in self.files)

    def sha256(self) -> str:
        """SHA-256 of the bytes of all parts, one after the other, in hexadecimal; reads them."""
        return hash_files(self.parts)

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
        if name not in self._texts:
            return None
        try:
            return metadata.build(of_type, self._record(name))
        except (TypeError, ValueError) as error:
            raise EpisodeError(
                path=self.path,
                found=f"its metadata record {name!r} cannot be read ({error})",
                hint="docs/episode_format.md lists the fields; another program wrote them.",
            ) from error

    @property
    def metadata_records(self) -> dict[str, dict[str, Any]]:
        """All metadata records by name, values parsed where they are JSON."""
        return {name: self._record(name) for name in self._texts}

    def _record(self, name: str) -> dict[str, Any]:
        """Parse a metadata record, once; empty where there is none."""
        if name not in self._records:
            self._records[name] = metadata.from_strings(self._texts.get(name, {}))
        return self._records[name]

    @property
    def start_ns(self) -> int:
        """First log time of any part, 0 without messages."""
        return min((start for start, _ in self._times_ns()), default=0)

    @property
    def end_ns(self) -> int:
        """Last log time of any part, 0 without messages."""
        return max((end for _, end in self._times_ns()), default=0)

    def _times_ns(self) -> Iterator[tuple[int, int]]:
        for file in self.files:
            statistics = file.summary.statistics
            if statistics is not None and statistics.message_count:
                yield statistics.message_start_time, statistics.message_end_time

    @property
    def duration_s(self) -> float:
        """Seconds between the first and the last log time."""
        return (self.end_ns - self.start_ns) * 1e-9

    def topics(self) -> dict[str, TopicSummary]:
        """Return every topic with its type and number of messages."""
        if self._topics is None:
            self._topics = self._summed_up()
        return dict(self._topics)

    def _summed_up(self) -> dict[str, TopicSummary]:
        topics: dict[str, TopicSummary] = {}
        for file in self.files:
            statistics = file.summary.statistics
            counts = statistics.channel_message_counts if statistics else {}
            for channel in file.summary.channels.values():
                record = file.schema_of(channel)
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

        ``start_ns`` (included) and ``end_ns`` (excluded) bound the log time. Chunks without a
        wanted topic are not read; few are held in memory at a time.

        Raises:
            EpisodeError: When a file turns out to be damaged.
        """
        wanted = None if topics is None else frozenset(topics)
        if wanted is not None and not wanted:
            return
        select = Selection(topics=wanted, start_ns=start_ns, end_ns=end_ns)
        for item in merged(self.files, select):
            record = item.file.schema_of(item.channel)
            yield RawMessage(
                item.channel.topic,
                record.name if record else "",
                item.log_time_ns,
                item.publish_time_ns,
                item.sequence,
                item.data,
            )

    def payloads(self, *groups: Iterable[str]) -> list[list[bytes]]:
        """Return the bytes of all messages of each group of topics, in log order, in one pass.

        What ``messages`` yields one by one, quicker; everything asked for is held in memory.

        Raises:
            EpisodeError: When a file turns out to be damaged.
        """
        return gathered(self.files, [frozenset(topics) for topics in groups])

    def attachment(self, name: str) -> bytes | None:
        """Return the bytes of the first attachment of this name with its CRC checked, or None.

        Raises:
            EpisodeError: When it is damaged.
        """
        for file in self.files:
            try:
                found = file.attachment(name)
            except DAMAGE as error:
                raise damaged(file.path, error) from error
            if found is not None:
                return found
        return None


def _joined_texts(files: tuple[McapFile, ...]) -> dict[str, dict[str, str]]:
    joined: dict[str, dict[str, str]] = {}
    for file in files:
        of_part = {record.name: record.metadata for record in file.metadata}
        for name, values in of_part.items():
            if name in LAST_PART_WINS or name not in joined:
                joined[name] = values
    return joined
