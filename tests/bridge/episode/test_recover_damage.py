"""Flip bytes inside files and make lengths lie: damage costs what it hit, and nothing may hang."""

import os
import random
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_samples import (
    put_foreign,
    read_all,
    some_messages,
    summary_of,
    write_official,
    write_ours,
)

from bridge.episode import schema
from bridge.episode.cdr.messages import JointSample
from bridge.episode.check import check_episode
from bridge.episode.mcap.damaged import RecordFile
from bridge.episode.mcap.format import MESSAGE, MESSAGE_HEAD, MESSAGE_INDEX
from bridge.episode.mcap.scan import Chunk, scan
from bridge.episode.mcap.walk import MAX_CHUNK_BYTES
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.recover import RecoveryReport, recover
from bridge.episode.writer import EpisodeWriter, WriterConfig

MESSAGES = some_messages(40)


def recovered(folder: Path, data: bytes) -> RecoveryReport:
    part = folder / "d.mcap.part"
    part.write_bytes(data)
    return recover(part)


def test_damage_inside_costs_only_the_damaged_chunk(tmp_path: Path) -> None:
    whole = write_ours(tmp_path / "w.mcap", MESSAGES, compress=False)
    hit = summary_of(whole).chunk_indexes[3]
    for offset in (hit.chunk_start_offset + 200, hit.chunk_start_offset + 5):
        data = bytearray(whole.read_bytes())
        data[offset] ^= 0x40
        report = recovered(tmp_path, data)
        assert report.output is not None
        assert len(MESSAGES) - 25 < report.messages < len(MESSAGES)
        assert report.bytes_lost >= hit.chunk_length
        assert f"at byte {hit.chunk_start_offset}" in report.reason
        assert set(read_all(report.output)) < set(MESSAGES)
        assert report.original is not None
        assert report.original.read_bytes() == data
        report.output.unlink()
        report.original.unlink()


def damaged_chunks(whole: Path, numbers: set[int], *, cut: bool) -> bytearray:
    """Flip a bit in some chunks, by their place in the file; ``cut`` also takes the summary."""
    summary = summary_of(whole)
    data = bytearray(whole.read_bytes())
    places = sorted(item.chunk_start_offset for item in summary.chunk_indexes)
    last = max(summary.chunk_indexes, key=lambda item: item.chunk_start_offset)
    for number in numbers:
        data[places[number] + 100] ^= 1
    return data[: last.chunk_start_offset + last.chunk_length] if cut else data


@pytest.mark.parametrize("cut", [True, False])
@pytest.mark.parametrize("number", range(6))
def test_one_damaged_chunk_leaves_no_message_without_its_name(
    tmp_path: Path, number: int, cut: bool
) -> None:
    """Law: definitions stand in another chunk too, and in a summary that is there."""
    whole = write_ours(tmp_path / "w.mcap", MESSAGES, compress=False)
    report = recovered(tmp_path, damaged_chunks(whole, {number}, cut=cut))
    assert report.output is not None
    assert not [topic for topic in report.topics if topic.startswith("/recovered/")]
    assert set(read_all(report.output)) < set(MESSAGES)


def test_messages_whose_definitions_are_all_lost_keep_their_bytes(tmp_path: Path) -> None:
    whole = write_official(tmp_path / "w.mcap", MESSAGES, compression=CompressionType.NONE)
    report = recovered(tmp_path, damaged_chunks(whole, {0}, cut=True))
    assert report.output is not None
    assert any(topic.startswith("/recovered/channel_") for topic in report.topics)
    found = {(item.sequence, item.data) for item in read_all(report.output)}
    assert len(found) == report.messages
    assert found < {(item.sequence, item.data) for item in MESSAGES}
    assert check_episode(report.output).num_faults == 0


def write_whole(path: Path, *, compress: bool) -> Path:
    """An imported episode: held to the format only, whatever its payloads are."""
    config = WriterConfig(compress=compress, chunk_bytes=4096)
    with EpisodeWriter(path, config=config) as writer:
        writer.describe(EpisodeInfo(id="w", kind="imported"))
        for item in MESSAGES:
            kind = f"x/msg/{item.topic.rpartition('/')[2]}"
            record = schema.Schema(
                name=kind, schema_encoding="ros2msg", message_encoding="cdr", data=b"uint8 a\n" * 20
            )
            put_foreign(writer, item, record)
        writer.attach("a.bin", bytes(3000), media_type="x/y", log_time_ns=5)
    return path


