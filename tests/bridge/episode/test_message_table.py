"""Payloads of several groups at once are those one by one; strays are named by their file."""

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_reader_merge import Sent, mcap_bytes, sent, variants

from bridge.episode.mcap import messages as messages_module
from bridge.episode.reader import Episode
from bridge.errors import EpisodeError


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
    stray = messages_module.MessageTable(*(np.zeros(1, dtype=kind) for kind in ("u8", "u2", "i8")))
    monkeypatch.setattr(messages_module, "message_table", lambda data: stray)
    with pytest.raises(EpisodeError, match=r"x\.mcap: damaged .*channel 0, which was never"):
        episode.payloads(["/a"])
    with pytest.raises(EpisodeError, match=r"x\.mcap: damaged .*channel 0, which was never"):
        list(episode.messages(["/a"]))
