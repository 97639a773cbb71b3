"""rosbag2 recordings, MCAP or sqlite3, one file or a folder of them, as one episode.

What rosbag2 compressed is unpacked. Nothing else is interpreted: payloads, schemas, sequence
numbers and both times are kept as they are. What an episode has no place for (quality of service,
how often a topic was silent) is kept in the metadata record ``source``. Layout of
``metadata.yaml``: rosbag2_storage's ``BagMetadata``.
"""

import heapq
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap import records

from bridge.episode import schema
from bridge.episode.mcap.file import McapFile, damaged
from bridge.episode.mcap.messages import Selection, merged
from bridge.episode.mcap.walk import DAMAGE
from bridge.episode.metadata import EpisodeInfo, imported_info
from bridge.episode.provenance import hash_file
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.episode.streams import ROBOT_FILE
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError, MissingDependencyError, PathNotFoundError
from bridge.exchange.driver_names import mapped
from bridge.exchange.output import Unused, is_of_stand_in
from bridge.exchange.rosbag2_storage import (
    SQLITE_MAGIC,
    BagFormatError,
    BagMessage,
    SqliteBag,
    unpack_file,
    unpack_message,
)

METADATA_FILE = "metadata.yaml"
STORAGES = ("mcap", "sqlite3")
MAX_METADATA_BYTES = 16 << 20
OWN_RECORDS = frozenset(
    {"episode", "software", "outcome", "derived", "drops", "recorder", "split", "source"}
    | {"recovered"}
)
"""Metadata names that mean something in an episode; those of the source get a prefix."""


@dataclass(frozen=True, kw_only=True)
class ImportReport:
    """What was imported."""

    path: Path
    files: list[str]
    messages: int
    topics: dict[str, int]
    names: dict[str, str]
    """New names of topics that had those of a camera's driver."""
    unused: list[Unused]


def find_files(source: Path) -> list[Path]:
    """Return the files of a bag in their order; a single file is its own bag."""
    if source.is_file():
        return [source]
    hint = "Give a file of the bag, or the folder that holds metadata.yaml."
    if not source.is_dir():
        raise PathNotFoundError(path=source, what="bag", hint=hint)
    about = source / METADATA_FILE
    if about.is_file():
        return _listed_files(about)
    for pattern in ("*.mcap", "*.db3", "*.mcap.zstd", "*.db3.zstd"):
        if files := sorted(source.glob(pattern)):
            return files
    raise PathNotFoundError(path=source / "*.mcap", what="bag file", hint=hint)


def _listed_files(about: Path) -> list[Path]:
    record = _read_yaml(about).get("rosbag2_bagfile_information")
    names = record.get("relative_file_paths") if isinstance(record, dict) else None
    if not isinstance(record, dict) or not isinstance(names, list) or not names:
        raise BagFormatError(
            path=about,
            found="it lists no files under rosbag2_bagfile_information",
            hint="Restore it, or remove it to import every file of the folder.",
        )
    storage = record.get("storage_identifier", "mcap")
    if storage not in STORAGES:
        found = f"its storage is {storage!r}; {' and '.join(STORAGES)} are read"
        hint = "Convert the bag first: ros2 bag convert with storage_id mcap."
        raise BagFormatError(path=about, found=found, hint=hint)
    mode, kind = record.get("compression_mode"), record.get("compression_format")
    if mode and str(mode).lower() != "none" and kind != "zstd":
        found = f"it is compressed with {kind!r} ({mode}); zstd is read"
        hint = "Convert it first: ros2 bag convert without a compression_mode."
        raise BagFormatError(path=about, found=found, hint=hint)
    return [_listed_file(about, str(name)) for name in names]


