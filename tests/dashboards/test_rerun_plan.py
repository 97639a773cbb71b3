"""Plans in the Rerun file, which episode ``robot-gst view`` shows, and who may listen."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from rerun_cell import urdf, write_cell_run
from test_rerun_view import read_back

import robot_gst
from bridge.episode import schema
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.run_folder import PLAN_REPLAY, REFUSED_PLAN, RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.media.palette import rgb
from bridge.task.plan import Plan, SteeredBy
from dashboards import rerun_viewer
from dashboards.rerun_view import export_rrd, run_of
from dashboards.rerun_viewer import episode_of

AT_NS = 40_000_000_000


def planned(synthetic: ModuleType, number: int) -> Plan:
    """The second is steered by what was said of the first."""
    plan = synthetic.make_plan(synthetic.TRIALS[0], number, "trial_0001_p1" if number > 1 else None)
    return replace(plan, steered_by=SteeredBy(clause="terminal.dropped") if number > 1 else None)


def write_planned(run: RunFolder, synthetic: ModuleType, number: int, mesh: Path) -> Path:
    """A plan as ``robot-gst plan`` leaves it, with a replay of one sample."""
    plan = planned(synthetic, number)
    run.plans_dir.mkdir(exist_ok=True)
    path = run.plans_dir / f"{plan.id}{'.json' if number > 1 else REFUSED_PLAN}"
    path.write_bytes(plan.to_json())
    derived = Derived(
        kind="replay", source_episode="trial_0001", source_sha256="", plan_id=plan.id,
        trajectory="planned", mode="dynamic", engine="bullet",
    )  # fmt: skip
    said = synthetic.make_verdict(plan.id, number > 1, "planned", "bullet")
    with EpisodeWriter(run.plans_dir / f"{plan.id}{PLAN_REPLAY}") as writer:
        writer.describe(
            EpisodeInfo(id="trial_0001", kind="trial", task="cube_into_box", stand_in=True),
            derived=derived,
        )
        description = string_to_cdr(urdf(mesh))
        writer.write("/robot_description", description, type_name=schema.STRING, log_time_ns=AT_NS)
        for topic, type_name, data in (
            ("/standin/plan", schema.PLAN, plan.to_json()),
            ("/standin/verdict", schema.VERDICT, said.to_json()),
        ):
            writer.write(topic, data, type_name=type_name, log_time_ns=AT_NS)
        log = synthetic._Log(writer)
        log.pose("/standin/object/cube/pose", np.array([0.45, -0.1, 0.02]), AT_NS)
        log.pose("/standin/tcp/pose", np.array([0.4, 0.0, 0.3]), AT_NS)
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, synthetic: ModuleType) -> RunFolder:
    folder = tmp_path_factory.mktemp("planned")
    run = write_cell_run(folder, synthetic)
    for number in (1, 2):
        write_planned(run, synthetic, number, folder / "part.stl")
    return run


def test_the_way_of_a_plan_is_in_the_colour_of_its_verdict(
    run: RunFolder, synthetic: ModuleType, tmp_path: Path
) -> None:
    for number, meaning in ((1, "bad"), (2, "good")):
        plan = planned(synthetic, number)
        path = episode_of(run.plans_dir / f"{plan.id}{'.json' if number > 1 else REFUSED_PLAN}")
        out = tmp_path / f"{number}.rrd"
        assert export_rrd(path, out, run_of(path)).sides == ("replayed/planned/dynamic",)
        content = read_back(out)
        way = content[f"/plans/{plan.id}"]
        np.testing.assert_allclose(way["LineStrips3D:strips"][0][0], plan.positions_m(), atol=1e-6)
        red, green, blue = rgb(meaning)
        assert way["LineStrips3D:colors"] == [[red << 24 | green << 16 | blue << 8 | 255]]
        assert "/replayed/planned/dynamic/objects/cube" in content, "the twin's rollout"


def test_the_text_says_what_steered_it(run: RunFolder, tmp_path: Path) -> None:
    path = episode_of(run.plans_dir / "trial_0001_p2.json")
    out = tmp_path / "plan.rrd"
    export_rrd(path, out, run_of(path))
    content = read_back(out)
    text = content["/about"]["TextDocument:text"][0][0]
    assert "after trial_0001_p1, steered by terminal.dropped" in text
    (verdict,) = content["/replayed/planned/dynamic/verdicts"]["TextLog:text"]
    assert "trial_0001_p2" in verdict[0]


def test_a_plan_without_its_replay_is_wrong_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lonely.json"
    path.write_text("{}")
    assert robot_gst.run(["view", str(path)]) == 2
    assert "lonely.replay.mcap" in capsys.readouterr().err


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
