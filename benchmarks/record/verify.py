"""Compare a recording with what its publisher says it sent, message by message."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from bridge.episode import schema
from bridge.episode.cdr import codec
from record.cell import CellSpec, Stream, streams_of

COLOR_SAMPLE = 50
"""Colour is lossy: every so manyth picture is decoded and its size compared."""


@dataclass(kw_only=True)
class TopicVerdict:
    """What became of one topic."""

    wanted: int = 0
    """Messages due in the time; more than sent when the publisher had to wait or was late."""
    sent: int = 0
    kept: int = 0
    repeated: int = 0
    unequal: int = 0
    """Kept, but not what was sent; images of another size count."""
    unsent: int = 0
    """In the file, but never sent."""
    declared: int | None = None
    """Lost by the recorder's ledger; None without one."""
    put_ns: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def lost(self) -> int:
        """By the sender's count."""
        return self.sent - self.kept

    @property
    def is_exact(self) -> bool:
        """Nothing altered, and the ledger says what the sender says."""
        return self.unequal + self.unsent + self.repeated == 0 and self.declared == self.lost


def read_account(path: Path, *, as_of: Sequence[Stream]) -> dict[str, TopicVerdict]:
    """What the publisher sent, by topic."""
    found = {}
    with np.load(path) as account:
        for stream in as_of:
            sent = len(account[f"stamps_ns:{stream.topic}"])
            found[stream.topic] = TopicVerdict(
                sent=sent,
                wanted=sent + int(account[f"skipped:{stream.topic}"]),
                put_ns=account[f"put_ns:{stream.topic}"],
            )
    return found


def messages_of(files: Sequence[Path]) -> Iterator[tuple[str, Channel, Message]]:
    """Every message of the bench's topics: type name, channel, message; CRCs are checked.

    Record by record: the library's reader by index keeps the chunks of ten minutes in memory.
    """
    for path in files:
        schemas: dict[int, str] = {0: ""}
        channels: dict[int, Channel] = {}
        with path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    if channel.topic.startswith("/bench/"):
                        yield schemas[channel.schema_id], channel, record


def verify(files: Sequence[Path], account: Path, spec: CellSpec) -> dict[str, TopicVerdict]:
    """Compare every message with what was sent under its number."""
    streams = {stream.topic: stream for stream in streams_of(spec)}
    verdicts = read_account(account, as_of=list(streams.values()))
    with np.load(account) as data:
        stamps = {topic: data[f"stamps_ns:{topic}"] for topic in streams}
    seen: dict[str, set[int]] = {topic: set() for topic in streams}
    for type_name, channel, message in messages_of(files):
        topic = channel.topic
        if topic not in streams:  # of another publisher, with its own account
            continue
        verdict, number = verdicts[topic], message.sequence
        if number >= len(stamps[topic]):
            verdict.unsent += 1
        elif number in seen[topic]:
            verdict.repeated += 1
        else:
            seen[topic].add(number)
            expected = streams[topic].message(number, int(stamps[topic][number]))
            verdict.unequal += not _is_same(streams[topic], type_name, message, expected)
    declared = _declared(files)
    for topic, verdict in verdicts.items():
        verdict.kept = len(seen[topic])
        verdict.declared = None if declared is None else declared.get(topic, 0)
    return verdicts


def _is_same(stream: Stream, type_name: str, message: Message, expected: bytearray) -> bool:
    if type_name != schema.COMPRESSED_IMAGE:
        return message.data == expected
    found = codec.decode(schema.COMPRESSED_IMAGE, message.data)
    sent = codec.decode(schema.IMAGE, bytes(expected))
    if found["header"] != sent["header"]:
        return False
    if stream.is_color:
        return message.sequence % COLOR_SAMPLE != 0 or _is_size(found["data"], sent)
    depth = _depth(found, message.data)
    return bool(np.array_equal(depth, np.frombuffer(sent["data"], "<u2").reshape(depth.shape)))


def _is_size(jpeg: bytes, sent: dict[str, Any]) -> bool:
    import simplejpeg

    height, width, _, _ = simplejpeg.decode_jpeg_header(jpeg)
    return (height, width) == (sent["height"], sent["width"])


def _depth(found: dict[str, Any], data: bytes) -> np.ndarray:
    if found["format"] == "png":  # the reference's
        import cv2

        return cv2.imdecode(np.frombuffer(found["data"], np.uint8), cv2.IMREAD_UNCHANGED)
    from bridge.episode.cdr.messages import DepthImage

    return DepthImage.from_message(schema.COMPRESSED_IMAGE, data).depth_mm


def _declared(files: Sequence[Path]) -> dict[str, int] | None:
    """What the recorder's ledger says was lost, by topic."""
    total: dict[str, int] | None = None
    for path in files:
        with path.open("rb") as stream:
            for record in make_reader(stream).iter_metadata():
                if record.name == "drops":
                    total = {} if total is None else total
                    for topic, counts in json.loads(record.metadata["topics"]).items():
                        names = ("gaps", "queue_drops")
                        lost = sum(counts.get(name, 0) for name in names)
                        total[topic] = total.get(topic, 0) + lost
    return total
