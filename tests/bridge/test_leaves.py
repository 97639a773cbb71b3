"""What the core says and does where a leaf is not installed."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

import robot_gst
from bridge.episode.run_folder import RunFolder
from bridge.errors import MissingDependencyError
from bridge.leaves import LEAVES, has_leaf, load_leaf


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """A leaf whose folder is gone."""
    name = str(getattr(request, "param", "perception"))
    monkeypatch.setitem(LEAVES, name, replace(LEAVES[name], modules=(f"twin.gone.{name}",)))
    return name


def test_a_leaf_that_is_gone_names_its_extra(without: str) -> None:
    assert not has_leaf(without)
    with pytest.raises(MissingDependencyError, match=r"naming the things.*robot-gst\[foundation\]"):
        load_leaf(without, "name_things")


def test_a_leaf_that_nobody_knows_is_in_the_extra_of_all() -> None:
    with pytest.raises(MissingDependencyError, match=r"robot-gst\[all\]"):
        load_leaf("telepathy", "read")


@pytest.mark.parametrize(
    ("without", "command"),
    [
        ("planner", ["plan", "runs/x", "--task", "put it there"]),
        ("stand-in", ["demo", "runs/x"]),
        ("stand-in", ["publish", "standin"]),
        ("ur", ["publish", "ur", "192.0.2.1"]),
        ("realsense", ["publish", "realsense", "--list"]),
        ("lerobot", ["export", "lerobot", "runs/x", "out"]),
    ],
    indirect=["without"],
)
def test_a_command_of_a_leaf_that_is_gone_says_what_brings_it(
    without: str, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert robot_gst.run(command) == 1
    told = capsys.readouterr().err
    assert f"robot-gst[{LEAVES[without].extra}]" in told
    assert "Traceback" not in told


def test_a_scene_is_rebuilt_without_names_of_its_things(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, without: str
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "twin" / "scene"))
    from small_scene import rebuild_room

    from twin.scene.store.folder import read_record

    assert not has_leaf(without)
    run = rebuild_room(tmp_path)
    record = read_record(RunFolder(run.path))
    assert record is not None
    assert "semantics" not in record
    assert record["fit"]["iterations"] == 6
    assert not (run.scene_dir / "semantics.npz").exists()
    sys.modules.pop("small_scene", None)
