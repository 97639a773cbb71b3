"""Flip bytes inside files and make lengths lie: damage costs what it hit, and nothing may hang."""

import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_samples import read_all, some_messages, write_official, write_ours

from bridge.episode.mcap.damaged import MAX_CHUNK_BYTES
from bridge.episode.recover import RecoveryError, recover
from bridge.episode.writer import EpisodeWriter

MESSAGES = some_messages(40)


def test_damage_inside_costs_only_the_damaged_chunk(tmp_path: Path) -> None:
    whole = write_ours(tmp_path / "w.mcap", MESSAGES, compress=False)
    with whole.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    hit = summary.chunk_indexes[3]
    for offset in (hit.chunk_start_offset + 200, hit.chunk_start_offset + 5):
        data = bytearray(whole.read_bytes())
        data[offset] ^= 0x40
        part = tmp_path / "d.mcap.part"
        part.write_bytes(data)
        report = recover(part)
        assert report.output is not None
        assert len(MESSAGES) - 25 < report.messages < len(MESSAGES)
        assert report.bytes_lost >= hit.chunk_length
        assert f"at byte {hit.chunk_start_offset}" in report.reason
        assert set(read_all(report.output)) < set(MESSAGES)
        assert report.original is not None
        assert report.original.read_bytes() == data
        report.output.unlink()
        report.original.unlink()


def test_messages_of_a_lost_definition_keep_their_bytes(tmp_path: Path) -> None:
    whole = write_ours(tmp_path / "w.mcap", MESSAGES, compress=False)
    with whole.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    data = bytearray(whole.read_bytes())
    first = min(item.chunk_start_offset for item in summary.chunk_indexes)
    data[first + 100] ^= 1
    part = tmp_path / "d.mcap.part"
    part.write_bytes(data)
    report = recover(part)
    assert report.output is not None
    assert any(topic.startswith("/recovered/channel_") for topic in report.topics)
    assert len(read_all(report.output)) == report.messages


def test_a_chunk_that_claims_terabytes_is_refused(tmp_path: Path) -> None:
    whole = write_official(tmp_path / "w.mcap", MESSAGES)
    data = bytearray(whole.read_bytes())
    with whole.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for size in (1 << 50, MAX_CHUNK_BYTES + 1):
        for item in summary.chunk_indexes:
            struct.pack_into("<Q", data, item.chunk_start_offset + 25, size)
        part = tmp_path / "bomb.mcap.part"
        part.write_bytes(data)
        report = recover(part)
        assert report.output is not None
        assert report.messages == 0
        report.output.unlink()
        if report.original is not None:
            report.original.unlink()


@given(
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), max_size=8),
    keep=st.floats(0, 1),
    compress=st.booleans(),
    in_place=st.booleans(),
)
@settings(max_examples=60)
def test_flipped_bytes_never_crash_it(
    tmp_path_factory: pytest.TempPathFactory,
    flips: list[tuple[float, int]],
    keep: float,
    compress: bool,
    in_place: bool,
) -> None:
    folder = tmp_path_factory.mktemp("flips")
    whole = write_ours(folder / "w.mcap", MESSAGES[:30], compress=compress)
    data = bytearray(whole.read_bytes())
    data = data[: int(len(data) * keep)]
    for place, mask in flips:
        if data:
            data[int(place * len(data))] ^= mask
    part = folder / "f.mcap.part"
    part.write_bytes(data)
    try:
        report = recover(part, in_place=in_place)
    except RecoveryError:  # damage inside needs a copy
        report = recover(part, in_place=False)
    if report.output is not None:
        assert len(read_all(report.output)) == report.messages


@given(data=st.binary(max_size=400))
@settings(max_examples=60)
def test_any_bytes_after_a_good_front_never_crash_it(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    folder = tmp_path_factory.mktemp("bytes")
    part = folder / "f.mcap.part"
    writer = EpisodeWriter(folder / "f.mcap")
    writer.abandon()
    part.write_bytes(part.read_bytes() + data)
    report = recover(part)
    assert report.output is not None
    assert len(read_all(report.output)) == report.messages
