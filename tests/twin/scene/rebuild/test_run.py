import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import textured_room

from bridge.episode import streams
from bridge.episode.cdr.messages import CompressedColor, DepthImage
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import PathNotFoundError, UsageError
from bridge.media.color import decode_color
from bridge.terminal import Output
from twin.scene import settings
from twin.scene.frames.selection import find_sources
from twin.scene.rebuild.record import describe_scene
from twin.scene.rebuild.run import rebuild
from twin.scene.render import render
from twin.scene.store.folder import UnreadableSceneError, read_record, read_scene

pytestmark = pytest.mark.usefixtures("few_voxels")


QUIET = Output(quiet=True)
CONFIG = settings.RebuildConfig(
    fit=settings.FitConfig(iterations=120, threads=1),
    initialise=settings.InitialiseConfig(max_splats=2000, flying_fraction=0.1),
)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    run = RunFolder.create(tmp_path_factory.mktemp("run"))
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=16)
    rebuild(run, CONFIG, QUIET)
    return run


def test_the_scene_resembles_what_was_held_out(room: RunFolder) -> None:
    record = read_record(room)
    assert record is not None
    assert record["views"]["psnr_db"] > 24.0
    assert record["frame"] == "base_link"
    assert record["stand_in"] is True
    assert "stand-in" in describe_scene(record)
    assert record["sources"][0]["id"] == "scan"
    assert len(record["sources"][0]["sha256"]) == 64


def test_the_views_episode_pairs_recorded_and_rendered_images(room: RunFolder) -> None:
    scene = read_scene(room)
    (path,) = room.derived("*views*")
    assert path.name == f"scan.views.{scene.scene_hash}.mcap"
    episode = Episode.open(path)
    assert episode.derived is not None
    assert episode.derived.kind == "views"
    assert episode.derived.source_episode == "scan"
    assert episode.derived.scene_hash == scene.scene_hash
    topic = "/room/views/cam/wrist"
    recorded = {
        m.publish_time_ns: decode_color(CompressedColor.from_cdr(m.data).data)
        for m in episode.messages([f"{topic}/recorded/image"])
    }
    rendered = {
        m.publish_time_ns: decode_color(CompressedColor.from_cdr(m.data).data)
        for m in episode.messages([f"{topic}/rendered/image"])
    }
    assert recorded.keys() == rendered.keys()
    assert len(recorded) == 2
    source = {
        f.stamp_ns: f.image_u8
        for f in streams.rgbd_frames(Episode.open(room.episodes_dir / "scan.mcap"), "wrist")
    }
    for stamp, image in recorded.items():
        np.testing.assert_array_equal(image, source[stamp])
        assert rendered[stamp].shape == image.shape
    depth = [DepthImage.from_cdr(m.data) for m in episode.messages([f"{topic}/rendered/depth"])]
    assert 0.3 < np.median(depth[0].depth_m()) < 2.0
    # Colour and depth come from two cameras here, so recorded depth has other pixels.
    assert f"{topic}/recorded/depth" not in episode.topics()


def test_done_work_is_skipped_and_other_settings_redo_it(
    room: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (room.scene_dir / "background.ply").stat().st_mtime_ns
    record = rebuild(room, CONFIG, Output())
    assert (room.scene_dir / "background.ply").stat().st_mtime_ns == before
    said = capsys.readouterr().err
    assert "up to date" in said
    assert "training frames" not in said
    forced = rebuild(room, replace(CONFIG, force=True), Output())
    said = capsys.readouterr().err
    stages = ["training frames", "write objects", "name what is in the scene", "no things named"]
    places = [said.find(stage) for stage in stages]
    assert -1 not in places
    assert places == sorted(places), said
    assert (room.scene_dir / "background.ply").stat().st_mtime_ns > before
    assert forced["scene_hash"] == record["scene_hash"]  # a number of images is reproducible


@pytest.mark.parametrize(
    ("config", "found"),
    [
        (settings.RenderConfig(episode="nope"), "There are: scan"),
        (settings.RenderConfig(camera="nope"), "There are: wrist"),
        (settings.RenderConfig(eye=(0.0, 0.0, 1.0)), "belong together"),
        (settings.RenderConfig(eye=(0.0, 0.0, 1.0), target=(0.0, 0.0, 0.0)), "straight above"),
    ],
)
def test_a_view_that_cannot_be_drawn_is_refused(
    room: RunFolder, config: settings.RenderConfig, found: str
) -> None:
    with pytest.raises(UsageError, match=found):
        render(room, config)


def test_a_run_that_was_not_rebuilt_says_so(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match="robot-gst rebuild"):
        read_scene(RunFolder.create(tmp_path))


@pytest.mark.parametrize(
    ("text", "found"), [("{", "not JSON"), (json.dumps({"schema_version": 99}), "version 99")]
)
def test_a_damaged_scene_file_is_refused(tmp_path: Path, text: str, found: str) -> None:
    run = RunFolder.create(tmp_path)
    run.scene_dir.mkdir()
    (run.scene_dir / "scene.json").write_text(text)
    with pytest.raises(UnreadableSceneError, match=found):
        read_record(run)


def test_scans_are_preferred_and_their_absence_is_said(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path)
    textured_room.write_episode(run.episodes_dir / "trial_1.mcap", num_frames=3, kind="trial")
    alone = find_sources(run)
    assert "no scan" in alone.remark
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=3)
    both = find_sources(run)
    assert [episode.info.id for episode in both.episodes] == ["scan"]
    assert both.remark == ""


@pytest.mark.parametrize("text", ["", "soon", "-3s", "3 days", "1e3"])
def test_other_durations_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="60s, 2min"):
        settings.convert_duration(float, [SimpleNamespace(value=text)])
