"""The files of a rosbag2 recording: MCAP or sqlite3, as they are or compressed with zstd.

Layout of the database: rosbag2_storage_sqlite3, tables ``topics``, ``messages`` and, since schema
version 4, ``message_definitions``.
"""

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import zstandard

from bridge.episode import schema
from bridge.errors import EpisodeError, MissingDependencyError
from bridge.wire.rmw import ros_schema

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""No CDR begins so: the first two bytes of one are 0, or 0 and 1, and few other small numbers."""
SQLITE_MAGIC = b"SQLite format 3\0"
MAX_UNPACKED_BYTES = 1 << 30
"""One message; a frame that claims to hold more is refused."""
_WINDOW_BYTES = 1 << 31


class BagFormatError(EpisodeError):
    """A bag is not what this import reads."""


def unpack_file(path: Path, folder: Path) -> Path:
    """Return a file as it was before rosbag2 compressed it; one that is not compressed itself."""
    with path.open("rb") as stream:
        if stream.read(len(ZSTD_MAGIC)) != ZSTD_MAGIC:
            return path
        stream.seek(0)
        unpacked = folder / path.name.removesuffix(".zstd")
        unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES)
        try:
            with unpacked.open("wb") as out:
                unpacker.copy_stream(stream, out)
        except zstandard.ZstdError as error:
            raise _damaged(path, f"its zstd data is damaged ({error})") from error
    return unpacked


def unpack_message(path: Path, data: bytes) -> bytes:
    """Return a message as it was before rosbag2 compressed it; any other as it is."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES)
    try:
        with unpacker.stream_reader(data) as stream:
            unpacked = bytes(stream.read(MAX_UNPACKED_BYTES + 1))
    except zstandard.ZstdError as error:
        raise _damaged(path, f"a compressed message is damaged ({error})") from error
    declared = zstandard.frame_content_size(data)
    if len(unpacked) > MAX_UNPACKED_BYTES or declared not in (-1, len(unpacked)):
        raise _damaged(path, f"a compressed message of {declared} bytes cannot be unpacked")
    return unpacked


def _damaged(path: Path, found: str) -> EpisodeError:
    return EpisodeError(path=path, found=found, hint="Copy the bag again from where it came.")


class BagMessage(NamedTuple):
    """One message of a bag."""

    topic: str
    record: schema.Schema | None
    message_encoding: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int | None
    data: bytes


class SqliteTopic(NamedTuple):
    """A row of ``topics``."""

    name: str
    record: schema.Schema
    qos: str


class SqliteBag:
    """A finished database of rosbag2; nothing in it is changed."""

    def __init__(self, path: Path) -> None:
        """Open it."""
        self.path = path
        try:
            place = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
            self._database = sqlite3.connect(place, uri=True)
            self.topics = self._read_topics()
        except sqlite3.DatabaseError as error:
            raise _no_database(path, error) from error

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def _columns(self, table: str) -> set[str]:
        rows = self._database.execute("SELECT name FROM pragma_table_info(?)", (table,))
        return {str(name) for (name,) in rows}

    def _read_topics(self) -> dict[int, SqliteTopic]:
        definitions = self._read_definitions()
        qos = "offered_qos_profiles" if "offered_qos_profiles" in self._columns("topics") else "''"
        rows = self._database.execute(  # the column is one of two literals
            f"SELECT id, name, type, serialization_format, {qos} FROM topics ORDER BY id"
        )
        topics = {}
        for number, name, type_name, encoding, profiles in rows:
            record = _schema(str(type_name), str(encoding), definitions)
            topics[int(number)] = SqliteTopic(str(name), record, str(profiles))
        return topics

    def _read_definitions(self) -> dict[str, tuple[str, str]]:
        if not self._columns("message_definitions"):
            return {}
        rows = self._database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        return {str(name): (str(encoding), str(text)) for name, encoding, text in rows}

    def messages(self) -> Iterator[BagMessage]:
        """Yield every message by time, then as it was written; a bag has one time for each."""
        try:
            rows = self._database.execute(
                "SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id"
            )
            for topic_id, stamp_ns, data in rows:
                topic = self.topics.get(topic_id)
                if topic is None or not isinstance(data, bytes) or not 0 <= stamp_ns < 1 << 63:
                    found = f"a message of topic {topic_id} at {stamp_ns} makes no sense"
                    raise _damaged(self.path, found)
                encoding, plain = topic.record.message_encoding, unpack_message(self.path, data)
                times = (stamp_ns, stamp_ns)
                yield BagMessage(topic.name, topic.record, encoding, *times, None, plain)
        except sqlite3.DatabaseError as error:
            raise _no_database(self.path, error) from error


def _no_database(path: Path, error: sqlite3.DatabaseError) -> EpisodeError:
    return EpisodeError(
        path=path,
        found=f"not a finished sqlite3 bag ({error})",
        hint="Copy the bag again, or repair it with: sqlite3 FILE .recover",
    )


def _schema(
    type_name: str, encoding: str, definitions: dict[str, tuple[str, str]]
) -> schema.Schema:
    kind, text = definitions.get(type_name, ("", ""))
    if not text:
        try:
            found = ros_schema(type_name)
        except MissingDependencyError:
            found = schema.schema_for(type_name)
        if found is not None:
            return found
    return schema.Schema(
        name=type_name,
        schema_encoding=kind if text else "",
        message_encoding=encoding,
        data=text.encode(),
    )
