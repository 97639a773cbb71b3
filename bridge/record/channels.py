"""Which schema each message of an episode is written with, and how it is looked at."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bridge.episode import schema
from bridge.errors import MissingDependencyError
from bridge.record.inspection import Finding, inspector
from bridge.wire.ros_types import ros_schema, type_hash_of
from bridge.wire.session import WireSample

HASH_PREFIX = "RIHS01_"
_SHOWN = len(HASH_PREFIX) + 12


@dataclass(slots=True)
class Channel:
    """One topic with one definition of its type."""

    record: schema.Schema | None
    inspect: Callable[[bytes], Finding]
    last_ns: list[int]
    """Shared by the channels of a topic."""

    def later(self, stamp_ns: int) -> int:
        """Log times of a topic never run backwards, also when two threads deliver at once."""
        last_ns = self.last_ns
        if stamp_ns > last_ns[0]:
            last_ns[0] = stamp_ns
        return last_ns[0]


class Channels:
    """Remembers the channels of one episode; a topic with two definitions gets two."""

    def __init__(
        self, max_topics: int, warn: Callable[[str], None], msg_folder: Path | None = None
    ) -> None:
        """Start empty.

        Args:
            max_topics: Further ones are refused.
            warn: Called with what a person should know.
            msg_folder: Definitions of ROS 2 types of one's own.
        """
        self._msg_folder = msg_folder
        self._max_topics = max_topics
        self._warn = warn
        self._channels: dict[tuple[str, str, str, str], Channel] = {}
        self._last_ns: dict[str, list[int]] = {}
        self._records: dict[str, schema.Schema | None] = {}
        self._hashes: dict[str, str] = {}

    def of(self, sample: WireSample, type_name: str) -> Channel | None:
        """Return the channel of a message, or None when there are too many."""
        key = (sample.topic, type_name, sample.message_encoding, sample.type_hash)
        channel = self._channels.get(key)
        if channel is None and len(self._channels) < self._max_topics:
            channel = self._channels[key] = self._new(sample, type_name)
        return channel

    def later(self, topic: str, stamp_ns: int) -> int:
        """Return a log time for a record of our own."""
        last_ns = self._last_ns.setdefault(topic, [0])
        last_ns[0] = max(last_ns[0], stamp_ns)
        return last_ns[0]

    def _new(self, sample: WireSample, type_name: str) -> Channel:
        topic = sample.topic
        record, is_strange = self._schema(sample, type_name)
        if self._records.setdefault(topic, record) != record:
            self._warn(f"{topic} carries several definitions, each on a channel of its own")
        if is_strange:
            self._warn(
                f"{topic}: {type_name} was built from another definition ({sample.type_hash})"
            )
        look = inspector("" if is_strange else type_name, sample.message_encoding)
        last_ns = self._last_ns.setdefault(topic, [0])
        return Channel(record, look, last_ns)

    def _schema(self, sample: WireSample, type_name: str) -> tuple[schema.Schema | None, bool]:
        """The schema to register: a known one, one with a name only, or none; and if it is strange.

        MCAP reads an empty schema encoding as "no schema available", which keeps the name. A
        definition that nobody knows must not borrow another's text: its hash goes into the name.
        """
        if not type_name:
            return None, False
        encoding = sample.message_encoding
        known = schema.schema_for(type_name)
        if encoding not in ("", known.message_encoding if known else "cdr"):
            return _name_only(type_name, encoding), False
        type_hash = sample.type_hash if sample.type_hash.startswith(HASH_PREFIX) else ""
        newest = _newest_hash(type_name, self._msg_folder) if type_hash else None
        if known is not None and newest in (None, type_hash):
            return known, False
        found = _from_ros(type_name, type_hash, self._msg_folder)
        if found is not None:
            return found, False
        is_first = not type_hash or self._hashes.setdefault(type_name, type_hash) == type_hash
        if newest is None and is_first:
            return _name_only(type_name, encoding), False
        return _name_only(f"{type_name}#{type_hash[:_SHOWN]}", encoding), True


def _name_only(name: str, encoding: str) -> schema.Schema:
    return schema.Schema(name=name, schema_encoding="", message_encoding=encoding, data=b"")


def _newest_hash(type_name: str, folder: Path | None) -> str | None:
    try:
        return type_hash_of(type_name, folder=folder)
    except MissingDependencyError:
        return None


def _from_ros(type_name: str, type_hash: str, folder: Path | None) -> schema.Schema | None:
    try:
        return ros_schema(type_name, type_hash=type_hash, folder=folder)
    except MissingDependencyError:
        return None
