"""Messages in log order, compared with the official reader; chunks that are never read."""

import io
from collections.abc import Iterable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from bridge.episode.mcap import messages as messages_module
from bridge.episode.reader import Episode
from bridge.errors import EpisodeError

Sent = tuple[str, int, bytes]
"""Topic, log time, payload."""


def mcap_bytes(messages: Iterable[Sent], **settings: object) -> bytes:
    """Write messages as another program would."""
    stream = io.BytesIO()
    writer = Writer(stream, **settings)
    writer.start(profile="", library="another program")
    channels: dict[str, int] = {}
    for number, (topic, log_ns, data) in enumerate(messages):
        if topic not in channels:
            schema_id = writer.register_schema(name=f"type of {topic}", encoding="", data=b"x")
            channels[topic] = writer.register_channel(topic, "raw", schema_id)
        writer.add_message(
            channel_id=channels[topic],
            log_time=log_ns,
            data=data,
            publish_time=log_ns // 2,
            sequence=number,
        )
    writer.finish()
    return stream.getvalue()


def official(path: Path, **query: object) -> list[tuple[object, ...]]:
    with path.open("rb") as stream:
        return [
            (channel.topic, schema.name, m.log_time, m.publish_time, m.sequence, m.data)
            for schema, channel, m in make_reader(stream).iter_messages(**query)
        ]


sent = st.lists(
    st.tuples(st.sampled_from(["/a", "/b", "c"]), st.integers(0, 40), st.binary(max_size=60)),
    max_size=40,
)
variants = st.fixed_dictionaries(
    {
        "chunk_size": st.sampled_from([1, 64, 300, 10_000]),
        "compression": st.sampled_from(list(CompressionType)),
        "index_types": st.sampled_from(
            [IndexType.ALL, IndexType.CHUNK, IndexType.ALL & ~IndexType.CHUNK, IndexType.NONE]
        ),
        "use_chunking": st.booleans(),
        "use_statistics": st.booleans(),
        "repeat_channels": st.booleans(),
        "repeat_schemas": st.booleans(),
        "use_summary_offsets": st.booleans(),
    }
)


@given(
    sent,
    variants,
    st.none() | st.sets(st.sampled_from(["/a", "/b", "c", "none"])),
    st.none() | st.integers(0, 40),
    st.none() | st.integers(0, 40),
)
def test_any_file_reads_as_with_the_official_reader(
    tmp_path_factory: pytest.TempPathFactory,
    messages: list[Sent],
    settings: dict[str, object],
    topics: set[str] | None,
    start_ns: int | None,
    end_ns: int | None,
) -> None:
    folder = tmp_path_factory.mktemp("merge")
    path, whole = folder / "x.mcap", folder / "whole.mcap"
    path.write_bytes(mcap_bytes(messages, **settings))
    # The official reader cannot read every variant by its summary; it can read this one.
    whole.write_bytes(mcap_bytes(messages, **settings | WHOLE))
    episode = Episode.open(path)
    if start_ns is not None and end_ns is not None and start_ns > end_ns:
        expected = []
    else:
        expected = official(whole, topics=topics, starting_at=start_ns, ending_before=end_ns)
        if topics == set():
            expected = []
    found = list(map(tuple, episode.messages(topics, start_ns=start_ns, end_ns=end_ns)))
    assert found == expected
    counts = {topic: item.count for topic, item in episode.topics().items()}
    assert counts == {t: sum(m[0] == t for m in messages) for t in {m[0] for m in messages}}
    times = [log_ns for _, log_ns, _ in messages]
    if times:
        assert (episode.start_ns, episode.end_ns) == (min(times), max(times))


WHOLE = {
    "index_types": IndexType.ALL,
    "use_statistics": True,
    "repeat_channels": True,
    "repeat_schemas": True,
}


def test_a_chunk_without_the_topic_is_never_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.mcap"
    messages = [("/big" if n % 10 else "/small", n, bytes(1000)) for n in range(100)]
    path.write_bytes(mcap_bytes(messages, chunk_size=100))
    unpacked = []
    real = messages_module.unpack_chunk
    monkeypatch.setattr(
        messages_module, "unpack_chunk", lambda *a, **k: unpacked.append(1) or real(*a, **k)
    )
    assert len(list(Episode.open(path).messages(["/small"]))) == 10
    assert len(unpacked) == 10


def test_damage_elsewhere_does_not_keep_a_topic_from_being_read(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    messages = [("/a", 1, b"left alone" * 30), ("/b", 2, b"to be damaged" * 30)]
    data = mcap_bytes(messages, chunk_size=100, compression=CompressionType.NONE)
    path.write_bytes(data.replace(b"to be damaged", b"to be d4maged"))
    episode = Episode.open(path)
    assert len(list(episode.messages(["/a"]))) == 1
    with pytest.raises(EpisodeError, match=r"x\.mcap: damaged .*another CRC"):
        list(episode.messages())
