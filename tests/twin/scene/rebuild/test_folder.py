"""The scene folder: what vouches for what, what is damaged, and what is never looked at."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import textured_room
from small_scene import CONFIG, QUIET

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from twin.replay.config import ReplayRunConfig
from twin.replay.runner import replay_run
from twin.scene import settings
from twin.scene.frames.selection import choose_frames, find_sources
from twin.scene.localise.result import LocalisedObject
from twin.scene.objects import placement as parts_module
from twin.scene.objects.decompose import read_objects
from twin.scene.objects.placement import find_placements
from twin.scene.rebuild.record import describe_scene
from twin.scene.rebuild.run import rebuild
from twin.scene.store.folder import UnreadableSceneError, read_record, read_scene, scene_hash_of

pytestmark = pytest.mark.usefixtures("few_voxels")


def change_record(run: RunFolder, change: Callable[[dict[str, Any]], object]) -> None:
    path = run.scene_dir / "scene.json"
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def test_one_scene_has_one_name_everywhere(room: RunFolder) -> None:
    """Verdicts of the gate, replays, localisations and views must name the same scene."""
    scene_hash = scene_hash_of(room)
    assert scene_hash is not None
    assert replay_run(room, ReplayRunConfig(), QUIET)["scene_hash"] == scene_hash
    (views,) = room.derived("*.views.*")
    assert scene_hash in views.name


@pytest.mark.parametrize("lost", ["scene_hash", "views", "sources"])
def test_a_scene_file_without_what_its_readers_need_is_refused(room: RunFolder, lost: str) -> None:
    change_record(room, lambda record: record.pop(lost))
    with pytest.raises(UnreadableSceneError, match=f"without {lost}"):
        read_record(room)


def test_a_background_that_is_not_the_described_one_is_refused_and_made_again(
    room: RunFolder,
) -> None:
    path = room.scene_dir / "background.ply"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(UnreadableSceneError, match="describes scene"):
        read_scene(room)
    rebuild(room, CONFIG, QUIET)
    assert len(read_scene(room).background) > 0


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", '{"T_base_object": null}', '{"T_base_object": {"p_m": [0], "q_wxyz": [1]}}',
     '{"T_base_object": {"p_m": [0, 0, 0], "q_wxyz": [0, 0, 0, 0]}}',
     '{"T_base_object": {"p_m": [NaN, 0, 0], "q_wxyz": [1, 0, 0, 0]}}'],
)  # fmt: skip
def test_a_damaged_object_file_is_refused(room: RunFolder, text: str) -> None:
    folder = room.scene_dir / "objects" / "cube"
    folder.mkdir(parents=True)
    shutil.copy(room.scene_dir / "background.ply", folder / "gaussians.ply")
    (folder / "object.json").write_text(text)
    with pytest.raises(UnreadableSceneError, match=r"object\.json"):
        read_objects(room, {"objects": {"cube": {}}})


def test_the_scene_of_black_images_is_described_in_plain_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Black drawn as black is no error at all, and JSON does not know infinity."""
    monkeypatch.setattr(textured_room, "texture", np.zeros_like)
    run = RunFolder.create(tmp_path / "run")
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=9)
    record = rebuild(run, CONFIG, QUIET)
    assert record["views"]["psnr_db"] == 100.0
    json.dumps(record, allow_nan=False)


def test_a_camera_that_was_left_out_stands_in_the_scene_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder.create(tmp_path / "run")
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=9)
    encode = textured_room.transforms_to_cdr
    monkeypatch.setattr(
        textured_room,
        "transforms_to_cdr",
        lambda items: encode([replace(item, parent="elsewhere") for item in items]),
    )
    textured_room.write_episode(run.episodes_dir / "scan_2.mcap", num_frames=9)
    rebuild(run, CONFIG, QUIET)
    record = read_record(run)
    assert record is not None
    (remark,) = (text for text in record["scan"]["remarks"] if "left out" in text)
    assert "camera wrist of scan_2 is left out: its poses are in frame 'elsewhere'" in remark
    assert remark in describe_scene(record)