def _listed_file(about: Path, name: str) -> Path:
    path = about.parent / name
    if not path.exists() and name == f"{about.parent.name}/{path.name}":  # before version 4
        path = about.parent / path.name
    if not path.resolve().is_relative_to(about.parent.resolve()):
        found = f"it lists {name!r}, which lies outside its folder"
        raise BagFormatError(path=about, found=found, hint="Import that file by its own name.")
    if not path.is_file():
        hint = f"{about} lists it; without it the recording has a hole."
        raise PathNotFoundError(path=path, what="bag file", hint=hint)
    return path


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        from ruamel.yaml import YAML  # noqa: PLC0415 - only bags in folders need it
        from ruamel.yaml.error import YAMLError  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(
            package="ruamel.yaml", extra="record", purpose=f"reading {METADATA_FILE}"
        ) from error
    hint = "Remove it to import every file of the folder."
    if path.stat().st_size > MAX_METADATA_BYTES:
        raise BagFormatError(path=path, found="it is larger than any bag's", hint=hint)
    try:
        found = YAML(typ="safe", pure=True).load(path.read_text())
    except (YAMLError, ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BagFormatError(path=path, found=f"it is no YAML ({reason})", hint=hint) from error
    return found if isinstance(found, dict) else {}


def import_bag(
    source: Path,
    run: RunFolder,
    *,
    episode_id: str,
    task: str = "",
    urdf: str = "",
    remap: Sequence[str] = (),
    advance: Callable[[int, str], None] = lambda done, note: None,
) -> ImportReport:
    """Write a bag as one episode, a trial where it is of a task; on any error none is left.

    Args:
        source: A file, or a folder with ``metadata.yaml`` or several files.
        task: Name of the task it is a trial of; "": it is not known to be one.
        urdf: The robot's description, in place of one that was recorded.
        remap: OLD=NEW of topics; without any, those of known camera drivers are renamed.
    """
    check_episode_id(episode_id)
    sources = find_files(source)
    with unpacked(sources, run.episodes_dir.parent) as bag:
        stand_in = is_of_stand_in(source)
        info = imported_info(episode_id, task, tags=("rosbag2",), stand_in=stand_in)
        return _import(bag, sources, run, info, urdf, mapped(bag.types(), remap), advance)


@contextmanager
def unpacked(sources: list[Path], beside: Path | None) -> Iterator["_McapBag | _SqliteBags"]:
    """Open a bag; files that are compressed as a whole are unpacked in ``beside`` meanwhile."""
    with tempfile.TemporaryDirectory(prefix="rosbag2_", dir=beside) as folder:
        bag = _open_bag([unpack_file(path, Path(folder)) for path in sources])
        try:
            yield bag
        finally:
            bag.close()


def _import(
    bag: "_McapBag | _SqliteBags",
    sources: list[Path],
    run: RunFolder,
    info: EpisodeInfo,
    urdf: str,
    names: dict[str, str],
    advance: Callable[[int, str], None],
) -> ImportReport:
    writer = EpisodeWriter(run.episodes_dir / f"{info.id}.mcap")
    counts: dict[str, int] = {}
    unread: dict[str, Unused] = {}
    try:
        writer.describe(info)
        if urdf:
            writer.attach(ROBOT_FILE, urdf.encode(), media_type="application/xml", log_time_ns=0)
        bag.copy_attachments(writer)
        for done, item in enumerate(bag.messages(), start=1):
            topic = names.get(item.topic, item.topic)
            writer.write(
                topic,
                item.data,
                schema_record=item.record,
                message_encoding=item.message_encoding,
                log_time_ns=item.log_time_ns,
                publish_time_ns=item.publish_time_ns,
                sequence=item.sequence,
            )
            if topic not in counts and (why := _why_unread(item)):
                unread[topic] = why
            counts[topic] = counts.get(topic, 0) + 1
            if done % 1000 == 0:
                advance(done, topic)
        about = bag.copy_metadata(writer)
        about["files"] = [
            {"name": path.name, "sha256": hash_file(path), **more}
            for path, more in zip(sources, about["files"], strict=True)
        ]
        about["renamed"] = names
        values = {name: json.dumps(value) for name, value in about.items()}
        writer.add_metadata("source", values)
        path = writer.close()
    except BaseException:
        writer.discard()
        raise
    unused = [why._replace(what=f"{topic} ({counts[topic]})") for topic, why in unread.items()]
    return ImportReport(
        path=path, files=[path.name for path in sources], messages=sum(counts.values()),
        topics=counts, names=names, unused=unused,
    )  # fmt: skip


def _why_unread(item: BagMessage) -> Unused | None:
    """Why no command reads a topic, by its first message."""
    if item.message_encoding == "ros1":
        why = "ROS 1 messages are kept and not read; convert the recording with rosbags-convert"
        return Unused(item.topic, why, is_needed=True)
    name = item.record.name if item.record else ""
    if not name or schema.schema_for(name) is None:
        return Unused(item.topic, f"kept; no command reads {name or 'messages without a type'}")
    return None


def count_messages(source: Path) -> int:
    """Messages a bag says it holds, for progress; 0 where it does not say it at once."""
    if source.is_dir() and (about := source / METADATA_FILE).is_file():
        record = _read_yaml(about).get("rosbag2_bagfile_information")
        count = record.get("message_count") if isinstance(record, dict) else None
        return count if isinstance(count, int) and count > 0 else 0
    paths = [path for path in find_files(source) if path.suffix == ".mcap"]
    statistics = (_open_mcap(path).summary.statistics for path in paths)
    return sum(item.message_count for item in statistics if item is not None)


def _open_bag(paths: list[Path]) -> "_McapBag | _SqliteBags":
    with paths[0].open("rb") as stream:
        start = stream.read(len(SQLITE_MAGIC))
    if start.startswith(b"#ROSBAG"):
        hint = f"Convert it: rosbags-convert --src {paths[0]} --dst {paths[0].stem}"
        raise BagFormatError(path=paths[0], found="a ROS 1 bag", hint=hint)
    return _SqliteBags(paths) if start == SQLITE_MAGIC else _McapBag(paths)


def _open_mcap(path: Path) -> McapFile:
    try:
        return McapFile(path)
    except DAMAGE as error:
        raise EpisodeError(
            path=path,
            found=f"not a finished MCAP file ({error})",
            hint="robot-gst recover makes a finished copy of what is readable; import that.",
        ) from error


class _SqliteBags:
    """The databases of one bag."""

    def __init__(self, paths: list[Path]) -> None:
        self._bags = [SqliteBag(path) for path in paths]

    def close(self) -> None:
        for bag in self._bags:
            bag.close()

    def messages(self) -> Iterator[BagMessage]:
        yield from heapq.merge(
            *(bag.messages() for bag in self._bags), key=lambda item: item.log_time_ns
        )

    def types(self) -> dict[str, str]:
        topics = (topic for bag in self._bags for topic in bag.topics.values())
        return {topic.name: topic.record.name for topic in topics}

    def copy_attachments(self, writer: EpisodeWriter) -> None:
        """A database has none."""

    def copy_metadata(self, writer: EpisodeWriter) -> dict[str, Any]:
        topics = [topic for bag in self._bags for topic in bag.topics.values()]
        return {
            "format": "rosbag2 sqlite3",
            "files": [{} for _ in self._bags],
            "channels": {
                topic.name: {"offered_qos_profiles": topic.qos} for topic in topics if topic.qos
            },
            "times": "a bag of this kind has one time for each message; it is both times here",
        }


class _McapBag:
    """The MCAP files of one bag."""

    def __init__(self, paths: list[Path]) -> None:
        self._files = [_open_mcap(path) for path in paths]

    def close(self) -> None:
        """Files are open only while they are read."""

    def messages(self) -> Iterator[BagMessage]:
        schemas: dict[tuple[int, int], schema.Schema | None] = {}
        for item in merged(self._files, Selection()):
            key = (id(item.file), item.channel.id)
            if key not in schemas:
                schemas[key] = schema_of(item.file, item.channel)
            is_cdr = item.channel.message_encoding == "cdr"
            yield BagMessage(
                item.channel.topic,
                schemas[key],
                item.channel.message_encoding,
                item.log_time_ns,
                item.publish_time_ns,
                item.sequence,
                unpack_message(item.file.path, item.data) if is_cdr else item.data,
            )

    def types(self) -> dict[str, str]:
        found = ((f, channel) for f in self._files for channel in f.summary.channels.values())
        return {
            channel.topic: record.name
            for file, channel in found
            if (record := file.schema_of(channel)) is not None
        }

    def copy_attachments(self, writer: EpisodeWriter) -> None:
        copy_attachments(self._files, writer)

    def copy_metadata(self, writer: EpisodeWriter) -> dict[str, Any]:
        files = self._files
        for file in files:
            for record in file.metadata:
                prefix = "source." if record.name in OWN_RECORDS else ""
                writer.add_metadata(prefix + record.name, record.metadata)
        headers = [(file.header.profile, file.header.library) for file in files]
        return {
            "format": "rosbag2 MCAP",
            "files": [{"profile": profile, "library": library} for profile, library in headers],
            "channels": {
                channel.topic: channel.metadata
                for file in files
                for channel in file.summary.channels.values()
                if channel.metadata
            },
            "silent_topics": sorted(_silent(files)),
        }


def schema_of(file: McapFile, channel: records.Channel) -> schema.Schema | None:
    """What a channel of a file carries; None where nobody says."""
    record = file.schema_of(channel)
    if record is None:
        return None
    return schema.Schema(
        name=record.name,
        schema_encoding=record.encoding,
        message_encoding=channel.message_encoding,
        data=record.data,
    )


def copy_attachments(files: Sequence[McapFile], writer: EpisodeWriter) -> None:
    """Copy what is attached to some files into an episode."""
    for file in files:
        try:
            for item in file.attachments():
                writer.attach(
                    item.name, item.data, media_type=item.media_type, log_time_ns=item.log_time
                )
        except DAMAGE as error:
            raise damaged(file.path, error) from error


def _silent(files: list[McapFile]) -> set[str]:
    """Topics that were announced but never carried a message."""
    announced, spoken = set(), set()
    for file in files:
        channels, about = file.summary.channels, file.summary.statistics
        announced |= {channel.topic for channel in channels.values()}
        counts = about.channel_message_counts if about else {}
        spoken |= {each.topic for number, each in channels.items() if counts.get(number)}
    return announced - spoken
