"""Laws of the writer: when a message is in the file, how large a chunk is, which times it says."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_samples import summary_of

from bridge.episode.writer import EpisodeWriter, WriterConfig


@given(
    gaps=st.lists(st.integers(0, 120), min_size=1, max_size=30),
    flush=st.integers(50, 400),
)
@settings(max_examples=50)
def test_no_message_waits_longer_than_the_flush_time(
    tmp_path_factory: pytest.TempPathFactory, gaps: list[int], flush: int
) -> None:
    """However often new ones come: the oldest decides. Younger than that, none is written."""
    now = 0
    config = WriterConfig(flush_s=flush / 1024)
    path = tmp_path_factory.mktemp("run") / "e.mcap"
    writer = EpisodeWriter(path, config=config, monotonic=lambda: now / 1024)
    oldest: int | None = None
    for gap in gaps:
        now += gap
        before = writer.part_path.stat().st_size
        writer.tick()
        writer.wait_for_disk()  # in no time: the disk is not slow
        is_due = oldest is not None and now - oldest >= flush
        assert (writer.part_path.stat().st_size > before) is is_due
        oldest = None if is_due else oldest
        writer.write("/a", b"x", schema_record=None, log_time_ns=now)
        oldest = now if oldest is None else oldest
    writer.discard()


@given(st.lists(st.integers(1, 400), min_size=1, max_size=60), st.integers(500, 1500))
@settings(max_examples=30)
def test_a_chunk_of_several_messages_is_as_large_as_asked_at_most(
    tmp_path_factory: pytest.TempPathFactory, lengths: list[int], chunk_bytes: int
) -> None:
    path = tmp_path_factory.mktemp("run") / "e.mcap"
    with EpisodeWriter(path, config=WriterConfig(chunk_bytes=chunk_bytes)) as writer:
        for number, length in enumerate(lengths):
            writer.write("/a", bytes(length), schema_record=None, log_time_ns=number)
    head = 31  # of the message that is added last
    sizes = [chunk.uncompressed_size for chunk in summary_of(path).chunk_indexes]
    assert max(sizes) <= chunk_bytes + head
    assert sum(sizes) >= sum(lengths)


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=40))
@settings(max_examples=30)
def test_a_chunk_says_its_first_and_last_time_in_whatever_order_messages_come(
    tmp_path_factory: pytest.TempPathFactory, times: list[int]
) -> None:
    path = tmp_path_factory.mktemp("run") / "e.mcap"
    with EpisodeWriter(path, config=WriterConfig(chunk_bytes=300)) as writer:
        for stamp in times:
            writer.write("/a", bytes(20), schema_record=None, log_time_ns=stamp)
    summary = summary_of(path)
    for chunk in summary.chunk_indexes:
        assert chunk.message_start_time <= chunk.message_end_time
        assert {chunk.message_start_time, chunk.message_end_time} <= set(times)
    assert summary.statistics is not None
    assert summary.statistics.message_start_time == min(times)
    assert summary.statistics.message_end_time == max(times)
    assert min(chunk.message_start_time for chunk in summary.chunk_indexes) == min(times)
    assert max(chunk.message_end_time for chunk in summary.chunk_indexes) == max(times)
