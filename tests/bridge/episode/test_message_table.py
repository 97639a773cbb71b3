"""Payloads of several groups at once are those one by one; strays are named by their file."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_reader_merge import Sent, mcap_bytes, sent, variants

from bridge.episode.reader import Episode


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
