"""Which files of a run are episodes; what a run lists agrees with them, read before or not."""

import errno
import json
import os
from pathlib import Path

import pytest

import robot_gst
from bridge.cli.episodes import label
from bridge.episode import metadata, run_folder
from bridge.episode.catalogue import (
    find_episodes,
    label_episode,
)
from bridge.episode.catalogue_query import CatalogueQuery
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import task_file
from bridge.episode.writer import EpisodeWriter
from bridge.errors import BridgeError, EpisodeError, PathNotFoundError, UsageError
from bridge.terminal import Output


def write(
    run: RunFolder,
    name: str,
    *,
    start_ns: int = 0,
    messages: int = 1,
    lost: int | None = None,
    outcome: str | None = None,
    **about: object,
) -> Path:
    info = EpisodeInfo(**{"id": name, "kind": "trial", **about})  # type: ignore[arg-type]
    path = run.episodes_dir / f"{name}.mcap"
    path.unlink(missing_ok=True)
    with EpisodeWriter(path) as writer:
        writer.describe(info, outcome=None if outcome is None else Outcome(result=outcome))
        for index in range(messages):
            stamp_ns = start_ns + index * 1_000_000_000
            writer.write("/x", b"x", schema_record=None, log_time_ns=stamp_ns)
        if lost is not None:
            drops = {"gaps": str(lost), "queue_drops": "0", "shed": "0"}
            writer.add_metadata("drops", drops)
    return path


def ids(run: RunFolder, **query: object) -> list[str]:
    found = find_episodes(run, CatalogueQuery(**query))  # type: ignore[arg-type]
    return [entry.id for entry in found]


def test_an_entry_says_what_the_episode_says(run: RunFolder) -> None:
    about = {
        "kind": "trial",
        "task": "cube",
        "condition": "with_replanning",
        "policy": "p",
        "start_id": "s1",
        "trial": 7,
        "operator": "Ada",
        "robot": "ur5",
        "cell": "lab",
        "stand_in": True,
        "tags": ("a", "b c"),
    }
    path = write(run, "t1", start_ns=5, messages=3, lost=2, outcome="success", **about)
    (entry,) = find_episodes(run)
    assert {name: getattr(entry, name) for name in about} == about
    assert (entry.file, entry.id, entry.outcome, entry.error) == ("t1.mcap", "t1", "success", "")
    assert (entry.start_ns, entry.duration_s, entry.messages) == (5, 2.0, 3)
    assert (entry.size_bytes, entry.lost) == (path.stat().st_size, 2)
    assert not entry.recovered


def test_what_changed_since_is_listed_as_it_is_now(run: RunFolder) -> None:
    for name in ("t1", "t2", "t3"):
        write(run, name)
    assert ids(run) == ["t1", "t2", "t3"]
    write(run, "t2", task="new")
    (run.episodes_dir / "t1.mcap").unlink()
    assert [(entry.id, entry.task) for entry in find_episodes(run)] == [("t2", "new"), ("t3", "")]


def test_a_label_given_later_changes_the_row_at_once(run: RunFolder) -> None:
    write(run, "t1", outcome="success")
    assert find_episodes(run)[0].outcome == "success"
    sidecar = label_episode(run, "t1", Outcome(result="failure"))
    assert find_episodes(run)[0].outcome == "failure"
    sidecar.unlink()
    assert find_episodes(run)[0].outcome == "success"


def test_an_episode_that_was_recovered_counts_as_lossy(run: RunFolder) -> None:
    with EpisodeWriter(run.episodes_dir / "t1.mcap") as writer:
        writer.describe(EpisodeInfo(id="t1", kind="trial"))
        writer.add_metadata("recovered", {"reason": '"killed"'})
    write(run, "t2", lost=0)
    assert [entry.recovered for entry in find_episodes(run)] == [True, False]


