"""What a rebuilt scene adds: lattices that can be trusted, distances, calibrated physics."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bridge.episode.run_folder import RunFolder
from bridge.task.meshes.catalogue import toy_mesh
from bridge.task.task_file import load_task
from twin.npz import UnreadableArraysError
from twin.physics.config import PhysicsConfig
from twin.physics.soft import SoftModel
from twin.replay.config import ReplayConfig
from twin.replay.rebuilt_scene import calibrated, read_rebuilt_scene, shape_hashes
from twin.scene.shape.reconstruct import shape_of_mesh
from twin.scene.shape.sdf import SdfGrid
from twin.scene.shape.static import StaticSdf
from twin.scene.store.calibration import Calibration

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


def calibration(**identified: object) -> Calibration:
    record = {"calibration_id": "12345678", "physics": {"identified": identified}}
    return Calibration(record=record, cameras={})


def test_calibrated_physics_is_used_where_the_user_said_nothing() -> None:
    values = {"object_friction": {"value": 0.42}, "grip_force_N": {"value": 9.0}}
    found = calibration(**values, gravity_m_s2=None)
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
