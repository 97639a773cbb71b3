"""The messages of a chunk by its index are those a walk finds; payloads at once as one by one."""

import random
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_reader_merge import Sent, mcap_bytes, sent, variants

from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap import messages as messages_module
from bridge.episode.mcap.data_section import OpenChunk
from bridge.episode.mcap.messages import by_index, by_walk, message_table
from bridge.episode.mcap.walk import BrokenRecordError
from bridge.episode.reader import Episode
from bridge.errors import EpisodeError

Message = tuple[int, int, bytes]
"""Channel, log time, payload."""


def chunk(messages: Sequence[Message], *, extra: bytes = b"") -> tuple[bytes, bytes]:
    """Return a chunk's records and its message index records, as our writer makes them."""
    filling = OpenChunk(compress=False, gather=True)
    for channel_id in sorted({channel_id for channel_id, _, _ in messages}):
        filling.define(mcap_format.channel(channel_id, 0, f"/{channel_id}", "raw"))
    for number, (channel_id, log_ns, data) in enumerate(messages):
        filling.add(channel_id, number, log_ns, log_ns // 2, data, len(data))
    if extra:
        filling.define(extra)
    encoded = filling.encode()
    data = b"".join(map(bytes, encoded.buffers[1:]))
    listed = [mcap_format.message_index(*item) for item in encoded.index.items()]
    return data, b"".join(listed)


def same(
    found: messages_module.MessageTable | None, expected: messages_module.MessageTable
) -> bool:
    return found is not None and all(map(np.array_equal, found, expected))


messages = st.lists(
    st.tuples(st.integers(0, 4), st.integers(0, 2**64 - 1), st.binary(max_size=40)),
    min_size=1,
    max_size=30,
)


@given(messages, st.binary(max_size=5))
def test_the_index_gives_what_a_walk_finds(given: list[Message], note: bytes) -> None:
    data, index = chunk(given, extra=mcap_format.record(0x80, note))
    assert same(by_index(data, index), by_walk(data))


@given(messages, st.data())
def test_a_wrong_index_changes_nothing(given: list[Message], draw: st.DataObject) -> None:
    data, index = chunk(given)
    wrong = bytearray(index)
    for _ in range(draw.draw(st.integers(1, 3))):
        wrong[draw.draw(st.integers(0, len(wrong) - 1))] = draw.draw(st.integers(0, 255))
    cut = draw.draw(st.integers(0, len(wrong)))
    for other in (bytes(wrong), bytes(wrong[:cut]), index + index, index + bytes(wrong)):
        assert same(message_table(data, other), by_walk(data))


@given(messages, st.data())
def test_records_that_are_wrong_are_refused_either_way(
    given: list[Message], draw: st.DataObject
) -> None:
    data, index = chunk(given)
    wrong = bytearray(data)
    place = draw.draw(st.integers(0, len(wrong) - 1))
    wrong[place] = draw.draw(st.integers(0, 255))
    try:
        expected = by_walk(bytes(wrong))
    except BrokenRecordError:
        with pytest.raises(BrokenRecordError):
            message_table(bytes(wrong), index)
    else:
        assert same(message_table(bytes(wrong), index), expected)


def test_an_index_that_leaves_a_message_out_is_not_believed() -> None:
    data, _ = chunk([(1, 5, b"a"), (1, 6, b"b"), (2, 7, b"c")])
    _, index = chunk([(1, 5, b"a"), (1, 6, b"b")])
    empty = mcap_format.message_index(1, [])
    for listed in (index, empty, b""):
        assert by_index(data, listed) is None
        assert len(message_table(data, listed).starts) == 3


@given(sent, variants, st.lists(st.sets(st.sampled_from(["/a", "/b", "c", "none"])), max_size=3))
def test_payloads_at_once_are_those_one_by_one(
    tmp_path_factory: pytest.TempPathFactory,
    given: list[Sent],
    settings: dict[str, object],
    groups: list[set[str]],
) -> None:
    path = tmp_path_factory.mktemp("payloads") / "x.mcap"
    path.write_bytes(mcap_bytes(given, **settings))
    episode = Episode.open(path)
    found = episode.payloads(*groups)
    assert found == [[message.data for message in episode.messages(topics)] for topics in groups]


def test_a_stray_or_damaged_chunk_is_named_by_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.mcap"
    stamps = [random.Random(n).randrange(100) for n in range(50)]
    path.write_bytes(mcap_bytes([("/a", n, b"payload") for n in stamps], chunk_size=300))
    episode = Episode.open(path)
    (found,) = episode.payloads(["/a"])
    assert len(found) == 50
    stray = messages_module.MessageTable(
        *(np.zeros(1, dtype=kind) for kind in ("u8", "u2", "i8", "i8"))
    )
    monkeypatch.setattr(messages_module, "message_table", lambda data, index: stray)
    with pytest.raises(EpisodeError, match=r"x\.mcap: damaged .*channel 0, which was never"):
        episode.payloads(["/a"])
    with pytest.raises(EpisodeError, match=r"x\.mcap: damaged .*channel 0, which was never"):
        list(episode.messages(["/a"]))
