"""What a rebuilt scene, a calibration and localisation each add to a replay."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.task.meshes.catalogue import toy_mesh
from bridge.task.task_file import load_task
from bridge.terminal import Output
from twin.cli import replay
from twin.npz import UnreadableArraysError
from twin.physics.config import PhysicsConfig
from twin.physics.soft import SoftModel
from twin.replay.config import ReplayConfig
from twin.replay.job import ReplayJob
from twin.replay.rebuilt_scene import calibrated, for_task, read_rebuilt_scene, shape_hashes
from twin.replay.run_job import run_job
from twin.replay.scene import StartState, localised_starts
from twin.scene.shape.reconstruct import shape_of_mesh
from twin.scene.shape.sdf import SdfGrid
from twin.scene.shape.static import StaticSdf
from twin.scene.store.calibration import Calibration, read_calibration, write_physics

TASK = load_task("sloth_into_basket")


def shape_of_task(stretch: float = 1.0) -> SdfGrid:
    """The task's own shape as a scene would hold it."""
    mesh = toy_mesh("sloth", TASK.objects["sloth"].size_m)
    return shape_of_mesh(mesh.vertices_m * np.array([stretch, 1.0, 1.0]), mesh.triangles).sdf


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """A scene with a shape of the sloth and nothing else."""
    folder = RunFolder.create(tmp_path / "run")
    place = folder.scene_dir / "objects" / "sloth"
    place.mkdir(parents=True)
    shape_of_task().save(place / "sdf.npz")
    write_object(folder, watertight=True)
    record = {"schema_version": 1, "key": "k", "scene_hash": "abc", "background": {},
              "sources": [], "views": [], "objects": {"sloth": {}}}  # fmt: skip
    (folder.scene_dir / "scene.json").write_text(json.dumps(record))
    return folder


def write_object(run: RunFolder, *, watertight: bool) -> None:
    about = {"geometry": {"watertight": watertight}}
    (run.scene_dir / "objects" / "sloth" / "object.json").write_text(json.dumps(about))


def test_without_a_scene_the_task_file_says_everything(tmp_path: Path) -> None:
    place = read_rebuilt_scene(RunFolder.create(tmp_path / "run"), TASK)
    assert (place.scene_hash, place.static_sdf, dict(place.lattices)) == (None, None, {})


def test_the_lattice_of_the_scene_is_taken_and_named(run: RunFolder) -> None:
    place = read_rebuilt_scene(run, TASK)
    assert place.scene_hash == "abc"
    assert not any("sloth" in note for note in place.notes)
    body = SoftModel.from_lattice(place.lattices["sloth"], TASK.objects["sloth"])
    own = SoftModel.from_task(TASK.objects["sloth"])
    assert body.volume_m3() == pytest.approx(own.volume_m3(), rel=0.1)
    assert any("sdf.npz" in note for note in place.notes)


def test_a_mesh_that_is_not_watertight_is_not_believed(run: RunFolder) -> None:
    write_object(run, watertight=False)
    place = read_rebuilt_scene(run, TASK)
    assert not place.lattices
    assert "not watertight" in place.notes[0]


def test_a_lattice_of_another_size_is_another_body(run: RunFolder) -> None:
    shape_of_task(stretch=1.5).save(run.scene_dir / "objects" / "sloth" / "sdf.npz")
    place = read_rebuilt_scene(run, TASK)
    assert not place.lattices
    assert "% off)" in place.notes[0]


def test_a_damaged_lattice_is_passed_over_with_the_reason(run: RunFolder) -> None:
    (run.scene_dir / "objects" / "sloth" / "sdf.npz").write_bytes(b"no arrays")
    place = read_rebuilt_scene(run, TASK)
    assert not place.lattices
    assert "sdf.npz" in place.notes[0]
    assert any("sloth: shape of the task file" in note for note in place.notes)


def write_distances(run: RunFolder, observed_m: float) -> None:
    values = np.full((4, 4, 4), 0.1, dtype=np.float32)
    grid = SdfGrid(values_m=values, origin_m=np.zeros(3), voxel_m=0.1, closed=False)
    observed = values.copy()
    observed[1, 1, 1] = observed_m
    StaticSdf(conservative=grid, observed=replace(grid, values_m=observed)).save(
        run.scene_dir / "sdf.npz"
    )


def test_distances_that_cannot_be_read_are_no_free_way(run: RunFolder) -> None:
    """Somebody saw what stands there: without it nothing may be accepted."""
    path = run.scene_dir / "sdf.npz"
    path.write_bytes(b"no arrays")
    with pytest.raises(UnreadableArraysError, match=r"sdf\.npz: .*robot-gst rebuild RUN --force"):
        read_rebuilt_scene(run, TASK)
    write_distances(run, np.nan)
    with pytest.raises(UnreadableArraysError, match=r"sdf\.npz: a distance is not finite"):
        read_rebuilt_scene(run, TASK)
    write_distances(run, -0.1)
    assert read_rebuilt_scene(run, TASK).static_sdf is not None


