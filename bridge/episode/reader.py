"""Read one episode, split or whole: metadata, topics, raw messages; ``streams`` decodes them."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from bridge.episode import metadata
from bridge.episode.assigned import assigned
from bridge.episode.mcap.file import McapFile, damaged
from bridge.episode.mcap.messages import Selection, merged
from bridge.episode.mcap.walk import DAMAGE
from bridge.episode.provenance import hash_files
from bridge.episode.run_folder import EPISODE_ID, part_name
from bridge.episode.topics import is_truth
from bridge.errors import EpisodeError, PathNotFoundError, SchemaVersionError

_NAME = re.compile(rf"({EPISODE_ID.pattern})(?:\.([1-9][0-9]{{0,5}}))?\.mcap")


class PartName(NamedTuple):
    """What a file name says."""

    episode_id: str
    number: int
    """1 for the first part, and for an episode in one file."""


def name_of_part(path: Path) -> PartName | None:
    """Read a file name; None for names no recorder of ours gives."""
    found = _NAME.fullmatch(path.name)
    return None if found is None else PartName(found[1], int(found[2] or 1))


@dataclass(frozen=True, kw_only=True)
class Parts:
    """The files of one episode that can be read, in order."""

    files: tuple[McapFile, ...]
    missing: tuple[Path, ...]
    """Parts that are not there or cannot be read, by the name they should have."""


def open_parts(path: Path) -> Parts:
    """Open a file and, where it is part of a split episode, the parts behind it.

    A part says in its ``split`` record whether it is the last. Recovered parts may not say it:
    then the highest number that is there counts as the last.
    """
    first = McapFile(path)
    name = name_of_part(path)
    if name is None or is_last_part(first):
        return Parts(files=(first,), missing=())
    following = path.with_name(part_name(name.episode_id, name.number + 1))
    if split_of(first) is None and not _was_cut_off(first) and not following.exists():
        return Parts(files=(first,), missing=())
    return _follow(first, *name)


def _follow(first: McapFile, episode_id: str, index: int) -> Parts:
    files, missing = [first], []
    highest: int | None = None
    while not is_last_part(files[-1]):
        index += 1
        path = first.path.with_name(part_name(episode_id, index))
        file = _open_later(path, of=first)
        if file is not None:
            files.append(file)
            continue
        if highest is None:  # a hole: is there anything behind it?
            names = map(name_of_part, first.path.parent.glob(f"{episode_id}.*.mcap"))
            highest = max((name.number for name in names if name is not None), default=1)
        if index > highest:
            if not _was_cut_off(files[-1]) or path.exists():
                missing.append(path)
            break
        missing.append(path)
    return Parts(files=tuple(files), missing=tuple(missing))


def _open_later(path: Path, *, of: McapFile) -> McapFile | None:
    if not path.is_file():
        return None
    try:
        file = McapFile(path)
    except DAMAGE:
        return None
    ids = {record.get("id") for record in (record_of(of, "episode"), record_of(file, "episode"))}
    return file if len(ids - {None}) < 2 else None


def record_of(file: McapFile, name: str) -> dict[str, Any]:
    """Return a metadata record of one file with its values parsed, empty where there is none."""
    values: dict[str, Any] = {}
    for record in file.metadata:
        if record.name == name:
            values = metadata.from_strings(record.metadata)
    return values


def split_of(file: McapFile) -> dict[str, Any] | None:
    """Return the ``split`` record, or None."""
    return record_of(file, "split") or None


def is_last_part(file: McapFile) -> bool:
    """Whether a file says that no part follows."""
    split = split_of(file)
    return split is not None and split.get("last") is True


def _was_cut_off(file: McapFile) -> bool:
    """Whether the end of this part is unknown because its writer died: no part need follow."""
    return any(record.name == "recovered" for record in file.metadata)


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
    """Of most of its messages."""
    message_encoding: str
    count: int
    types: Mapping[str, int] = field(default_factory=dict)
    """Messages of each type; of a topic that carries several."""


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
        self.texts = _joined_texts(files)
        """All metadata records by name, as they stand in the files."""
        self._records: dict[str, dict[str, Any]] = {}
        self._topics: dict[str, TopicSummary] | None = None

    @staticmethod
    def open(path: Path) -> "Episode":
        """Open a finished MCAP file, and the parts behind it where an episode was split.

        A part that is missing does not prevent reading the others: see ``missing_parts``.
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
        return {name: self._record(name) for name in self.texts}

    def _record(self, name: str) -> dict[str, Any]:
        """Parse a metadata record, once; empty where there is none."""
        if name not in self._records:
            self._records[name] = metadata.from_strings(self.texts.get(name, {}))
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
        found: dict[str, dict[tuple[str, str], int]] = {}
        for file in self.files:
            statistics = file.summary.statistics
            counts = statistics.channel_message_counts if statistics else {}
            for channel in file.summary.channels.values():
                record, kinds = file.schema_of(channel), found.setdefault(channel.topic, {})
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
