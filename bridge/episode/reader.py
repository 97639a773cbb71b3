"""Read one episode: metadata, topics, raw messages; ``streams`` decodes them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from bridge.episode import metadata
from bridge.episode.assigned import assigned
from bridge.episode.mcap.file import McapFile, damaged
from bridge.episode.mcap.messages import Selection, merged
from bridge.episode.mcap.walk import DAMAGE
from bridge.episode.provenance import hash_file
from bridge.episode.topics import is_truth
from bridge.errors import EpisodeError, PathNotFoundError, SchemaVersionError

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
    """Of most of its messages."""
    message_encoding: str
    count: int
    types: Mapping[str, int] = field(default_factory=dict)
    """Messages of each type; of a topic that carries several."""


class Episode:
    """An opened, finished episode. Cheap to make: only the summary is read."""

    def __init__(self, file: McapFile) -> None:
        """Use ``Episode.open``."""
        self.path = file.path
        self.file = file
        self.texts = {record.name: record.metadata for record in file.metadata}
        """All metadata records by name, as they stand in the file."""
        self._records: dict[str, dict[str, Any]] = {}
        self._topics: dict[str, TopicSummary] | None = None

    @staticmethod
    def open(path: Path) -> "Episode":
        """Open a finished MCAP file."""
        if not path.is_file():
            raise PathNotFoundError(path=path, what="episode", hint="robot-gst ls RUN lists them.")
        try:
            episode = Episode(McapFile(path))
        except DAMAGE as error:
            raise EpisodeError(
                path=path,
                found=f"not a finished MCAP file ({type(error).__name__}: {str(error)[:120]})",
                hint="If a recorder was killed while writing it: robot-gst recover FILE.",
            ) from error
        found = episode.record("episode").get("schema_version", metadata.SCHEMA_VERSION)
        if isinstance(found, int) and found > metadata.SCHEMA_VERSION:
            raise SchemaVersionError(
                path=path, name="episode metadata", found=found, known=metadata.SCHEMA_VERSION
            )
        return episode

    def sha256(self) -> str:
        """SHA-256 of its bytes, in hexadecimal; reads them."""
        return hash_file(self.path)

    @property
    def info(self) -> metadata.EpisodeInfo:
        """Who, what and when; a foreign MCAP file counts as imported until somebody says more."""
        found = self._metadata("episode", metadata.EpisodeInfo)
        info = found or metadata.EpisodeInfo(id=self.path.stem, kind="imported")
        return assigned(info, self.path)

    @property
    def outcome(self) -> metadata.Outcome | None:
        """What the operator said at the end, if anything."""
        return self._metadata("outcome", metadata.Outcome)

    @property
    def derived(self) -> metadata.Derived | None:
        """What this episode was made from, or None for a recorded one."""
        return self._metadata("derived", metadata.Derived)

    def _metadata(self, name: str, of_type: type[Record]) -> Record | None:
        if name not in self.texts:
            return None
        try:
            return metadata.build(of_type, self.record(name))
        except (TypeError, ValueError) as error:
            raise EpisodeError(
                path=self.path,
                found=f"its metadata record {name!r} cannot be read ({error})",
                hint="docs/episode_format.md lists the fields; another program wrote them.",
            ) from error

    @property
    def metadata_records(self) -> dict[str, dict[str, Any]]:
        """All metadata records by name, values parsed where they are JSON."""
        return {name: self.record(name) for name in self.texts}

    def record(self, name: str) -> dict[str, Any]:
        """Parse a metadata record, once; empty where there is none."""
        if name not in self._records:
            self._records[name] = metadata.from_strings(self.texts.get(name, {}))
        return self._records[name]

    @property
    def start_ns(self) -> int:
        """First log time, 0 without messages."""
        found = self.file.summary.statistics
        return found.message_start_time if found and found.message_count else 0

    @property
    def end_ns(self) -> int:
        """Last log time, 0 without messages."""
        found = self.file.summary.statistics
        return found.message_end_time if found and found.message_count else 0

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
        found: dict[str, dict[tuple[str, str], int]] = {}
        statistics = self.file.summary.statistics
        counts = statistics.channel_message_counts if statistics else {}
        for channel in self.file.summary.channels.values():
            record, kinds = self.file.schema_of(channel), found.setdefault(channel.topic, {})
            kind = (record.name if record else "", channel.message_encoding)
            kinds[kind] = kinds.get(kind, 0) + counts.get(channel.id, 0)
        topics = {}
        for topic, kinds in sorted(found.items()):
            type_name, encoding = max(kinds, key=lambda kind: kinds[kind])
            types = {name: count for (name, _), count in kinds.items() if count}
            topics[topic] = TopicSummary(
                topic=topic,
                type_name=type_name,
                message_encoding=encoding,
                count=sum(kinds.values()),
                types=types if len(types) > 1 else {},
            )
        return topics

    def topics_of_type(self, type_name: str) -> list[str]:
        """Topics that carry one message type; stand-in truth is never among them."""
        return [
            topic
            for topic, summary in self.topics().items()
            if summary.type_name == type_name and not is_truth(topic)
        ]

    def messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[RawMessage]:
        """Yield messages in log order with CRCs checked, from ``start_ns`` to before ``end_ns``.

        Chunks without a wanted topic are not read; few are held in memory at a time.
        """
        wanted = None if topics is None else frozenset(topics)
        if wanted is not None and not wanted:
            return
        select = Selection(topics=wanted, start_ns=start_ns, end_ns=end_ns)
        for item in merged([self.file], select):
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
        """Return the bytes of all messages of each group of topics, in log order, in one pass."""
        wanted = [frozenset(topics) for topics in groups]
        found: list[list[bytes]] = [[] for _ in wanted]
        for message in self.messages(frozenset[str]().union(*wanted)):
            for topics, payloads in zip(wanted, found, strict=True):
                if message.topic in topics:
                    payloads.append(message.data)
        return found

    def attachment(self, name: str) -> bytes | None:
        """Return the bytes of the first attachment of this name with its CRC checked, or None."""
        try:
            return next((bytes(each.data) for each in self.file.attachments(name)), None)
        except DAMAGE as error:
            raise damaged(self.path, error) from error