def calibration(**physics: Any) -> Calibration:
    return Calibration(record={"calibration_id": "12345678", "physics": physics}, cameras={})


def test_calibrated_physics_is_used_where_the_user_said_nothing() -> None:
    values = {"object_friction": {"value": 0.42}, "grip_force_N": {"value": 9.0}}
    found = calibration(identified={**values, "gravity_m_s2": None})
    physics = calibrated(ReplayConfig(), found, TASK).physics
    assert (physics.object_friction, physics.grip_force_N) == (0.42, 9.0)
    assert physics.gravity_m_s2 == PhysicsConfig().gravity_m_s2
    mine = ReplayConfig(physics=PhysicsConfig(object_friction=0.7))
    physics = calibrated(mine, found, TASK).physics
    assert (physics.object_friction, physics.grip_force_N) == (0.7, 9.0)


def test_other_shapes_are_other_replays(run: RunFolder) -> None:
    before = shape_hashes(run)
    assert list(before) == ["objects/sloth/sdf.npz"]
    shape_of_task(stretch=1.1).save(run.scene_dir / "objects" / "sloth" / "sdf.npz")
    assert shape_hashes(run) != before


T0 = 1_700_000_000_000_000_000


def with_calibration(run: RunFolder, **physics: Any) -> Calibration:
    """As the command writes it."""
    write_physics(run, {"promoted": True, "identified": {}, "id": "x", **physics})
    found = read_calibration(run)
    assert found is not None
    return found


def test_a_replay_names_its_calibration(tmp_path: Path, script: SimpleNamespace) -> None:
    run, scene = RunFolder.create(tmp_path / "run"), script.scene()
    known = with_calibration(run)
    plan = script.plan(scene)
    plan = replace(plan, tau=plan.tau[:1])
    path = run.episodes_dir / "trial_0001.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial", task="cube_into_box"))
        for topic, data, kind in (
            ("/robot_description", string_to_cdr(scene.urdf), schema.STRING),
            ("/standin/plan", plan.to_json(), schema.PLAN),
        ):
            writer.write(topic, data, type_name=kind, log_time_ns=T0)
    run.derived_dir.mkdir(exist_ok=True)
    job = ReplayJob(
        episode_path=path, episode_sha256="0" * 64, plan_id=plan.id, plan_index=0,
        trajectory="planned", start_ns=T0, end_ns=None, task=load_task("cube_into_box"),
        start=StartState(Ts_base_object=scene.Ts_base_object), scene_hash=None,
        config=ReplayConfig(mode="kinematic"), folder=run.derived_dir, run_path=run.path,
        calibration_id=known.calibration_id,
    )  # fmt: skip
    assert run_job(job)["error"] is None
    episode = Episode.open(job.path())
    box = streams.pose_track(episode, streams.object_pose_topics(episode)["box"])
    assert box.p_m[0] == pytest.approx(scene.Ts_base_object["box"][:3, 3])
    assert episode.derived is not None
    assert episode.derived.calibration_id == known.calibration_id
    assert json.dumps(job.settings()) != json.dumps(replace(job, calibration_id="0").settings())


def test_the_gripper_presses_as_the_task_is_set_unless_somebody_knows_better() -> None:
    toys, cube = load_task("sloth_into_basket"), load_task("cube_into_box")
    assert toys.grip_force_N == 9.0, "what holds a wooden cube crushes a toy"
    assert cube.grip_force_N is None
    assert for_task(ReplayConfig(), None, toys).physics.grip_force_N == 9.0
    assert for_task(ReplayConfig(), None, cube) == ReplayConfig()
    mine = ReplayConfig(physics=PhysicsConfig(grip_force_N=15.0))
    assert for_task(mine, None, toys) == mine
    found = calibration(identified={"grip_force_N": {"value": 7.5}})
    assert for_task(ReplayConfig(), found, toys).physics.grip_force_N == 7.5


def test_an_episode_without_cameras_starts_from_nothing_and_says_why(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path)
    with EpisodeWriter(run.episodes_dir / "trial_0001.mcap") as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial", cell="standin"))
        writer.write(
            "/standin/event",
            {"schema_version": 1, "stamp_ns": 5, "type": "mark"},
            type_name="gst/Event",
            log_time_ns=5,
        )
    episode = Episode.open(run.episodes_dir / "trial_0001.mcap")
    task = load_task("cube_into_box")
    start = localised_starts(run, episode, task, scene_hash=None).at(10)
    assert not start.Ts_base_object
    assert set(start.reasons) == {"cube", "box"}
    assert all(start.reasons.values())


def test_the_command_refuses_a_run_without_episodes(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no episodes in"):
        replay(RunFolder.create(tmp_path / "run").path, output=Output(quiet=True, json=True))
