"""``robot-gst view``: which episode it shows, where the file goes, and who may listen."""

from pathlib import Path
from types import ModuleType

import pytest
from rerun_cell import write_cell_run

import robot_gst
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from dashboards import rerun_viewer


@pytest.fixture(scope="module")
def cell_run(tmp_path_factory: pytest.TempPathFactory, synthetic: ModuleType) -> RunFolder:
    return write_cell_run(tmp_path_factory.mktemp("rerun"), synthetic)


def test_the_newest_trial_is_found_beside_files_of_other_programs(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    with EpisodeWriter(run.episodes_dir / "a_trial.mcap") as writer:
        writer.describe(EpisodeInfo(id="a_trial", kind="trial"))
    with EpisodeWriter(run.episodes_dir / "foreign.mcap") as writer:
        writer.add_metadata("episode", {"who": "another program"})
    assert rerun_viewer.episode_of(run.path).stem == "a_trial"


def test_view_without_a_display_writes_the_file_and_says_how_to_open_it(
    cell_run: RunFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(rerun_viewer, "open_window", lambda path: pytest.fail("opened a window"))
    assert robot_gst.run(["view", str(cell_run.path)]) == 0
    shown = capsys.readouterr()
    written = cell_run.derived_dir / "trial_0001.rrd"
    assert written.is_file()
    assert "No display here" in shown.err
    assert f"rerun --bind 127.0.0.1 --port auto {written}" in shown.err


def test_view_with_a_display_opens_the_file_it_wrote(
    cell_run: RunFolder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    opened: list[Path] = []
    monkeypatch.setenv("DISPLAY", ":7")
    monkeypatch.setattr(rerun_viewer, "open_window", lambda path: opened.append(path) or 1)
    assert robot_gst.run(["view", str(cell_run.episodes()[0])]) == 0
    assert opened == [cell_run.derived_dir / "trial_0001.rrd"]
    out = tmp_path / "x.rrd"
    assert robot_gst.run(["view", str(cell_run.episodes()[0]), "--out", str(out)]) == 0
    assert out.is_file()
    assert len(opened) == 1  # only written


def test_the_viewer_listens_on_the_loopback_address_only() -> None:
    arguments = rerun_viewer.viewer_arguments(Path("x.rrd"))
    assert arguments[arguments.index("--bind") + 1] == "127.0.0.1"


def test_a_run_without_episodes_and_a_missing_file_are_wrong_use(tmp_path: Path) -> None:
    assert robot_gst.run(["view", str(RunFolder.create(tmp_path / "empty").path)]) == 2
    assert robot_gst.run(["view", str(tmp_path / "nowhere")]) == 2