def test_what_other_programs_wrote_is_listed(run: RunFolder) -> None:
    drops = {"gaps": '"many"', "queue_drops": "0", "shed": "0"}
    for name, values in (("a", {}), ("b", drops)):
        with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
            info = metadata.to_strings(EpisodeInfo(id=name, kind="trial"))
            odd = {
                "trial": "1" + "0" * 40,
                "tags": '["1", "\\ud800"]',
                "task": '"\\u0000"',
            }
            writer.add_metadata("episode", {**info, **odd})
            if values:
                writer.add_metadata("drops", values)
            writer.write("/x", b"", schema_record=None, log_time_ns=2**64 - 1)
    (run.episodes_dir / os.fsdecode(b"\xff.mcap")).write_bytes(b"")
    for _ in range(2):
        broken, one, two = find_episodes(run)
        assert one.error == ""
        assert one.tags == ("1", "\\ud800")
        assert (one.trial, one.start_ns, one.task) == (10**40, 2**64 - 1, "\0")
        assert (one.lost, two.lost) == (None, None)
        assert (broken.file, bool(broken.error)) == ("\\udcff.mcap", True)


def test_filters_pick(run: RunFolder) -> None:
    write(run, "a", kind="scan")
    write(run, "b", task="cube", operator="Ada", lost=4, tags=("x", "y"))
    write(run, "c", task="duck", policy="p", lost=0, tags=("y",))
    (run.episodes_dir / "d.mcap").write_bytes(b"broken")
    label_episode(run, "c", Outcome(result="failure"))
    assert ids(run) == ["a", "b", "c", "d"]
    assert ids(run, kind=("scan",)) == ["a"]
    assert ids(run, kind=("scan", "trial")) == ["a", "b", "c"]
    assert ids(run, kind=("trial",), task=("duck",)) == ["c"]
    assert ids(run, outcome=("failure",)) == ["c"]
    assert (ids(run, text="ADA cube"), ids(run, text="ada duck")) == (["b"], [])
    assert ids(run, text="finished") == ["d"]


