"""Chunks, groups, times and sequences as the official reader sees them; full and broken disks."""

import errno
import os
import resource
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_samples import Stored, put, put_foreign, read_all, some_messages, summary_of, write_ours

from bridge.episode import schema
from bridge.episode.recover import RecoveryError, recover
from bridge.episode.writer import EpisodeWriter, WriterConfig
from bridge.errors import BridgeError, UsageError

MESSAGES = some_messages(60)
NO_FLUSH = WriterConfig(chunk_bytes=1500)


U64 = st.integers(0, 2**64 - 1)
STORED = st.builds(
    Stored,
    topic=st.sampled_from(["/a", "/b", "/odd name/ü", "/cam/c/depth/image"]),
    log_time=U64,
    publish_time=U64,
    sequence=st.integers(0, 2**32 - 1),
    data=st.binary(max_size=300),
)


@given(messages=st.lists(STORED, max_size=40), chunk_bytes=st.integers(1, 2000))
@settings(max_examples=40)
def test_every_message_comes_back_with_its_times_and_sequence(
    tmp_path_factory: pytest.TempPathFactory, messages: list[Stored], chunk_bytes: int
) -> None:
    path = tmp_path_factory.mktemp("law") / "e.mcap"
    image = schema.schema_for(schema.IMAGE)
    with EpisodeWriter(path, config=WriterConfig(chunk_bytes=chunk_bytes)) as writer:
        for item in messages:
            kind = image if item.topic.endswith("image") else None
            put_foreign(writer, item, kind, memoryview(item.data))
    assert sorted(read_all(path)) == sorted(messages)


def test_one_topic_keeps_its_order_when_it_grows_large(tmp_path: Path) -> None:
    path = tmp_path / "e.mcap"
    with EpisodeWriter(path) as writer:
        for index in range(20):
            data = bytes([index]) * (10 if index < 10 else 100_000)
            writer.write("/cloud", data, schema_record=None, log_time_ns=7)
    assert [item.data[0] for item in read_all(path)] == list(range(20))
    assert len(summary_of(path).chunk_indexes) > 1


def test_large_streams_have_chunks_of_their_own_and_packed_images_stay_as_they_are(
    tmp_path: Path,
) -> None:
    summary = summary_of(write_ours(tmp_path / "e.mcap", MESSAGES))
    topics = {number: channel.topic for number, channel in summary.channels.items()}
    compression: dict[str, set[str]] = {}
    for chunk in summary.chunk_indexes:
        (topic,) = {topics[number] for number in chunk.message_index_offsets}
        compression.setdefault(topic, set()).add(chunk.compression)
    assert compression["/cam/a/color/image"] == {""}
    assert compression["/cam/a/depth/image"] == {"zstd"}
    assert "/joint_states" in compression


def test_small_topics_share_their_chunks(tmp_path: Path) -> None:
    path = tmp_path / "e.mcap"
    with EpisodeWriter(path) as writer:
        for index in range(50):
            for topic in ("/a", "/b", "/c"):
                writer.write(topic, b"0" * 50, schema_record=None, log_time_ns=index)
    (chunk,) = summary_of(path).chunk_indexes
    assert len(chunk.message_index_offsets) == 3
    assert chunk.compression == "zstd"


def test_one_topic_with_two_schemas_of_one_name_has_two_channels(tmp_path: Path) -> None:
    path = tmp_path / "e.mcap"
    texts = (b"int32 a", b"int64 a")
    with EpisodeWriter(path) as writer:
        for index in range(6):
            record = schema.Schema(
                name="x/Y",
                schema_encoding="ros2msg",
                message_encoding="cdr",
                data=texts[index % 2],
            )
            writer.write("/t", bytes([index]), schema_record=record, log_time_ns=index)
    summary = summary_of(path)
    assert [item.data for item in summary.schemas.values()] == list(texts)
    assert {item.topic for item in summary.channels.values()} == {"/t"}
    assert summary.statistics is not None
    assert summary.statistics.channel_message_counts == {1: 3, 2: 3}
    assert [item.sequence for item in read_all(path)] == [0, 0, 1, 1, 2, 2]


def test_attachments_and_metadata_are_in_the_file_at_once(tmp_path: Path) -> None:
    writer = EpisodeWriter(tmp_path / "e.mcap")
    put(writer, MESSAGES[0])
    writer.add_metadata("note", {"where": "here"})
    writer.attach("a.bin", b"the attachment", media_type="", log_time_ns=1)
    data = writer.part_path.read_bytes()
    assert b"here" in data
    assert b"the attachment" in data
    writer.discard()
    assert list(tmp_path.iterdir()) == []


