"""Objects in the Rerun file: Gaussians where they were from the first instant on; the nearest."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import rerun.chunk as rc
from PIL import Image
from rerun_cell import write_localised
from test_rerun_view import read_back
from test_space import ID, bent_nodes, cloud, soften, write_space_run

from bridge.episode import schema, streams
from bridge.episode.provenance import hash_file
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.robots.default import ROBOT
from bridge.task.verdict import Factor
from dashboards import rerun_objects, rerun_viewer
from dashboards.rerun_view import export_rrd
from twin.robot.model import load_robot
from twin.robot.posture import posture_track
from twin.scene.gaussians import GaussianCloud, as_float32, write_ply
from twin.scene.movable_scene import read_movable_scene
from twin.scene.skinning import bind, pose_cloud
from twin.scene.store.folder import read_scene

Content = dict[str, dict[str, list[object]]]
SECOND_NS = 1_000_000_000
CLOSED_S, OPEN_S = 3.05, 5.2
"""When the recorded fingers stand closed, and are open again, after the first sample."""
NEAREST = {
    "t_ns": 2 * SECOND_NS,
    "distance_m": 0.0123,
    "bodies": ["gripper_left_finger", "box"],
    "p_m": [[0.4, 0.1, 0.2], [0.4, 0.1, 0.1877]],
}


def say_nearest(run: RunFolder, **changed: object) -> None:
    """Write the replay again; its verdict says where the smallest clearance was, or as told."""
    (replay,) = run.derived("*.replay.*")
    opened = Episode.open(replay)
    ((_, verdict),) = streams.verdicts(opened)
    with EpisodeWriter(run.derived_dir / replay.name.replace(".bullet.", ".near.")) as writer:
        writer.describe(opened.info, derived=opened.derived)
        for message in opened.messages():
            data = message.data
            if message.type_name == schema.VERDICT:
                data = replace(verdict, **({"nearest": NEAREST} | changed)).to_json()
            writer.write(
                message.topic,
                data,
                type_name=message.type_name,
                log_time_ns=message.log_time_ns,
                publish_time_ns=message.publish_time_ns,
            )
    replay.unlink()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, synthetic: ModuleType) -> RunFolder:
    """Return the run of the 3D view, whose cube lies between the fingers as they close."""
    run = write_space_run(tmp_path_factory.mktemp("objects"), synthetic)
    (localised,) = run.derived("*.localised.*")
    localised.unlink()
    write_localised(run, ID, synthetic.START_NS, tool_at(run, synthetic, CLOSED_S)[:3, 3].tolist())
    say_nearest(run)
    return run


def tool_at(run: RunFolder, synthetic: ModuleType, t_s: float) -> np.ndarray:
    track = posture_track(Episode.open(run.episodes()[0]))
    at = track.at(synthetic.START_NS + round(t_s * SECOND_NS))
    return load_robot(ROBOT.description()).T_base_tcp(at.joints_rad)


@pytest.fixture(scope="module")
def content(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Content:
    out = tmp_path_factory.mktemp("out") / "trial.rrd"
    export_rrd(run.episodes()[0], out, run)
    return read_back(out)


def place_at(content: Content, entity: str, stamp_ns: int) -> np.ndarray:
    """Where Rerun shows an entity: its last row up to an instant."""
    rows = zip(
        content[entity]["source_time"], content[entity]["Transform3D:translation"], strict=False
    )
    known = sorted((stamp, row[0]) for stamp, row in rows if stamp is not None and row)
    assert known[0][0] <= stamp_ns, f"{entity} is not there yet"
    return np.array([row for stamp, row in known if stamp <= stamp_ns][-1])


def test_recorded_objects_are_there_from_the_first_instant_and_go_with_the_hand(
    run: RunFolder, synthetic: ModuleType, content: Content
) -> None:
    start = tool_at(run, synthetic, CLOSED_S)
    for t_s, wanted in (
        (0.0, start),
        (2.0, start),
        (4.0, tool_at(run, synthetic, 4.0)),
        (4.8, tool_at(run, synthetic, 4.8)),
    ):
        found = place_at(content, "/localised/cube", synthetic.START_NS + round(t_s * SECOND_NS))
        np.testing.assert_allclose(found, wanted[:3, 3], atol=2e-3)
    left = place_at(content, "/localised/cube", synthetic.START_NS + round(OPEN_S * SECOND_NS))
    last = place_at(content, "/localised/cube", synthetic.START_NS + 100 * SECOND_NS)
    np.testing.assert_array_equal(left, last)
    assert np.linalg.norm(last - start[:3, 3]) > 0.02, "the hand carried it"


def test_a_replayed_object_stands_at_its_start_until_the_replay_begins(
    synthetic: ModuleType, content: Content
) -> None:
    entity = "/replayed/planned/dynamic/objects/cube"
    begun = synthetic.EXECUTION_NS
    np.testing.assert_allclose(place_at(content, entity, synthetic.START_NS), [0.45, 0, 0.02])
    lifted = place_at(content, entity, begun + round(2.75 * SECOND_NS))
    np.testing.assert_allclose(lifted, [0.45, 0, 0.02 + 0.08 * 0.55], atol=1e-6)
    ended = place_at(content, entity, begun + 50 * SECOND_NS)
    np.testing.assert_allclose(ended, [0.45, 0, 0.02], atol=1e-6)


def test_both_show_the_scenes_gaussians_the_replayed_ones_tinted(
    run: RunFolder, content: Content
) -> None:
    own_cloud = read_movable_scene(run, read_scene(run)).objects["cube"].cloud
    colors = {}
    for entity in ("/localised/cube", "/replayed/planned/dynamic/objects/cube"):
        splats = content[f"{entity}/gaussians"]
        np.testing.assert_allclose(
            splats["GaussianSplats3D:centers"][0], own_cloud.means_m, atol=1e-6
        )
        packed = np.array(splats["GaussianSplats3D:colors"][0], dtype=np.uint32)
        colors[entity] = packed.view(np.uint8).reshape(-1, 4)[:, ::-1].astype(float)
        assert splats.get("source_time", [None]) == [None], "at all times"
    recorded, replayed = colors.values()
    own = np.clip(own_cloud.colors, 0, 1) * 255
    np.testing.assert_allclose(recorded[:, :3], own, atol=1)
    np.testing.assert_allclose(recorded[:, 3], replayed[:, 3])
    blue = np.array([29, 100, 216])
    np.testing.assert_allclose(replayed[:, :3], 0.45 * own + 0.55 * blue, atol=1)
    boxes = content["/replayed/planned/dynamic/objects/cube"]["Boxes3D:colors"]
    assert next(row for row in boxes if row)[0] == 0x1D64D8FF


def test_a_replayed_soft_object_is_bent_as_the_rasteriser_bends_it(
    tmp_path: Path, synthetic: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = write_space_run(tmp_path, synthetic)
    axis = np.linspace(-0.055, 0.055, 7)
    rest_m = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    soften(run, rest_m)
    monkeypatch.setattr(rerun_objects, "MAX_SOFT_SPLATS", 60)
    shown = export_rrd(run.episodes()[0], tmp_path / "soft.rrd", run)
    assert not [note for note in shown.notes if "bent" in note]
    bent = read_back(shown.path)["/replayed/planned/dynamic/objects/cube/gaussians"]
    rows = {
        stamp: (np.array(centers), np.array(turns))
        for stamp, centers, turns in zip(
            bent["source_time"],
            bent["GaussianSplats3D:centers"],
            bent["GaussianSplats3D:quaternions"],
            strict=True,
        )
        if stamp is not None
    }
    assert min(rows) == synthetic.START_NS, "from the first instant on, unbent"
    whole = read_movable_scene(run, read_scene(run)).objects["cube"].cloud
    first_m, _ = rows[min(rows)]
    ids = [int(np.abs(whole.means_m - p).sum(axis=1).argmin()) for p in first_m]
    assert len(set(ids)) == 60
    own = whole.take(np.array(ids))
    np.testing.assert_allclose(first_m, own.means_m, atol=1e-5)
    binding = bind(own.means_m, rest_m)
    for wanted_s in (1.0, 2.0, 3.0):
        stamp = min(rows, key=lambda ns: abs(ns - synthetic.EXECUTION_NS - wanted_s * SECOND_NS))
        t_s = (stamp - synthetic.EXECUTION_NS) / SECOND_NS
        assert abs(t_s - wanted_s) < 0.1
        expected = pose_cloud(own, binding, bent_nodes(np.eye(4), rest_m, t_s))
        found_m, turns = rows[stamp]
        np.testing.assert_allclose(found_m, expected.means_m, atol=1e-3)
        unit = expected.quats_wxyz / np.linalg.norm(expected.quats_wxyz, axis=1, keepdims=True)
        turns = np.roll(turns / np.linalg.norm(turns, axis=1, keepdims=True), 1, axis=1)
        assert np.abs((unit * turns).sum(axis=1)).min() > 0.999
    assert np.abs(found_m - own.means_m).max() > 0.02, "it is bent by centimetres"
    steps_m = [np.abs(b[0] - a[0]).max() for a, b in pairwise(rows[at] for at in sorted(rows))]
    assert min(steps_m) > rerun_objects.BENT_M, "written again only where it moved"


def test_an_object_whose_nodes_are_missing_is_drawn_unbent_and_that_is_noted(
    tmp_path: Path, synthetic: ModuleType
) -> None:
    run = write_space_run(tmp_path, synthetic)
    soften(run, np.zeros((4, 3)))  # too few to bend anything
    shown = export_rrd(run.episodes()[0], tmp_path / "soft.rrd", run)
    assert "cube: as replayed (planned) drawn without being bent" in shown.notes
    splats = read_back(shown.path)["/replayed/planned/dynamic/objects/cube/gaussians"]
    assert splats.get("source_time", [None]) == [None], "at all times"


def test_the_nearest_points_appear_at_their_instant(
    synthetic: ModuleType, content: Content
) -> None:
    line = content["/replayed/planned/dynamic/nearest"]
    assert line["source_time"] == [synthetic.EXECUTION_NS + NEAREST["t_ns"]]
    np.testing.assert_allclose(line["LineStrips3D:strips"][0][0], NEAREST["p_m"], atol=1e-6)
    assert line["LineStrips3D:labels"] == [["planned: 12.3 mm from gripper_left_finger to box"]]
    ends = content["/replayed/planned/dynamic/nearest/points"]
    np.testing.assert_allclose(ends["Points3D:positions"][0], NEAREST["p_m"], atol=1e-6)


@pytest.mark.parametrize(
    ("clearance", "said"),
    [(None, "is not shown: it was not measured"), (True, "its replay does not say")],
)
def test_a_clearance_without_its_place_is_noted(
    clearance: bool | None, said: str, tmp_path: Path, synthetic: ModuleType
) -> None:
    run = write_space_run(tmp_path, synthetic)
    cause = None if clearance else "refused before"
    say_nearest(run, nearest=None, clearance=Factor(value=clearance, detail=cause))
    shown = export_rrd(run.episodes()[0], tmp_path / "x.rrd", run)
    (note,) = (each for each in shown.notes if "smallest clearance" in each)
    assert said in note


def test_the_planned_way_is_shown_beside_the_executed_one(
    run: RunFolder, content: Content, synthetic: ModuleType, tmp_path: Path
) -> None:
    plan = synthetic.make_plan(synthetic.TRIALS[0])
    way = content[f"/plans/{plan.id}/tool_path"]["LineStrips3D:strips"][0][0]
    np.testing.assert_allclose(way, plan.positions_m(), atol=1e-6)
    reader = rc.RrdReader(export_rrd(run.episodes()[0], tmp_path / "x.rrd", run).path)
    queries = [
        query
        for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks()
        if str(chunk.entity_path).endswith("ViewContents")
        for row in chunk.to_record_batch().column("ViewContents:query").to_pylist()
        for query in [row]
    ]
    (space,) = (query for query in queries if "+ /**" in query)
    assert f"+ /plans/{plan.id}/tool_path" in space


OWN, TINTED = np.array([230, 40, 230]), np.array([119, 73, 222])
"""Of the cube in the picture, and the same with its trajectory's blue."""


