"""The command ``find``: which frame it shows, what it writes, and how it ends."""

import json
from pathlib import Path

import numpy as np
import pytest

import robot_gst
from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.media.color import decode_color
from twin.naming.phrases import Answer, Found
from twin.naming.things import Instance, SemanticScene
from twin.scene.foundation import find as finding
from twin.scene.foundation.find import Looked, View, line_of, look_at

UP = np.array([0.0, 0.0, 1.0])


def thing(number: int, label: str, x_m: float) -> Instance:
    T = np.eye(4)
    T[0, 3] = x_m
    return Instance(
        id=number,
        label=label,
        mask=np.arange(8) // 4 == number - 1,
        score=0.9,
        source="test",
        color_srgb=(200, 20, 20),
        T_base_instance=T,
        size_m=(0.04, 0.04, 0.04),
        parts={"rim": np.arange(8) == 4} if number == 2 else {},
    )


def view(name: str, height_m: float, shown: dict[int, slice]) -> View:
    """A camera in front; each number covers some columns of the image."""
    splats = np.zeros((30, 40), dtype=np.uint16)
    for number, columns in shown.items():
        splats[10:20, columns] = number
    parts = np.where((splats == 2) & (np.arange(30)[:, None] < 12), 1, 0).astype(np.uint16)
    return View(
        name=name,
        image_u8=np.full((30, 40, 3), 90, dtype=np.uint8),
        T_base_camera=se3.look_at(np.array([0.0, -1.0, height_m]), np.zeros(3), UP),
        splats=splats,
        parts=parts,
        part_numbers={(2, "rim"): 1},
    )


@pytest.fixture
def looked() -> Looked:
    scene = SemanticScene(
        instances=(thing(1, "red cube", -0.1), thing(2, "red open container", 0.1)),
        labels=(np.arange(8) // 4 + 1).astype(np.uint16),
        source="test",
    )
    both = {1: slice(2, 12), 2: slice(20, 38)}
    views = [
        view("above", 5.0, both),
        view("front", 0.2, both),
        view("half", 0.1, {1: slice(0, 40)}),
    ]
    return Looked(scene=scene, views=views)


def test_the_frame_shown_shows_most_things_and_stands_most_upright(looked: Looked) -> None:
    assert looked.best.name == "front"
    cube, box = looked.scene.instances
    found = Answer(found=(Found(item=cube, score=1.0), Found(item=box, part="rim", score=0.5)))
    assert looked.view_of(found).name == "front"
    numbers = looked.best.numbers(found)
    assert [(numbers == n).sum() for n in (1, 2)] == [100, 36]
    assert "rim of object 2, red open container, 4 x 4 x 4 cm" in line_of(2, found.found[1])


@pytest.fixture
def run(tmp_path: Path, looked: Looked, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(finding, "look_at", lambda _: looked)
    return RunFolder.create(tmp_path / "run").path


def test_what_is_found_is_told_drawn_and_masked(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert robot_gst.run(["find", str(run), "the cube left of the container", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [item["label"] for item in told["found"]] == ["red cube"]
    assert told["found"][0]["T_base_instance"]["p_m"] == [-0.1, 0.0, 0.0]
    mask = decode_color(Path(told["mask"]).read_bytes())
    assert (mask[..., 0] == 1).sum() == 100
    picture = decode_color(Path(told["picture"]).read_bytes())
    assert picture.shape == (30, 40, 3)
    assert (picture != 90).any()


def test_what_is_not_there_ends_with_3_and_says_why(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert robot_gst.run(["find", str(run), "the green cube"]) == 3
    assert "no such thing: there is red cube" in capsys.readouterr().out
    assert not (run / "results" / "find.png").exists()


def test_a_run_without_a_scene_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = RunFolder.create(tmp_path / "bare").path
    assert robot_gst.run(["find", str(run), "cube"]) == 2
    assert capsys.readouterr().err.strip()


def test_a_rebuilt_room_is_looked_at_in_its_own_frames(tmp_path: Path) -> None:
    from small_scene import rebuild_room  # beside the tests one folder up, see conftest there

    looked = look_at(RunFolder.open(rebuild_room(tmp_path).path))
    assert 0 < len(looked.views) <= 12
    numbers = {0, *(item.id for item in looked.scene.instances)}
    for each in looked.views:
        assert each.image_u8.shape[:2] == each.splats.shape
        assert set(np.unique(each.splats).tolist()) <= numbers