def test_ls_takes_the_filters(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    write(run, "a", task="cube", lost=3)
    write(run, "b", task="duck")
    assert robot_gst.run(["ls", str(run.path), "--task", "cube"]) == 0
    header, row, notes = capsys.readouterr().out.splitlines()
    assert header.split() == ["episode", "kind", "condition", "outcome", "seconds", "MB"]
    assert row.startswith("a ")
    assert "3 messages lost" in notes
    assert robot_gst.run(["ls", str(run.path), "--task", "none"]) == 0
    assert "passes these filters" in capsys.readouterr().out
    assert robot_gst.run(["ls", str(run.path), "--text", "DUCK", "--json"]) == 0
    assert [item["id"] for item in json.loads(capsys.readouterr().out)["episodes"]] == ["b"]


def test_ls_shows_no_control_characters(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    write(run, "a", kind="\x1b[2Jtrial")
    assert robot_gst.run(["ls", str(run.path)]) == 0
    assert "\x1b" not in capsys.readouterr().out


def run_with(folder: Path, *names: str) -> run_folder.RunFolder:
    run = run_folder.RunFolder.create(folder / "run")
    for name in names:
        (run.episodes_dir / name).write_bytes(b"")
    return run


def listed(run: run_folder.RunFolder) -> list[str]:
    return [path.name for path in run.episodes()]


def test_files_of_takes_still_open_are_no_episodes(tmp_path: Path) -> None:
    run = run_with(tmp_path, "t1.mcap.part", "t1.2.mcap.part", "notes.txt")
    assert listed(run) == []
    assert [path.name for path in run.unfinished()] == ["t1.2.mcap.part", "t1.mcap.part"]


def test_derived_files_are_found_by_a_pattern_and_unfinished_ones_are_told_apart(
    tmp_path: Path,
) -> None:
    run = run_with(tmp_path)
    assert run.derived() == []
    run.derived_dir.mkdir()
    names = ["t1.localised.mcap", "t1.replay.planned.mcap", "t2.replay.planned.mcap"]
    for name in (*reversed(names), "t3.replay.planned.mcap.part", "notes.txt"):
        (run.derived_dir / name).write_bytes(b"")
    assert [path.name for path in run.derived()] == names
    assert [path.name for path in run.derived("*.replay.*")] == names[1:]
    assert run.derived("t1.*") == [run.derived_dir / name for name in names[:2]]
    assert run.unfinished() == [run.derived_dir / "t3.replay.planned.mcap.part"]


def test_a_file_is_not_called_missing(tmp_path: Path) -> None:
    path = tmp_path / "trial_0001.mcap"
    path.write_bytes(b"")
    with pytest.raises(UsageError, match="is a file, not a run") as caught:
        run_folder.RunFolder.open(path)
    assert not isinstance(caught.value, PathNotFoundError)


def test_a_folder_that_is_not_there_is_called_missing(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match="run folder not found"):
        run_folder.RunFolder.open(tmp_path / "nowhere")


def test_two_commands_do_not_write_into_one_folder_at_once(tmp_path: Path) -> None:
    run = run_with(tmp_path, "t1.mcap")
    taken = pytest.raises(UsageError, match="another command writes into")
    with run.alone_in(run.derived_dir), run.alone_in(run.scene_dir), taken:
        run.alone_in(run.derived_dir).__enter__()
    with run.alone_in(run.derived_dir):
        assert list(run.derived_dir.iterdir()) == []


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_takes_nothing_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    run_folder.refuse_full(tmp_path / "scene")
    assert list((tmp_path / "scene").iterdir()) == []
    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(BridgeError, match=os.strerror(number)):
        run_folder.refuse_full(tmp_path / "scene")


QUIET = Output(quiet=True)


def recorded_run(tmp_path: Path, info: EpisodeInfo, attached: str = "") -> tuple[RunFolder, Path]:
    run = RunFolder.create(tmp_path / "run")
    path = run.episodes_dir / f"{info.id}.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(info)
        if attached:
            text = (Path("datasets/tasks") / f"{attached}.toml").read_bytes()
            writer.attach("task.toml", text, media_type="application/toml", log_time_ns=1)
    return run, path


def test_an_imported_episode_becomes_a_trial_of_a_task_from_a_start(tmp_path: Path) -> None:
    run, path = recorded_run(tmp_path, EpisodeInfo(id="bag", kind="imported"))
    before = path.read_bytes()
    assert [(entry.kind, entry.outcome) for entry in find_episodes(run)] == [
        ("imported", "unknown")
    ]
    arguments = {"task": "cube_into_box", "start": "s7", "policy": "act", "result": "success"}
    assert label(run.path, "bag", **arguments, output=QUIET) == 0
    info = Episode.open(path).info
    assert (info.kind, info.task, info.start_id, info.policy) == (
        "trial",
        "cube_into_box",
        "s7",
        "act",
    )
    (entry,) = find_episodes(run)
    assert (entry.kind, entry.task, entry.outcome, entry.start_id) == (
        "trial", "cube_into_box", "success", "s7",
    )  # fmt: skip
    assert path.read_bytes() == before
    label(run.path, "bag", task="cube_on_block", output=QUIET)
    info = Episode.open(path).info
    assert (info.task, info.start_id, info.policy) == ("cube_on_block", "s7", "act"), (
        "the rest stays"
    )


def test_another_task_is_read_from_its_own_file_and_not_from_the_attachment(tmp_path: Path) -> None:
    info = EpisodeInfo(id="t", kind="trial", task="cube_into_box")
    run, path = recorded_run(tmp_path, info, attached="cube_into_box")
    assert task_file(Episode.open(path)).task().name == "cube_into_box"
    label(run.path, "t", task="cube_on_block", output=QUIET)
    assert task_file(Episode.open(path)).task().name == "cube_on_block"


def test_what_would_count_nowhere_is_refused_with_the_way_out(tmp_path: Path) -> None:
    run, _ = recorded_run(tmp_path, EpisodeInfo(id="bag", kind="imported"))
    with pytest.raises(UsageError, match="no trial yet: say of which task, --task NAME"):
        label(run.path, "bag", result="success", output=QUIET)
    with pytest.raises(UsageError, match="add --task NAME"):
        label(run.path, "bag", start="s1", output=QUIET)
    with pytest.raises(UsageError, match="cube_into_box"):
        label(run.path, "bag", task="cube_in_box", output=QUIET)
    scans, _ = recorded_run(tmp_path / "scans", EpisodeInfo(id="scan", kind="scan"))
    with pytest.raises(UsageError, match="scan is a scan"):
        label(scans.path, "scan", task="cube_into_box", output=QUIET)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"task": 3}', '{"start_id": "s"}', "[" * 5000])
def test_a_damaged_note_is_named(tmp_path: Path, text: str) -> None:
    run, path = recorded_run(tmp_path, EpisodeInfo(id="bag", kind="imported"))
    run.notes_dir.mkdir(exist_ok=True)
    (run.notes_dir / "bag.trial.json").write_text(text)
    with pytest.raises(EpisodeError, match=r"bag\.trial\.json.*label RUN EPISODE --task NAME"):
        _ = Episode.open(path).info