def plain(rgb: np.ndarray, *, logit: float) -> GaussianCloud:
    """Gaussians of one colour."""
    return replace(
        cloud(2, 80, 0.05, 0.015),
        colors=as_float32(np.tile(rgb, (80, 1))),
        harmonics=as_float32(np.zeros((80, 0, 3))),
        opacities_logit=as_float32(np.full(80, logit)),
    )


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="no xvfb-run (Debian: xvfb)")
def test_the_viewer_draws_both_cubes_at_the_first_instant(
    run: RunFolder, synthetic: ModuleType, tmp_path: Path
) -> None:
    shown = RunFolder(shutil.copytree(run.path, tmp_path / "shown"))
    write_ply(shown.scene_dir / "background.ply", plain(np.full(3, 0.2), logit=-5.0))
    write_ply(shown.scene_dir / "objects" / "cube" / "gaussians.ply", plain(OWN / 255, logit=5.0))
    scene = json.loads((shown.scene_dir / "scene.json").read_text())
    scene["scene_hash"] = hash_file(shown.scene_dir / "background.ply")[:12]
    scene["background"] = {"num_splats": 80}
    (shown.scene_dir / "scene.json").write_text(json.dumps(scene))
    out = export_rrd(shown.episodes()[0], tmp_path / "trial.rrd", shown).path
    picture = tmp_path / "trial.png"
    viewer = [sys.executable, "-m", *rerun_viewer.viewer_arguments(out)]
    # The screen is larger than the window, for the pointer is in its middle and says what is there.
    screen = ["xvfb-run", "-a", "-s", "-screen 0 3000x2400x24"]
    size = ["--window-size", "500x400", "--screenshot-to", str(picture)]
    done = subprocess.run(
        [*screen, *viewer, *size], capture_output=True, text=True, timeout=240, check=False
    )
    if not picture.is_file() and "adapter" in done.stderr:
        pytest.skip("no Vulkan here, not even in software (Debian: mesa-vulkan-drivers)")
    assert picture.is_file(), done.stderr
    with Image.open(picture) as image:
        space = np.asarray(image.convert("RGB"))[160:500, :580].astype(int)
    for color in (OWN, TINTED):
        near = np.abs(space - color).max(axis=2) < 35
        assert near.sum() > 60, (color, near.sum())
