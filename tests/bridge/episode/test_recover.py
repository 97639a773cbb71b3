"""Cut files of several writers, and kill the recovery; what was whole must come back."""

import functools
import json
import os
import random
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_samples import (
    linear,
    put,
    read_all,
    some_messages,
    summary_of,
    write_official,
    write_ours,
)

from bridge.episode.recover import RecoveryError, recover, recover_parts
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter, WriterConfig
from bridge.errors import PathNotFoundError, UsageError

MESSAGES = some_messages(40)
"""In the file that is cut at every byte; ``make soak`` takes twelve, which makes six chunks."""


def cut(path: Path, at: int, name: str = "cut.mcap.part") -> Path:
    """A file as a killed writer leaves it."""
    part = path.with_name(name)
    part.write_bytes(path.read_bytes()[:at])
    return part


def metadata_of(path: Path) -> dict[str, dict[str, str]]:
    with path.open("rb") as stream:
        return {item.name: item.metadata for item in make_reader(stream).iter_metadata()}


@pytest.fixture(params=["ours", "ours unpacked", "zstd", "lz4", "none", "unchunked"])
def whole(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The same messages by our writer and by the official one in all its forms."""
    path = tmp_path / "whole.mcap"
    match request.param:
        case "ours":
            return write_ours(path, MESSAGES)
        case "ours unpacked":
            return write_ours(path, MESSAGES, compress=False)
        case "unchunked":
            return write_official(path, MESSAGES, chunked=False)
        case name:
            return write_official(path, MESSAGES, compression=CompressionType[name.upper()])


def test_a_file_cut_anywhere_gives_back_every_whole_record(whole: Path) -> None:
    size = whole.stat().st_size
    rng = random.Random(1)
    for at in sorted(rng.sample(range(60, size), 25)):
        part = cut(whole, at)
        expected = linear(part)
        report = recover(part)
        assert report.output == whole.with_name("cut.mcap")
        assert not part.exists()
        found = read_all(report.output)
        assert set(expected) <= set(found) <= set(MESSAGES), at
        assert report.messages == len(found)
        report.output.unlink()


def test_foxgloves_unfinished_tail_chunk_is_understood(tmp_path: Path) -> None:
    whole = write_official(tmp_path / "w.mcap", MESSAGES, compression=CompressionType.NONE)
    data = bytearray(whole.read_bytes())
    last = summary_of(whole).chunk_indexes[-1]
    head = last.chunk_start_offset
    data[head + 1 : head + 9] = b"\xff" * 8  # length of the record
    data[head + 9 : head + 37] = bytes(28)  # times, size and CRC are filled in at the end
    data[head + 41 : head + 49] = b"\xff" * 8  # length of its data
    part = tmp_path / "fox.mcap.part"
    part.write_bytes(data[: head + last.chunk_length - 40])
    report = recover(part)
    assert report.output is not None
    assert read_all(report.output) == sorted(MESSAGES[: report.messages], key=lambda m: m.log_time)
    assert 0 < report.messages < len(MESSAGES)
    assert f"at byte {head} the file ends inside a chunk" in report.reason


def test_attachments_and_metadata_come_along_and_the_loss_is_declared(whole: Path) -> None:
    report = recover(cut(whole, whole.stat().st_size * 3 // 4))
    assert report.output is not None
    with report.output.open("rb") as stream:
        (attachment,) = make_reader(stream).iter_attachments()
    assert attachment.data == b"hello" * 20
    records = metadata_of(report.output)
    assert {"episode", "software", "recovered"} <= records.keys() or "note" in records
    said = {name: json.loads(value) for name, value in records["recovered"].items()}
    assert said["messages"] == report.messages == len(read_all(report.output))
    assert said["bytes_lost"] == report.bytes_lost
    assert "did not finish" in said["reason"]
    assert said["tool"]["name"] == "robot-gst"
    assert report.attachments == 1


def test_a_finished_part_is_only_renamed(tmp_path: Path) -> None:
    data = write_ours(tmp_path / "w.mcap", MESSAGES).read_bytes()
    part = tmp_path / "f.mcap.part"
    part.write_bytes(data)
    report = recover(part)
    assert report.finished
    assert (report.bytes_lost, report.reason) == (0, "")
    assert (tmp_path / "f.mcap").read_bytes() == data
    assert not part.exists()


def test_a_taken_name_is_not_overwritten(tmp_path: Path) -> None:
    whole = write_ours(tmp_path / "a.mcap", MESSAGES)
    before = whole.read_bytes()
    for expected in ("a_recovered.mcap", "a_recovered_2.mcap"):
        part = cut(whole, 3000, "a.mcap.part")
        assert recover(part).output == tmp_path / expected
    split = cut(whole, 3000, "a.2.mcap.part")
    (tmp_path / "a.2.mcap").touch()
    assert recover(split).output == tmp_path / "a_recovered.2.mcap"
    assert whole.read_bytes() == before


def test_another_writers_broken_file_stays_as_it_is(tmp_path: Path) -> None:
    broken = cut(write_official(tmp_path / "w.mcap", MESSAGES), 4000, "b.mcap")
    before = broken.read_bytes()
    report = recover(broken)
    assert report.output == tmp_path / "b_recovered.mcap"
    assert broken.read_bytes() == before


def test_a_file_being_written_is_left_alone(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path)
    path = run.episodes_dir / "live.mcap"
    with EpisodeWriter(path, config=WriterConfig(flush_s=0.25)) as writer:
        for item in MESSAGES:
            put(writer, item)
        with pytest.raises(RecoveryError, match="still being written"):
            recover(writer.part_path)
        assert recover_parts(run) == []
    assert len(read_all(path)) == len(MESSAGES)


def test_a_part_of_a_dead_writer_is_refused_to_the_next_recording(tmp_path: Path) -> None:
    config = WriterConfig(flush_s=0.25)
    EpisodeWriter(tmp_path / "a.mcap", config=config).abandon()
    with pytest.raises(UsageError, match="robot-gst recover"):
        EpisodeWriter(tmp_path / "a.mcap", config=config)
    EpisodeWriter(tmp_path / "a.mcap").close()  # what can be made again is replaced


def test_every_part_of_a_run_is_recovered_and_the_unreadable_set_aside(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path)
    whole = write_ours(tmp_path / "w.mcap", MESSAGES)
    for name in ("t1", "t2"):
        (run.episodes_dir / f"{name}.mcap.part").write_bytes(whole.read_bytes()[:5000])
    (run.episodes_dir / "t3.mcap.part").write_bytes(b"")
    (run.episodes_dir / "t4.mcap.part").write_bytes(b"no mcap at all" * 100)
    reports = recover_parts(run)
    assert [report.output and report.output.name for report in reports] == [
        "t1.mcap",
        "t2.mcap",
        None,
        None,
    ]
    assert sorted(path.name for path in run.episodes_dir.iterdir()) == [
        "t1.mcap",
        "t2.mcap",
        "t3.mcap.unreadable",
        "t4.mcap.unreadable",
    ]
    assert recover_parts(run) == []


KILL_POINTS = ("pwritev", "fdatasync", "fsync", "rename")


def test_a_recovery_that_was_killed_is_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At every system call that changes a name or the file."""
    whole = write_ours(tmp_path / "w.mcap", MESSAGES)
    at = whole.stat().st_size * 2 // 3
    expected = set(linear(cut(whole, at)))
    for call in KILL_POINTS:
        for nth in range(1, 12):
            part = cut(whole, at)
            again = functools.partial(recover, part)
            with monkeypatch.context() as patch:
                killed = _kill_at(patch, call, nth, again)
            if part.exists():
                recover(part)
            final = part.with_name("cut.mcap")
            assert expected <= set(read_all(final)), (call, nth)
            final.unlink()
            if not killed:
                break


class Killed(BaseException):
    """Stands for a SIGKILL: nobody may handle it."""


def _kill_at(patch: pytest.MonkeyPatch, call: str, nth: int, work: object) -> bool:
    owner = Path if call == "rename" else os
    real = getattr(owner, call)
    count = 0

    def counted(*arguments: object) -> object:
        nonlocal count
        count += 1
        if count == nth:
            raise Killed
        return real(*arguments)

    patch.setattr(owner, call, counted)
    patch.setattr(Path, "unlink", lambda *_, **__: None)  # a killed process tidies nothing
    try:
        work()  # type: ignore[operator]
    except Killed:
        return True
    return False


def test_no_file_and_no_room_are_said_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(PathNotFoundError, match="file not found"):
        recover(tmp_path / "none.mcap.part")
    whole = write_official(tmp_path / "w.mcap", MESSAGES)
    monkeypatch.setattr("shutil.disk_usage", lambda _: _Usage())
    with pytest.raises(RecoveryError, match="Free some space"):
        recover(cut(whole, 4000, "b.mcap"))
    part = cut(whole, 4000)
    with pytest.raises(RecoveryError, match="Free some space"):
        recover(part)
    assert part.is_file()


class _Usage:
    free = 1000


def test_the_command_lists_losses_and_answers_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from robot_gst import run

    whole = write_ours(tmp_path / "w.mcap", MESSAGES)
    cut(whole, 6000, "a.mcap.part")
    assert run(["recover", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "recovered" in text
    assert "bytes lost" in text
    cut(whole, 6000, "b.mcap.part")
    (tmp_path / "c.mcap.part").write_bytes(b"nothing")
    assert run(["recover", str(tmp_path), "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert [bool(item["output"]) for item in answer["files"]] == [True, False]
    assert run(["recover", str(tmp_path / "gone.mcap")]) == 2
