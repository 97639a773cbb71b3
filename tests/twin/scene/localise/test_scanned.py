"""Objects whose shape only a scan knows: boxed in first, laid out by the scene's mesh later."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.task.meshes.catalogue import ToyMesh, toy_mesh
from bridge.task.task_file import SCANNED, ObjectModel, Task, load_task
from twin.gate.twin_process import look
from twin.scene.localise.mesh_fit import mesh_surface, scanned_surfaces
from twin.scene.localise.objects import localise_objects
from twin.scene.localise.result import BOX_METHOD, MESH_METHOD
from twin.scene.shape.known import pose_of
from twin.scene.shape.mesh import mesh_ply

SIZE_M = (0.09, 0.065, 0.08)
THING = ObjectModel(id="thing", shape=SCANNED, size_m=SIZE_M, color_srgb=(200, 60, 40))
POSE = pose_of(np.array([0.50, -0.15, 0.04, 2.1]))
CAMERAS = (
    ("side", (1.15, -0.15, 0.65), (0.45, 0.0, 0.0)),
    ("wrist", (0.48, 0.0, 0.55), (0.49, -0.08, 0.0)),
)


@pytest.fixture(scope="module")
def known() -> ToyMesh:
    """What the thing really is; nobody is told."""
    return toy_mesh("duck", SIZE_M)


@pytest.fixture
def scanned_task(task: Task) -> Task:
    start = {"thing": replace(task.start["cube"])}
    return replace(task, objects={"thing": THING}, manipulated=("thing",), start=start)


@pytest.fixture
def frames(stage: Callable[..., Any], known: ToyMesh) -> list[Any]:
    scene = stage({})
    scene.add_mesh(known.vertices_m, known.triangles, THING.color_srgb, POSE)
    rng = np.random.default_rng(0)
    return [scene.frame(name, eye, target, rng) for name, eye, target in CAMERAS]


def test_a_thing_of_unknown_shape_is_boxed_in_and_says_so(
    scanned_task: Task, frames: list[Any]
) -> None:
    found = localise_objects(frames, scanned_task)["thing"]
    assert found.found, found.reason
    assert found.method == BOX_METHOD
    assert "not known yet" in str(found.reason)
    assert np.linalg.norm(found.T_base_object[:3, 3] - POSE[:3, 3]) < 0.015
    assert found.covariance[0, 0] > 0.005**2
    found.to_record()


def test_with_the_scene_s_mesh_it_is_laid_out_front_and_back_told_apart(
    scanned_task: Task, frames: list[Any], known: ToyMesh
) -> None:
    surfaces = {"thing": mesh_surface(known.vertices_m, known.triangles, 2500)}
    found = localise_objects(frames, scanned_task, surfaces=surfaces)["thing"]
    assert found.found, found.reason
    assert found.method == MESH_METHOD
    assert np.linalg.norm(found.T_base_object[:3, 3] - POSE[:3, 3]) < 0.003
    turn = POSE[:3, :3].T @ found.T_base_object[:3, :3]
    assert np.degrees(se3.rotation_angle_rad(turn)) < 3.0


@pytest.fixture
def run(tmp_path: Path, known: ToyMesh) -> RunFolder:
    run = RunFolder.create(tmp_path / "run")
    folder = run.scene_dir / "objects" / "thing"
    folder.mkdir(parents=True)
    (folder / "mesh.ply").write_bytes(mesh_ply(known.vertices_m, known.triangles))
    (folder / "object.json").write_text(json.dumps({"shape_source": "reconstructed"}))
    record = {"schema_version": 1, "key": "k", "scene_hash": "abc", "background": {},
              "sources": [], "views": [], "objects": {"thing": {}}}  # fmt: skip
    (run.scene_dir / "scene.json").write_text(json.dumps(record))
    return run


def test_meshes_of_scanned_objects_are_read_from_the_scene(
    run: RunFolder, scanned_task: Task
) -> None:
    found = scanned_surfaces(run, scanned_task)
    assert found.surfaces["thing"].p_m.shape == (2500, 3)
    assert len(found.hashes["thing"]) == 64
    with_shape = replace(scanned_task, objects={"thing": replace(THING, shape="box")})
    assert not scanned_surfaces(run, with_shape).surfaces
    (run.scene_dir / "objects" / "thing" / "object.json").write_text(
        json.dumps({"shape_source": "task file"})
    )
    assert not scanned_surfaces(run, scanned_task).hashes


def test_what_the_scene_does_not_list_was_not_scanned_whatever_lies_about(
    run: RunFolder, scanned_task: Task
) -> None:
    path = run.scene_dir / "scene.json"
    path.write_text(path.read_text().replace('"thing"', '"duck"'))
    assert not scanned_surfaces(run, scanned_task).surfaces


def test_the_gate_lays_out_scanned_objects_by_the_scene_s_mesh(
    run: RunFolder, scanned_task: Task, frames: list[Any]
) -> None:
    found = look((run.path, frames, scanned_task))["thing"]
    assert found.found, found.reason
    assert found.method == MESH_METHOD
    assert np.linalg.norm(found.T_base_object[:3, 3] - POSE[:3, 3]) < 0.003
    (run.scene_dir / "objects" / "thing" / "object.json").unlink()
    unknown = look((run.path, frames, scanned_task))["thing"]
    assert unknown.method == BOX_METHOD


def test_a_task_file_may_leave_a_shape_to_the_scan(tmp_path: Path) -> None:
    path = tmp_path / "task.toml"
    text = (
        'schema_version = 1\nname = "t"\ninstruction = "i"\nmanipulated = ["mug"]\n'
        'stages = [{id = "lift", text = "t"}]\nsuccess = [{kind = "allowed_contacts"}]\n'
        "[start.mug]\nx_m = [0, 1]\ny_m = [0, 1]\nyaw_rad = [0, 1]\n"
        '[objects.mug]\nshape = "SHAPE"\nsize_m = [0.1, 0.08, 0.09]\ncolor_srgb = [1, 2, 200]\n'
    )
    path.write_text(text.replace("SHAPE", SCANNED))
    mug = load_task(str(path)).objects["mug"]
    assert mug.rest_height_m == pytest.approx(0.045)
    assert len(mug.panels()) == 1
    path.write_text(text.replace("SHAPE", "sphere"))
    with pytest.raises(UsageError, match="Known: box, mesh, open_box, scanned"):
        load_task(str(path))
