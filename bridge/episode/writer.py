"""Write one episode: ``<name>.mcap.part`` while open, renamed when complete.

A correct, plain writer over the official ``mcap`` package. Nothing half-written ever carries the
final name; a crash leaves the ``.part`` file.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.writer import CompressionType, Writer

from bridge.episode import metadata, provenance, schema
from bridge.errors import BridgeError, UsageError

PROFILE = "ros2"
LIBRARY = "robot-gst"


class EpisodeWriter:
    """Append messages to a new episode file.

    Topics start with a slash. ``log_time_ns`` is when the message was received,
    ``publish_time_ns`` when its source made it.
    """

    def __init__(self, path: Path) -> None:
        """Create ``<path>.part``; refuses to replace an existing episode."""
        if path.exists():
            message = f"{path} exists already. Choose another name, or move it away."
            raise UsageError(message)
        self.path = path
        self.part_path = path.with_name(path.name + ".part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self.part_path.open("wb")
        except OSError as error:
            message = f"cannot write {self.part_path}: {error.strerror}. Choose another folder."
            raise BridgeError(message) from error
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD, use_statistics=True)
        self._writer.start(profile=PROFILE, library=LIBRARY)
        self._schema_ids: dict[tuple[str, str], int] = {}
        self._channel_ids: dict[tuple[str, str, str], int] = {}
        self._sequences: dict[int, int] = {}
        self._open = True

    def write(
        self,
        topic: str,
        data: bytes,
        *,
        type_name: str,
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """Append one serialised message of a type this project knows."""
        known = schema.schema_for(type_name)
        if known is None:
            message = f"no schema for {type_name!r}; use write_foreign for other types"
            raise ValueError(message)
        self.write_foreign(
            topic,
            data,
            schema_record=known,
            log_time_ns=log_time_ns,
            publish_time_ns=publish_time_ns,
            sequence=sequence,
        )

    def write_foreign(
        self,
        topic: str,
        data: bytes,
        *,
        schema_record: schema.Schema | None,
        message_encoding: str = "",
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """Append one message with the given schema, or none; the bytes are kept as they are."""
        channel_id = self._channel(topic, schema_record, message_encoding)
        if sequence is None:
            sequence = self._sequences.get(channel_id, 0)
        self._sequences[channel_id] = sequence + 1
        self._writer.add_message(
            channel_id=channel_id,
            log_time=log_time_ns,
            data=data,
            publish_time=log_time_ns if publish_time_ns is None else publish_time_ns,
            sequence=sequence & 0xFFFF_FFFF,
        )

    def _channel(self, topic: str, record: schema.Schema | None, message_encoding: str) -> int:
        key = (topic, record.name if record else "", _encoding(record, message_encoding))
        if key not in self._channel_ids:
            self._channel_ids[key] = self._writer.register_channel(
                topic=topic,
                message_encoding=_encoding(record, message_encoding),
                schema_id=0 if record is None else self._schema(record),
            )
        return self._channel_ids[key]

    def _schema(self, record: schema.Schema) -> int:
        key = (record.name, record.schema_encoding)
        if key not in self._schema_ids:
            self._schema_ids[key] = self._writer.register_schema(
                name=record.name, encoding=record.schema_encoding, data=record.data
            )
        return self._schema_ids[key]

    def write_json(
        self,
        topic: str,
        record: Mapping[str, Any],
        *,
        type_name: str,
        log_time_ns: int,
        publish_time_ns: int | None = None,
    ) -> None:
        """Append one JSON record."""
        data = json.dumps(record, separators=(",", ":")).encode()
        self.write(
            topic,
            data,
            type_name=type_name,
            log_time_ns=log_time_ns,
            publish_time_ns=publish_time_ns,
        )

    def attach(self, name: str, data: bytes, *, media_type: str, log_time_ns: int) -> None:
        """Add an attachment, for example ``robot.urdf``."""
        self._writer.add_attachment(
            create_time=log_time_ns,
            log_time=log_time_ns,
            name=name,
            media_type=media_type,
            data=data,
        )

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record of plain strings."""
        self._writer.add_metadata(name, dict(values))

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
        if outcome is not None:
            self.add_metadata("outcome", metadata.to_strings(outcome))
        if derived is not None:
            self.add_metadata("derived", metadata.to_strings(derived))

    def close(self) -> Path:
        """Finish, sync to disk and give the file its final name."""
        if self._open:
            self._open = False
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            self.part_path.rename(self.path)
            _sync_folder(self.path.parent)
        return self.path

    def abandon(self) -> None:
        """Stop without finishing; the ``.part`` file stays for recovery."""
        if self._open:
            self._open = False
            self._stream.close()

    def discard(self) -> None:
        """Stop and remove the ``.part`` file: the take was not wanted."""
        self.abandon()
        self.part_path.unlink(missing_ok=True)

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
        if error is None:
            self.close()
        else:
            self.abandon()


def _encoding(record: schema.Schema | None, message_encoding: str) -> str:
    return message_encoding if record is None else record.message_encoding


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
