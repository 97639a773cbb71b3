"""The channels of a file being written: one for each topic and schema, numbered as they come."""

from bridge.episode import schema
from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.chunks import OpenChunk
from bridge.episode.mcap.summary import Summary


class Channel:
    """One topic with one schema, and the chunk its messages go to."""

    __slots__ = ("definition", "group", "id", "is_large", "next_sequence", "type_name")

    def __init__(self, channel_id: int, type_name: str, definition: bytes) -> None:
        """Begin without a group."""
        self.id = channel_id
        self.type_name = type_name
        self.definition = definition
        """Schema and channel records, repeated in every group the channel writes to."""
        self.next_sequence = 0
        self.is_large = False
        self.group: OpenChunk | None = None


class Channels:
    """Finds or makes the channel of a message, and tells the summary of new ones.

    A topic whose schema changes its text, not only its name, gets a second channel.
    """

    def __init__(self, summary: Summary) -> None:
        """Begin without channels."""
        self._summary = summary
        self._schemas: dict[tuple[str, str, bytes], tuple[int, bytes]] = {}
        self._channels: dict[tuple[str, str, int], Channel] = {}
        self._known: dict[tuple[str, int, str], tuple[Channel, schema.Schema | None]] = {}

    def find(self, topic: str, record: schema.Schema | None, message_encoding: str) -> Channel:
        """Return the channel of a topic.

        Args:
            topic: With its leading slash.
            record: Schema of the messages, or none.
            message_encoding: Used where there is no schema.
        """
        # Comparing schemas by identity spares hashing their text for every message; the value
        # keeps the schema alive, so that its identity is not given to another.
        quick_key = (topic, id(record), message_encoding)
        found = self._known.get(quick_key)
        if found is not None:
            return found[0]
        encoding = message_encoding if record is None else record.message_encoding
        schema_id, definition = (0, b"") if record is None else self._schema(record)
        key = (topic, encoding, schema_id)
        channel = self._channels.get(key)
        if channel is None:
            channel_id = len(self._channels) + 1
            encoded = mcap_format.channel(channel_id, schema_id, topic, encoding)
            type_name = "" if record is None else record.name
            channel = Channel(channel_id, type_name, definition + encoded)
            self._channels[key] = channel
            self._summary.channels[channel_id] = encoded
        self._known[quick_key] = (channel, record)
        return channel

    def _schema(self, record: schema.Schema) -> tuple[int, bytes]:
        key = (record.name, record.schema_encoding, record.data)
        if key not in self._schemas:
            schema_id = len(self._schemas) + 1
            encoded = mcap_format.schema(schema_id, *key)
            self._schemas[key] = (schema_id, encoded)
            self._summary.schemas[schema_id] = encoded
        return self._schemas[key]