def test_objects_are_not_looked_for_in_held_out_frames(
    room: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}

    def localise(episode: Episode, task: object, **given: Any) -> dict[str, LocalisedObject]:
        asked.update(given)
        return {}

    monkeypatch.setattr(parts_module, "localise_episode", localise)
    monkeypatch.setattr(Episode, "info", EpisodeInfo(id="s", kind="scan", task="cube_into_box"))
    sources = find_sources(room)
    choices = choose_frames(sources, settings.FrameConfig(holdout_every=3)).choices
    find_placements(sources, choices, QUIET)
    assert len(choices[0].holdout_ns) == 3
    assert asked["held_out_ns"] == {"wrist": choices[0].holdout_ns}


def test_objects_are_not_cut_out_of_a_scene_in_a_frame_of_its_own(
    room: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are localised in the robot's base; a camera followed by its images knows no base."""
    monkeypatch.setattr(parts_module, "localise_episode", lambda *a, **k: pytest.fail("localised"))
    monkeypatch.setattr(Episode, "info", EpisodeInfo(id="s", kind="scan", task="cube_into_box"))
    sources = find_sources(room)
    (choice,) = choose_frames(sources, settings.FrameConfig()).choices
    followed = replace(choice, poses=replace(choice.poses, source="odometry"))
    apart = find_placements(sources, [followed], QUIET)
    assert "followed by its images" in apart.remark
    assert not apart.by_episode


def test_frames_are_known_by_their_own_stamp_and_not_by_when_they_were_sent(tmp_path: Path) -> None:
    """Other recorders put the time of receiving where ours puts the source's."""
    run = RunFolder.create(tmp_path / "run")
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=9, sent_late_ns=7_000)
    record = rebuild(run, CONFIG, QUIET)
    assert record["cameras"][0]["train_frames"] == 8
    assert len(record["views"]["images"]) == 1


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (lambda: settings.FrameConfig(holdout_every=1), "--holdout-every 1"),
        (lambda: settings.FrameConfig(holdout_every=0), "at least 2"),
        (lambda: settings.FrameConfig(max_train_frames=0), "--max-train-frames"),
        (lambda: settings.InitialiseConfig(max_splats=0), "--max-splats"),
        (lambda: settings.FitConfig(budget_s=0.0), "--budget"),
        (lambda: settings.FitConfig(iterations=-1), "--iterations"),
        (lambda: settings.FitConfig(budget_s=float("inf")), "--budget"),
        (lambda: settings.FitConfig(seed=-1), "--seed"),
        (lambda: settings.FitConfig(threads=-2), "--threads"),
        (lambda: settings.FrameConfig(max_depth_m=float("nan")), "--max-depth-m"),
        (lambda: settings.FrameConfig(max_depth_m=-1.0), "--max-depth-m"),
        (lambda: settings.InitialiseConfig(flying_fraction=float("nan")), "--flying-fraction"),
        (lambda: settings.RenderConfig(at_s=float("nan")), "--at-s"),
        (lambda: settings.RenderConfig(out=Path("a.ply")), "background.ply"),
        (lambda: settings.RenderConfig(eye=(0.0, 0.0, float("nan"))), "--eye"),
    ],
)
def test_settings_that_nothing_can_be_made_with_are_refused(
    make: Callable[[], object], found: str
) -> None:
    with pytest.raises(UsageError, match=found):
        make()


def test_a_scene_whose_time_ended_before_its_images_is_reported_as_underfitted(
    tmp_path: Path,
) -> None:
    run = RunFolder.create(tmp_path / "run")
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=9)
    fitted = replace(CONFIG.fit, iterations=100_000, budget_s=0.05)
    record = rebuild(run, replace(CONFIG, fit=fitted), QUIET)
    assert record["fit"]["underfitted"]
    done = f"{record['fit']['iterations']} of 100000 images"
    assert done in describe_scene(record)
    assert "underfitted" in describe_scene(record)
    whole = rebuild(run, CONFIG, QUIET)
    assert not whole["fit"]["underfitted"]
    assert "underfitted" not in describe_scene(whole)
