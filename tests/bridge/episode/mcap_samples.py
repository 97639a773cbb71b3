"""Small MCAP files of several writers, and what the official reader finds in a file."""

import io
import random
from pathlib import Path
from typing import NamedTuple

from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer

from bridge.episode import metadata, schema
from bridge.episode.mcap.format import Buffer
from bridge.episode.writer import EpisodeWriter, WriterConfig


class Stored(NamedTuple):
    """One message."""

    topic: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


def read_all(path: Path) -> list[Stored]:
    """Every message, with CRCs checked by the official reader, twice: linear and by index."""
    with path.open("rb") as stream:
        for _ in StreamReader(stream, validate_crcs=True).records:
            pass
        stream.seek(0)
        reader = make_reader(stream, validate_crcs=True)
        found = [
            Stored(c.topic, m.log_time, m.publish_time, m.sequence, m.data)
            for _, c, m in reader.iter_messages()
        ]
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(found)
        for topic in {item.topic for item in found}:
            by_index = sum(1 for _ in reader.iter_messages(topics=[topic]))
            assert by_index == sum(item.topic == topic for item in found)
    return found


def summary_of(path: Path) -> Summary:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary


def linear(path: Path) -> list[Stored]:
    """Messages in file order up to the first damage, by the official stream reader."""
    found, topics = [], {}
    with path.open("rb") as stream:
        try:
            for item in StreamReader(stream, validate_crcs=True).records:
                if type(item).__name__ == "Channel":
                    topics[item.id] = item.topic
                elif type(item).__name__ == "Message":
                    found.append(
                        Stored(
                            topics[item.channel_id],
                            item.log_time,
                            item.publish_time,
                            item.sequence,
                            item.data,
                        )
                    )
        except Exception:  # noqa: BLE001 - a cut file ends in many ways
            pass
    return found


def some_messages(count: int, seed: int = 0) -> list[Stored]:
    """Joints often, depth and a picture sometimes."""
    rng = random.Random(seed)
    found = []
    for index in range(count):
        stamp = 1_000_000 * index
        found.append(Stored("/joint_states", stamp + 9, stamp, index, rng.randbytes(80)))
        if index % 5 == 0:
            depth = b"\0\1\0\0" + b"16UC1\0" + rng.randbytes(10) * 60
            found.append(Stored("/cam/a/depth/image", stamp + 10, stamp + 1, index, depth))
            found.append(
                Stored("/cam/a/color/image", stamp + 11, stamp + 2, index, rng.randbytes(500))
            )
    return found


TYPES = {
    "/joint_states": schema.JOINT_STATE,
    "/cam/a/depth/image": schema.IMAGE,
    "/cam/a/color/image": schema.COMPRESSED_IMAGE,
}


def put_foreign(
    writer: EpisodeWriter,
    item: Stored,
    kind: schema.Schema | None = None,
    data: Buffer | None = None,
) -> None:
    """Write one message of a type that the writer need not know."""
    writer.write(
        item.topic,
        item.data if data is None else data,
        schema_record=kind,
        log_time_ns=item.log_time,
        publish_time_ns=item.publish_time,
        sequence=item.sequence,
    )


def put(writer: EpisodeWriter, item: Stored) -> None:
    """Write one message with everything it has."""
    writer.write(
        item.topic,
        item.data,
        type_name=TYPES[item.topic],
        log_time_ns=item.log_time,
        publish_time_ns=item.publish_time,
        sequence=item.sequence,
    )


def write_ours(
    path: Path, messages: list[Stored], *, chunk_bytes: int = 2000, compress: bool = True
) -> Path:
    """With metadata at the front and an attachment in the middle."""
    config = WriterConfig(chunk_bytes=chunk_bytes, compress=compress)
    with EpisodeWriter(path, config=config) as writer:
        writer.describe(metadata.EpisodeInfo(id="e", kind="trial"))
        for index, item in enumerate(messages):
            if index == len(messages) // 2:
                writer.attach("a.txt", b"hello" * 20, media_type="text/plain", log_time_ns=1)
            put(writer, item)
    return path


def write_official(
    path: Path,
    messages: list[Stored],
    *,
    compression: CompressionType = CompressionType.ZSTD,
    chunked: bool = True,
    chunk_size: int = 2000,
) -> Path:
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=chunk_size, compression=compression, use_chunking=chunked)
    writer.start(profile="ros2", library="official")
    writer.add_metadata("note", {"a": "b"})
    ids: dict[str, int] = {}
    for index, item in enumerate(messages):
        if index == len(messages) // 2:
            writer.add_attachment(1, 1, "a.txt", "text/plain", b"hello" * 20)
        if item.topic not in ids:
            known = schema.schema_for(TYPES[item.topic])
            assert known is not None
            schema_id = writer.register_schema(known.name, known.schema_encoding, known.data)
            ids[item.topic] = writer.register_channel(item.topic, "cdr", schema_id)
        writer.add_message(
            ids[item.topic], item.log_time, item.data, item.publish_time, item.sequence
        )
    writer.finish()
    path.write_bytes(stream.getvalue())
    return path
