"""The whole loop, once, with every file checked by readers that are not ours."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import textured_room
from leafless import run_without
from mcap.reader import make_reader

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.leaves import LEAVES

ROOT = Path(__file__).parents[2]
SHORT = """
import sys
import robot_gst
from dashboards import demo
command = demo._command
MORE = {
    "publish": ["--image-scale", "0.5", "--rate-hz", "2"],
    "rebuild": ["--max-splats", "15000", "--max-train-frames", "20", "--max-holdout-frames", "3"],
}
demo._command = lambda words: command([*words, *MORE.get(words[0], [])])
demo.DemoConfig.trials, demo.DemoConfig.iterations = 1, 40
sys.exit(robot_gst.run(["demo", sys.argv[1], "--quick", "--no-serve"]))
"""
"""The command as it is, with smaller pictures, half the trials and a fraction of the rebuild."""

pytestmark = pytest.mark.slow
Gst = Callable[..., subprocess.CompletedProcess[str]]


def short_demo(run: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", SHORT, str(run)],
        capture_output=True,
        text=True,
        timeout=500,
        cwd=ROOT,
        check=False,
    )


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("demo") / "run"
    done = short_demo(run)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "stand-in" in done.stdout
    return run


def all_files(run: Path) -> list[Path]:
    return sorted((run / "episodes").glob("*.mcap")) + sorted((run / "derived").glob("*.mcap"))


def test_the_demo_leaves_a_scan_trials_of_both_conditions_and_replays(demo: Path) -> None:
    infos = [Episode.open(path).info for path in sorted((demo / "episodes").glob("*.mcap"))]
    assert [info.kind for info in infos].count("scan") == 1
    conditions = [info.condition for info in infos if info.kind == "trial"]
    assert conditions.count("without_replanning") == conditions.count("with_replanning") == 1
    assert all(info.stand_in for info in infos)
    assert list((demo / "derived").glob("*.replay.planned.dynamic.*.mcap"))
    assert list((demo / "derived").glob("*.replay.executed.*.mcap"))
    assert not list(demo.rglob("*.part"))


def test_the_official_reader_accepts_every_file_with_crcs_on(demo: Path) -> None:
    for path in all_files(demo):
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            assert sum(1 for _ in reader.iter_messages()) > 0, path


def test_our_check_finds_every_file_clean(demo: Path, gst: Gst) -> None:
    done = gst("check", str(demo), "--json")
    assert done.returncode == 0, done.stdout
    assert len(json.loads(done.stdout)["episodes"]) == len(all_files(demo))


def test_rerun_accepts_every_file(demo: Path) -> None:
    rerun = Path(sys.executable).parent / "rerun"
    for path in all_files(demo):
        done = subprocess.run(
            [str(rerun), "mcap", "check", "--full", str(path)],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, f"{path.name}: {done.stdout[-2000:]}{done.stderr[-2000:]}"


def test_results_are_labelled_stand_in_and_say_what_is_undefined(demo: Path) -> None:
    results = json.loads((demo / "results" / "results.json").read_text())
    assert results["schema_version"] == 2
    assert results["stand_in"] is True
    for measurement in results["measurements"]:
        assert measurement["definition"]
        if measurement["value"] is None:
            assert measurement["reason_if_undefined"], measurement["id"]
    assert "stand-in" in (demo / "results" / "report.html").read_text()


def test_the_scene_opens_as_a_standard_splat_file(demo: Path) -> None:
    header = (demo / "scene" / "background.ply").read_bytes()[:2000].split(b"end_header")[0]
    for name in (b"f_dc_0", b"opacity", b"scale_0", b"rot_0"):
        assert name in header


def test_running_the_demo_again_keeps_what_is_whole_and_adds_what_is_missing(demo: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in all_files(demo)}
    lost = demo / "episodes" / "trial_0002.mcap"
    lost.unlink()
    done = short_demo(demo)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "4/6 1 trials" in done.stderr
    assert Episode.open(lost).info.condition == "with_replanning"
    kept = {path: path.stat().st_mtime_ns for path in all_files(demo)}
    changed = {path for path in before if kept.get(path) != before[path]}
    assert changed <= {path for path in before if path.name.startswith(lost.stem)}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a scan of a small room."""
    run = RunFolder.create(tmp_path_factory.mktemp("room") / "room")
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=9)
    return run.path


@pytest.fixture(scope="module")
def whole(demo: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What comes of the core's commands with every leaf there."""
    return run_without(None, demo, room, tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("leaf", LEAVES)
def test_the_core_does_the_same_without_a_leaf(
    leaf: str, whole: dict[str, Any], demo: Path, room: Path, tmp_path: Path
) -> None:
    found = run_without(leaf, demo, room, tmp_path)
    done = {name: found[name] for name in ("check", "rebuild", "replay", "evaluate")}
    assert done == dict.fromkeys(done, 0)
    assert found["/"] == found["/episode/trial_0001"] == 200
    assert found["elsewhere"] == []
    assert found["record"] > 1000
    assert found == whole
