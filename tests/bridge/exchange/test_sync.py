"""A run copied elsewhere: every byte verified, whatever interrupts it, and none sent twice."""

import hashlib
import json
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robot_gst
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.exchange import sync as syncing
from bridge.exchange.sync import FolderTarget, SyncReport, sync_run


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    run = RunFolder.create(tmp_path / "here" / "monday")
    for number in range(3):
        with EpisodeWriter(run.episodes_dir / f"t{number}.mcap") as writer:
            writer.describe(EpisodeInfo(id=f"t{number}", kind="trial"))
            event = {"schema_version": 1, "stamp_ns": 1, "type": "note", "text": "x" * 1000}
            writer.write_json("/e", event, type_name="gst/Event", log_time_ns=number + 1)
    run.notes_dir.mkdir()
    (run.notes_dir / "t0.outcome.json").write_text("{}")
    (run.path / "cell.toml").write_text("schema_version = 1")
    (run.path / "catalogue.sqlite").write_bytes(b"cache")
    (run.episodes_dir / "t9.mcap.part").write_bytes(b"open")
    (run.episodes_dir / "t9.mcap.journal").write_bytes(b"open")
    (run.path / ".hidden").write_text("x")
    return run


def sync(run: RunFolder, to: Path | str, *, verify: bool = False) -> SyncReport:
    return sync_run(run, str(to), verify=verify, advance=lambda done, name: None)


def tree(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "sync.json"
    }


FINISHED = ["cell.toml", *(f"episodes/t{k}.mcap" for k in range(3)), "notes/t0.outcome.json"]


def test_all_that_is_finished_is_copied_once(run: RunFolder, tmp_path: Path) -> None:
    first = sync(run, tmp_path / "there")
    assert list(first.copied) == FINISHED
    copy = tmp_path / "there" / "monday"
    assert tree(copy) == {name: (run.path / name).read_bytes() for name in FINISHED}
    files = json.loads((copy / "sync.json").read_text())["files"]
    for name in FINISHED:
        assert files[name]["sha256"] == hashlib.sha256((run.path / name).read_bytes()).hexdigest()
    again = sync(run, tmp_path / "there")
    assert (again.copied, again.unchanged, again.num_bytes) == ((), 5, 0)
    (run.notes_dir / "t0.outcome.json").write_text('{"a": 1}')
    (run.notes_dir / "new.json").write_text("2")
    later = sync(run, tmp_path / "there")
    assert later.copied == ("notes/new.json", "notes/t0.outcome.json")
    assert (copy / "notes/t0.outcome.json").read_text() == '{"a": 1}'


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(1, 20), min_size=1, max_size=5))
def test_law_interrupted_anywhere_it_goes_on_and_ends_equal(cuts: list[int]) -> None:
    """After any number of interruptions the copy is the original, and no byte is sent twice."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        run = RunFolder.create(Path(folder) / "run")
        content = bytes(range(256)) * 40
        (run.episodes_dir / "a.mcap").write_bytes(content)
        (run.episodes_dir / "b.mcap").write_bytes(content[::-1])
        patch.setattr(syncing, "BLOCK", 1000)
        real = syncing._blocks
        sent = 0

        def cut_after(left: list[int]) -> None:
            def blocks(path: Path, at: int) -> Iterator[bytes]:
                nonlocal sent
                for block in real(path, at):
                    if left[0] == 0:
                        raise KeyboardInterrupt
                    left[0] -= 1
                    yield block

            patch.setattr(syncing, "_blocks", blocks)

        there = Path(folder) / "there"
        for cut in cuts:
            cut_after([cut])
            try:
                sync(run, there)
            except KeyboardInterrupt:
                continue
        patch.setattr(syncing, "_blocks", real)
        report = sync(run, there)
        assert not report.failed
        assert tree(there / "run") == tree(run.path)


def test_what_was_sent_before_is_not_sent_again(run: RunFolder, tmp_path: Path) -> None:
    content = bytes(range(256)) * 100
    (run.episodes_dir / "big.mcap").write_bytes(content)
    copy = tmp_path / "there" / "monday" / "episodes"
    copy.mkdir(parents=True)
    (copy / "big.mcap.partial").write_bytes(content[:20_000])
    (copy / "t0.mcap.partial").write_bytes(b"of another file")
    report = sync(run, tmp_path / "there")
    assert report.resumed == ("episodes/big.mcap",)
    others = sum((run.path / name).stat().st_size for name in FINISHED)
    assert report.num_bytes == len(content) - 20_000 + others
    assert (copy / "big.mcap").read_bytes() == content
    assert not list(copy.glob("*.partial"))


def test_a_disk_that_returns_other_bytes_is_noticed(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = FolderTarget.append

    def flips(self: FolderTarget, name: str, blocks: Iterator[bytes], *, is_new: bool) -> None:
        broken = (bytes([block[0] ^ 1]) + block[1:] for block in blocks)
        real(self, name, broken if "t1" in name else blocks, is_new=is_new)

    monkeypatch.setattr(FolderTarget, "append", flips)
    report = sync(run, tmp_path / "there")
    assert list(report.failed) == ["episodes/t1.mcap"]
    assert "reads back differently" in report.failed["episodes/t1.mcap"]
    assert not (tmp_path / "there" / "monday" / "episodes" / "t1.mcap").exists()
    monkeypatch.undo()
    assert sync(run, tmp_path / "there").copied == ("episodes/t1.mcap",)


def test_a_copy_that_rots_is_found_by_verify(run: RunFolder, tmp_path: Path) -> None:
    sync(run, tmp_path / "there")
    rotten = tmp_path / "there" / "monday" / "episodes" / "t2.mcap"
    data = bytearray(rotten.read_bytes())
    data[100] ^= 1
    rotten.write_bytes(data)
    assert sync(run, tmp_path / "there").copied == ()
    assert sync(run, tmp_path / "there", verify=True).copied == ("episodes/t2.mcap",)
    assert rotten.read_bytes() == (run.episodes_dir / "t2.mcap").read_bytes()
    (tmp_path / "there" / "monday" / "sync.json").write_text("[broken")
    assert len(sync(run, tmp_path / "there").copied) == 5


def test_another_kind_of_place_gets_the_same(run: RunFolder) -> None:
    fsspec = pytest.importorskip("fsspec")
    bucket = f"memory://{uuid.uuid4().hex}"
    assert len(sync(run, bucket).copied) == 5
    assert sync(run, bucket, verify=True).unchanged == 5
    (run.notes_dir / "t0.outcome.json").write_text("changed")
    assert sync(run, bucket).copied == ("notes/t0.outcome.json",)
    files, root = fsspec.core.url_to_fs(f"{bucket}/monday")
    for name in FINISHED:
        assert files.cat_file(f"{root}/{name}") == (run.path / name).read_bytes()


def test_places_that_cannot_be_are_refused(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("fsspec")
    with pytest.raises(UsageError, match="lies in the run itself"):
        sync(run, run.path)
    with pytest.raises(UsageError, match="fsspec knows no such protocol"):
        sync(run, "nosuch://x")
    (tmp_path / "file").write_text("")
    assert robot_gst.run(["sync", str(run.path), str(tmp_path / "file")]) == 2
    assert "cannot write" in capsys.readouterr().err
    assert robot_gst.run(["sync", str(run.path), str(tmp_path / "there"), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["copied"]) == 5