def test_a_number_that_does_not_fit_is_refused_and_costs_nothing(tmp_path: Path) -> None:
    path = tmp_path / "e.mcap"
    with EpisodeWriter(path) as writer:
        with pytest.raises(struct.error):
            writer.write("/t", b"x", schema_record=None, log_time_ns=-1)
        put(writer, MESSAGES[0])
    assert len(read_all(path)) == 1


def test_two_writers_never_share_a_name(tmp_path: Path) -> None:
    path = tmp_path / "e.mcap"
    with EpisodeWriter(path) as writer:
        put(writer, MESSAGES[0])
        with pytest.raises(UsageError, match="another writer"):
            EpisodeWriter(path)
        with pytest.raises(UsageError, match="another writer"):
            EpisodeWriter(path, config=WriterConfig(flush_s=0.1))
    assert len(read_all(path)) == 1
    with pytest.raises(UsageError, match="exists already"):
        EpisodeWriter(path)


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 400 kB."""
    folder = tmp_path / "small"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small file system needs more rights than this machine gives")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_said_at_once_and_nothing_is_lost_when_it_has_room_again(
    full_disk: Path,
) -> None:
    ballast = full_disk / "ballast"
    ballast.write_bytes(bytes(200_000))
    writer = EpisodeWriter(full_disk / "e.mcap", config=WriterConfig(chunk_bytes=20_000))
    items = [Stored("/t", index, index, index, os.urandom(800)) for index in range(400)]
    taken = write_until_refused(writer, items)
    assert 100 < len(taken) < len(items)
    for _ in range(3):
        with pytest.raises(OSError, match="No space"):
            put_foreign(writer, items[len(taken)])
    with pytest.raises(OSError, match="No space"):
        writer.close()
    with pytest.raises(OSError, match="No space"):
        writer.tick()
    ballast.unlink()
    last = Stored("/t", 10_000, 10_000, 10_000, b"last")
    put_foreign(writer, last)
    assert read_all(writer.close()) == [*taken, last]


def write_until_refused(writer: EpisodeWriter, items: list[Stored]) -> list[Stored]:
    """Return the messages that were taken before the disk refused one."""
    taken = []
    for item in items:
        try:
            put_foreign(writer, item)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EFBIG):
                raise
            break
        taken.append(item)
    return taken


def test_what_a_full_disk_holds_can_be_recovered_elsewhere(full_disk: Path, tmp_path: Path) -> None:
    writer = EpisodeWriter(full_disk / "e.mcap", config=WriterConfig(chunk_bytes=20_000))
    items = [Stored("/t", index, index, index, os.urandom(800)) for index in range(1000)]
    count = len(write_until_refused(writer, items))
    writer.abandon()
    with pytest.raises(RecoveryError, match="Free some space"):
        recover(writer.part_path)
    report = recover(Path(shutil.copy(writer.part_path, tmp_path)))
    assert report.output is not None
    assert report.bytes_lost == 0
    assert count - 50 < len(read_all(report.output)) <= count


def test_a_file_size_limit_is_an_error_like_a_full_disk(tmp_path: Path) -> None:
    writer = EpisodeWriter(tmp_path / "e.mcap", config=NO_FLUSH)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    items = [Stored("/t", index, index, index, os.urandom(100)) for index in range(200)]
    try:
        taken = write_until_refused(writer, items)
        with pytest.raises(OSError, match="File too large"):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert 50 < len(taken) < len(items)
    assert read_all(writer.close()) == taken


def broken_disk(_: int) -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_a_failed_background_sync_is_raised_by_the_next_call_and_forever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = WriterConfig(flush_s=0.0, sync_s=0.001)
    writer = EpisodeWriter(tmp_path / "e.mcap", config=config)
    put(writer, MESSAGES[0])
    writer.tick()
    monkeypatch.setattr(os, "fdatasync", broken_disk)
    writer.attach("a", b"something to sync", media_type="", log_time_ns=1)
    deadline = time.monotonic() + 5
    with suppress(OSError):
        while time.monotonic() < deadline:
            writer.tick()
            threading.Event().wait(0.001)
    calls = (
        lambda: put(writer, MESSAGES[1]),
        writer.tick,
        lambda: writer.add_metadata("a", {}),
        writer.close,
        writer.close,
    )
    for call in calls:
        with pytest.raises(OSError, match="Input/output error"):
            call()
    writer.abandon()
    assert not writer.path.exists()
    monkeypatch.undo()
    assert recover(writer.part_path).messages == 1


def test_a_failed_last_sync_leaves_the_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fdatasync", broken_disk)
    with (
        pytest.raises(OSError, match="Input/output error"),
        EpisodeWriter(tmp_path / "e.mcap") as writer,
    ):
        put(writer, MESSAGES[0])
    assert [path.name for path in tmp_path.iterdir()] == ["e.mcap.part"]


def test_a_folder_that_cannot_be_written_is_said_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BridgeError, match="Choose another folder"):
        EpisodeWriter(tmp_path / "file" / "e.mcap")