def test_one_bit_of_a_derived_episode_costs_a_small_part_of_it(tmp_path: Path) -> None:
    path, count = tmp_path / "replay.mcap", 5000
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="w", kind="imported"))
        for stamp in range(count):
            sample = JointSample(
                stamp_ns=stamp,
                names=("a",),
                position=np.random.default_rng(stamp).random(6),
                velocity=np.zeros(0),
                effort=np.zeros(0),
            )
            writer.write("/j", sample.to_cdr(), type_name=schema.JOINT_STATE, log_time_ns=stamp)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    assert recovered(tmp_path, bytes(data)).messages >= 0.7 * count


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Damage a file in one of the ways disks and copies do."""
    found, size = bytearray(data), len(data)
    at = rng.randrange(size)
    match rng.randrange(8):
        case 0:
            del found[at:]
        case 1:
            found[at] ^= 1 << rng.randrange(8)
        case 2:
            for _ in range(8):
                found[rng.randrange(size)] ^= 1 << rng.randrange(8)
        case 3:
            page = at // 4096 * 4096
            found[page : page + 4096] = bytes(len(found[page : page + 4096]))
        case 4:
            del found[at:]
            if found:
                found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
        case 5:
            found[at:at] = found[at : at + rng.randrange(1, 3000)]
        case 6:
            found[at:at] = rng.randbytes(rng.randrange(1, 200))
        case _:
            del found[at : at + rng.randrange(1, 2000)]
    return bytes(found)


MUTANTS = int(os.environ.get("GST_MUTANTS", "100"))
"""`make soak` goes on to three thousand."""


@pytest.mark.parametrize(
    "seeds", [range(60), pytest.param(range(60, 60 + MUTANTS), marks=pytest.mark.slow)]
)
def test_what_recover_writes_passes_the_check_whatever_the_damage(
    tmp_path: Path, seeds: range
) -> None:
    """Law: no fault in its output and no message altered, whoever wrote the file."""
    bases = [
        write_whole(tmp_path / "packed.mcap", compress=True),
        write_whole(tmp_path / "plain.mcap", compress=False),
        write_official(tmp_path / "official.mcap", MESSAGES),
    ]
    payloads = {item.data for item in MESSAGES}
    faults = {}
    for seed in seeds:
        rng = random.Random(seed)
        part = tmp_path / f"m{seed}.mcap.part"
        part.write_bytes(mutated(rng.choice(bases).read_bytes(), rng))
        report = recover(part)
        if report.output is None:
            continue
        found = check_episode(report.output)
        if found.faults:
            faults[seed] = found.faults
        assert {item.data for item in read_all(report.output)} <= payloads
        for left in tmp_path.glob(f"m{seed}.*"):
            left.unlink()
    assert not faults


def test_a_message_that_calls_itself_an_index_is_not_lost_unsaid(tmp_path: Path) -> None:
    data = bytearray(write_official(tmp_path / "w.mcap", MESSAGES, chunked=False).read_bytes())
    at = data.index(MESSAGES[20].data) - MESSAGE_HEAD.size
    assert data[at] == MESSAGE
    data[at] = MESSAGE_INDEX
    report = recovered(tmp_path, data)
    assert report.output is not None
    assert set(MESSAGES) - set(read_all(report.output)) == {MESSAGES[20]}
    assert report.bytes_lost >= len(MESSAGES[20].data)


def test_a_chunk_head_that_lies_about_its_times_is_put_right(tmp_path: Path) -> None:
    """No CRC of the format covers it."""
    whole = write_whole(tmp_path / "w.mcap", compress=False)
    data = bytearray(whole.read_bytes())
    data[summary_of(whole).chunk_indexes[0].chunk_start_offset + 9 + 6] ^= 1
    report = recovered(tmp_path, data)
    assert report.output is not None
    assert read_all(report.output) == read_all(whole)
    assert check_episode(report.output).num_faults == 0


def test_a_damaged_record_about_the_episode_is_kept_aside(tmp_path: Path) -> None:
    whole = write_whole(tmp_path / "w.mcap", compress=False)
    data = whole.read_bytes().replace(b'"imported"', b'"importe\0"'[:9] + b'"', 1)
    data = data.replace(b"stand_in\x05\0\0\0false", b"stand_in\x05\0\0\0fals*", 1)
    report = recovered(tmp_path, data)
    assert report.output is not None
    with report.output.open("rb") as stream:
        names = [record.name for record in make_reader(stream).iter_metadata()]
    assert "episode.damaged" in names
    assert check_episode(report.output).num_faults == 0


def test_a_chunk_that_claims_terabytes_is_refused(tmp_path: Path) -> None:
    whole = write_official(tmp_path / "w.mcap", MESSAGES)
    data = bytearray(whole.read_bytes())
    summary = summary_of(whole)
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


@pytest.mark.parametrize("name", ["d.mcap.part", "d.mcap"])
def test_a_chunk_that_stands_twice_is_kept_once(tmp_path: Path, name: str) -> None:
    whole = write_ours(tmp_path / "w.mcap", MESSAGES, compress=False).read_bytes()
    with (tmp_path / "w.mcap").open("rb") as stream:
        chunks = [
            found
            for found in scan(RecordFile(stream))
            if isinstance(found, Chunk) and found.contents.index
        ]
    second = bytes(chunks[1].raw)
    at = whole.index(second) + len(second)
    (tmp_path / name).write_bytes(whole[:at] + second + whole[at:])
    report = recover(tmp_path / name)
    assert report.output is not None
    assert sorted(read_all(report.output)) == sorted(MESSAGES)
