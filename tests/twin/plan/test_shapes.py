"""Which surface the planner uses of each object, and what it says of it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bridge.episode.run_folder import RunFolder
from bridge.robots.default import ROBOT
from bridge.task.task_file import SCANNED, Task, load_task
from twin.plan.shapes import GUESSED_SHARE, problem_of, shapes_of
from twin.scene.shape.known import shape_mesh
from twin.scene.shape.mesh import mesh_ply
from twin.scene.store.library import MESH, TASK_SHAPE, Library

SHIFT_M = np.array([0.004, -0.002, -0.001])
TRUNCATION_M = 0.006


@pytest.fixture
def task() -> Task:
    return load_task("cube_into_box")


def written(
    folder: Path,
    task: Task,
    *,
    scale: float = 1.0,
    source: str = "reconstructed",
    closed: bool = True,
) -> Library:
    """A scene with the cube, larger and elsewhere than the task file has it."""
    place = folder / "objects" / "cube"
    place.mkdir(parents=True)
    vertices, triangles = shape_mesh(task.objects["cube"])
    (place / MESH).write_bytes(mesh_ply(vertices * scale + SHIFT_M, triangles))
    geometry = {"watertight": closed, "truncation_m": TRUNCATION_M, "voxel_m": 0.0015}
    about = {"shape_source": source, "geometry": geometry}
    (place / "object.json").write_text(json.dumps(about))
    return Library(folder=folder / "objects", objects={"cube": {}})


def test_a_scanned_surface_is_put_where_localisation_has_the_object(
    tmp_path: Path, task: Task
) -> None:
    shape = shapes_of(written(tmp_path, task, scale=1.05), task)["cube"]
    middle = (shape.vertices_m.min(axis=0) + shape.vertices_m.max(axis=0)) / 2
    np.testing.assert_allclose(middle[:2], 0.0, atol=1e-7)
    np.testing.assert_allclose(shape.vertices_m[:, 2].min(), -0.02, atol=1e-7)
    np.testing.assert_allclose(np.ptp(shape.vertices_m, axis=0), 0.042, atol=1e-6)
    assert shape.source.startswith("scan (reconstructed), moved by 4.")
    assert shape.error_m == 0.0015


def test_its_lowest_band_is_not_trusted(tmp_path: Path, task: Task) -> None:
    shape = shapes_of(written(tmp_path, task), task)["cube"]
    np.testing.assert_allclose(shape.trusted_from_m, -0.02 + TRUNCATION_M, atol=1e-7)


def test_a_scanned_object_keeps_the_frame_of_its_scan(tmp_path: Path, task: Task) -> None:
    cube = replace(task.objects["cube"], shape=SCANNED)
    scanned = replace(task, objects=task.objects | {"cube": cube})
    shape = shapes_of(written(tmp_path, task), scanned)["cube"]
    np.testing.assert_allclose(shape.vertices_m.mean(axis=0), SHIFT_M, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scale": 1.4}, "40% off"),
        ({"source": TASK_SHAPE}, "did not reconstruct"),
        ({"closed": False}, "not closed"),
    ],
)
def test_what_cannot_be_used_is_stood_in_for_by_the_task(
    tmp_path: Path, task: Task, change: dict[str, float | str | bool], said: str
) -> None:
    shape = shapes_of(written(tmp_path, task, **change), task)["cube"]  # type: ignore[arg-type]
    np.testing.assert_array_equal(shape.vertices_m, shape_mesh(task.objects["cube"])[0])
    assert said in shape.source
    assert shape.source.startswith("task file")


@pytest.mark.parametrize("name", [MESH, "object.json"])
def test_a_damaged_file_is_said_and_stood_in_for(tmp_path: Path, task: Task, name: str) -> None:
    library = written(tmp_path, task)
    path = library.folder / "cube" / name
    path.write_bytes(path.read_bytes()[:-3])
    shape = shapes_of(library, task)["cube"]
    assert shape.source.startswith("task file")
    assert ("damaged" in shape.source) or (MESH in shape.source)


def test_what_the_scene_does_not_list_was_not_scanned(tmp_path: Path, task: Task) -> None:
    shape = shapes_of(replace(written(tmp_path, task, scale=1.05), objects={}), task)["cube"]
    np.testing.assert_array_equal(shape.vertices_m, shape_mesh(task.objects["cube"])[0])
    assert shape.source == "task file: not scanned"


def test_without_a_scene_every_object_has_the_task_files_shape(task: Task) -> None:
    shapes = shapes_of(None, task)
    assert shapes.keys() == task.objects.keys()
    assert all(shape.error_m == 0 for shape in shapes.values())
    cube = replace(task.objects["cube"], shape=SCANNED)
    guess = shapes_of(None, replace(task, objects={"cube": cube}))["cube"]
    assert guess.error_m == GUESSED_SHARE * 0.04
    assert "only the box around it" in guess.source


def test_a_problem_knows_where_everything_is(tmp_path: Path, task: Task) -> None:
    (tmp_path / "scene").mkdir()
    written(tmp_path / "scene", task)
    record = {"schema_version": 1, "key": "k", "scene_hash": "h", "background": {},
              "sources": [], "views": [], "objects": {"cube": {}}}  # fmt: skip
    (tmp_path / "scene" / "scene.json").write_text(json.dumps(record))
    T = np.eye(4)
    T[:3, 3] = (0.5, -0.1, 0.02)
    start, sure = np.array(ROBOT.home_rad), np.eye(6) * 1e-6
    given = problem_of(
        RunFolder(tmp_path), task, ROBOT.description(), {"cube": T}, {"cube": sure}, start
    )
    np.testing.assert_array_equal(given.scene.Ts_base_object["cube"], T)
    np.testing.assert_array_equal(given.scene.covariances["cube"], sure)
    assert given.scene.missing() == ["box"]
    assert given.scene.start_rad is start
    assert given.shapes["cube"].source.startswith("scan")
    assert given.shapes["box"].source.startswith("task file")
    assert given.robot.name == ROBOT.name
