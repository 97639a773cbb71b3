"""rosbag2 recordings in MCAP files, one or a folder of them, as one episode.

Nothing is interpreted: payloads, schemas, sequence numbers and both times are kept as they are.
What an episode has no place for (quality of service, how often a topic was silent) is kept in the
metadata record ``source``. Layout of ``metadata.yaml``: rosbag2_storage's ``BagMetadata``.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap import records

from bridge.episode import schema
from bridge.episode.mcap.file import McapFile, damaged
from bridge.episode.mcap.messages import Selection, Stored, merged
from bridge.episode.mcap.walk import DAMAGE
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.provenance import hash_file
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.episode.writer import EpisodeWriter
from bridge.errors import BridgeError, EpisodeError, MissingDependencyError, PathNotFoundError

METADATA_FILE = "metadata.yaml"
MAX_METADATA_BYTES = 16 << 20
OWN_RECORDS = frozenset(
    {"episode", "software", "outcome", "derived", "drops", "recorder", "split", "source"}
    | {"recovered"}
)
"""Metadata names that mean something in an episode; those of the source get a prefix."""


class BagFormatError(BridgeError):
    """A bag is not what this import reads."""

    def __init__(self, *, path: Path, found: str, hint: str) -> None:
        """Remember the file."""
        self.path = path
        super().__init__(f"{path}: {found}. {hint}")


@dataclass(frozen=True, kw_only=True)
class ImportReport:
    """What was imported."""

    path: Path
    files: list[str]
    messages: int
    topics: dict[str, int]
    """Messages by topic."""


def find_files(source: Path) -> list[Path]:
    """Return the MCAP files of a bag in their order; a single file is its own bag.

    Raises:
        PathNotFoundError: When there is nothing, or a file that ``metadata.yaml`` lists is gone.
        BagFormatError: When the bag is compressed as a whole, or is no MCAP bag.
        MissingDependencyError: When ``metadata.yaml`` cannot be read for want of a YAML reader.
    """
    if source.is_file():
        return [source]
    if not source.is_dir():
        hint = "Give a .mcap file, or the folder that holds metadata.yaml."
        raise PathNotFoundError(path=source, what="bag", hint=hint)
    about = source / METADATA_FILE
    if about.is_file():
        return _listed_files(about)
    files = sorted(source.glob("*.mcap"))
    if not files:
        hint = "Give a .mcap file, or the folder that holds metadata.yaml."
        raise PathNotFoundError(path=source / "*.mcap", what="bag file", hint=hint)
    return files


def _listed_files(about: Path) -> list[Path]:
    record = _read_yaml(about).get("rosbag2_bagfile_information")
    names = record.get("relative_file_paths") if isinstance(record, dict) else None
    if not isinstance(record, dict) or not isinstance(names, list) or not names:
        raise BagFormatError(
            path=about,
            found="it lists no files under rosbag2_bagfile_information",
            hint="Restore it, or remove it to import every .mcap file of the folder.",
        )
    storage = record.get("storage_identifier", "mcap")
    if storage != "mcap":
        hint = "Convert the bag first: ros2 bag convert with storage_id mcap."
        raise BagFormatError(path=about, found=f"its storage is {storage!r}, not mcap", hint=hint)
    if record.get("compression_mode"):
        found = f"it is compressed by rosbag2 ({record['compression_mode']})"
        hint = "Convert it first: ros2 bag convert without a compression_mode."
        raise BagFormatError(path=about, found=found, hint=hint)
    return [_listed_file(about, str(name)) for name in names]


def _listed_file(about: Path, name: str) -> Path:
    path = about.parent / name
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
    hint = "Remove it to import every .mcap file of the folder."
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
    advance: Callable[[int, str], None] = lambda done, note: None,
) -> ImportReport:
    """Write a bag as one episode of kind imported; on any error no episode is left.

    Args:
        source: A file, or a folder with ``metadata.yaml`` or several files.
        run: Where the episode goes.
        episode_id: Its name.
        advance: Told how many messages are done.

    Raises:
        EpisodeError: When a file is damaged or was never finished.
        UsageError: When the episode exists already.
    """
    check_episode_id(episode_id)
    files = [_open(path) for path in find_files(source)]
    writer = EpisodeWriter(run.episodes_dir / f"{episode_id}.mcap")
    counts: dict[str, int] = {}
    try:
        writer.describe(EpisodeInfo(id=episode_id, kind="imported", tags=("rosbag2",)))
        _copy_attachments(files, writer)
        for done, item in enumerate(_copied(files, writer), start=1):
            counts[item.channel.topic] = counts.get(item.channel.topic, 0) + 1
            if done % 1000 == 0:
                advance(done, item.channel.topic)
        _copy_metadata(files, writer)
        path = writer.close()
    except BaseException:
        writer.discard()
        raise
    names = [file.path.name for file in files]
    return ImportReport(path=path, files=names, messages=sum(counts.values()), topics=counts)


def count_messages(source: Path) -> int:
    """Messages a bag says it holds, for progress."""
    statistics = (_open(path).summary.statistics for path in find_files(source))
    return sum(item.message_count for item in statistics if item is not None)


def _open(path: Path) -> McapFile:
    try:
        return McapFile(path)
    except DAMAGE as error:
        raise EpisodeError(
            path=path,
            found=f"not a finished MCAP file ({error})",
            hint="robot-gst recover makes a finished copy of what is readable; import that.",
        ) from error


def _copied(files: list[McapFile], writer: EpisodeWriter) -> Iterator[Stored]:
    """Write every message of all files in log order."""
    schemas: dict[tuple[int, int], schema.Schema | None] = {}
    for item in merged(files, Selection()):
        key = (id(item.file), item.channel.id)
        if key not in schemas:
            schemas[key] = _schema_of(item.file, item.channel)
        writer.write_foreign(
            item.channel.topic,
            item.data,
            schema_record=schemas[key],
            message_encoding=item.channel.message_encoding,
            log_time_ns=item.log_time_ns,
            publish_time_ns=item.publish_time_ns,
            sequence=item.sequence,
        )
        yield item


def _schema_of(file: McapFile, channel: records.Channel) -> schema.Schema | None:
    record = file.schema_of(channel)
    if record is None:
        return None
    return schema.Schema(
        name=record.name,
        schema_encoding=record.encoding,
        message_encoding=channel.message_encoding,
        data=record.data,
    )


def _copy_attachments(files: list[McapFile], writer: EpisodeWriter) -> None:
    for file in files:
        try:
            for item in file.attachments():
                writer.attach(
                    item.name, item.data, media_type=item.media_type, log_time_ns=item.log_time
                )
        except DAMAGE as error:
            raise damaged(file.path, error) from error


def _copy_metadata(files: list[McapFile], writer: EpisodeWriter) -> None:
    for file in files:
        for record in file.metadata:
            prefix = "source." if record.name in OWN_RECORDS else ""
            writer.add_metadata(prefix + record.name, record.metadata)
    values = {
        "format": "rosbag2 MCAP",
        "files": [_about(file) for file in files],
        "channels": {
            channel.topic: channel.metadata
            for file in files
            for channel in file.summary.channels.values()
            if channel.metadata
        },
        "silent_topics": sorted(_silent(files)),
    }
    writer.add_metadata("source", {name: json.dumps(value) for name, value in values.items()})


def _about(file: McapFile) -> dict[str, Any]:
    return {
        "name": file.path.name,
        "sha256": hash_file(file.path),
        "profile": file.header.profile,
        "library": file.header.library,
    }


def _silent(files: list[McapFile]) -> set[str]:
    """Topics that were announced but never carried a message."""
    announced, spoken = set(), set()
    for file in files:
        counts = file.summary.statistics.channel_message_counts if file.summary.statistics else {}
        for channel in file.summary.channels.values():
            announced.add(channel.topic)
            if counts.get(channel.id):
                spoken.add(channel.topic)
    return announced - spoken
