"""Which surface the planner uses of each object, and what it says of it."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scripted_plans import scene_of_test

from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.task.task_file import SCANNED, Task, load_task
from twin.naming.scene_file import write_semantics
from twin.naming.things import Instance, SemanticScene
from twin.plan.loop.nominal import SINGLE, PlanProposer
from twin.plan.loop.propose import NoPlanError
from twin.plan.loop.steer import tried_in
from twin.plan.problem import Problem
from twin.plan.shapes import GUESSED_SHARE, keypoints_of, problem_of, shapes_of
from twin.robot.model import load_robot
from twin.scene.gaussians import GaussianCloud, write_ply
from twin.scene.objects.decompose import shape_mesh
from twin.scene.shape.files import MESH, TASK_SHAPE
from twin.scene.shape.mesh import mesh_ply
from twin.scene.store.folder import (
    NEEDED,
    SCENE_FILE,
    SCENE_VERSION,
    SPLATS,
    UnreadableSceneError,
)

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
) -> Path:
    """A scene folder with the cube, larger and elsewhere than the task file has it."""
    place = folder / "objects" / "cube"
    place.mkdir(parents=True)
    vertices, triangles = shape_mesh(task.objects["cube"])
    (place / MESH).write_bytes(mesh_ply(vertices * scale + SHIFT_M, triangles))
    geometry = {"watertight": closed, "truncation_m": TRUNCATION_M, "voxel_m": 0.0015}
    about = {"shape_source": source, "geometry": geometry}
    (place / "object.json").write_text(json.dumps(about))
    return folder


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
    path = written(tmp_path, task) / "objects" / "cube" / name
    path.write_bytes(path.read_bytes()[:-3])
    shape = shapes_of(tmp_path, task)["cube"]
    assert shape.source.startswith("task file")
    assert ("damaged" in shape.source) or (MESH in shape.source)


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


def with_parts(folder: Path, task: Task) -> Task:
    """A scene whose cube has a top of its own; the task takes it by that."""
    points = np.random.default_rng(1).uniform(-0.02, 0.02, (60, 3)).astype(np.float32)
    num, top = len(points) + 5, points[:, 2] > 0.0
    cloud = GaussianCloud(
        means_m=points + SHIFT_M.astype(np.float32),
        quats_wxyz=np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (60, 1)),
        scales_log=np.full((60, 3), -6, dtype=np.float32),
        opacities_logit=np.ones(60, dtype=np.float32),
        colors=np.ones((60, 3), dtype=np.float32),
    )
    write_ply(folder / "objects" / "cube" / SPLATS, cloud)
    mask = np.arange(num) >= 5
    cube = Instance(
        id=1, label="cube", mask=mask, support=1, seen=1, score=1.0, source="test",
        color_srgb=(1, 2, 3), T_base_instance=np.eye(4), size_m=(0.04, 0.04, 0.04),
        parts={"top": np.concatenate([np.zeros(5, dtype=bool), top])},
    )  # fmt: skip
    scene = SemanticScene(instances=(cube,), labels=mask.astype(np.uint16), source="test")
    write_semantics(folder, scene, {"background": 5, "cube": 60})
    record: dict[str, Any] = {**dict.fromkeys(NEEDED, ""), "schema_version": SCENE_VERSION}
    record |= {"background": {"num_splats": 5}, "objects": {"cube": {"num_splats": 60}}}
    (folder / SCENE_FILE).write_text(json.dumps(record))
    return replace(task, stages=({**task.stages[0], "part": "top"}, *task.stages[1:]))


def test_parts_of_the_scene_are_where_the_surface_is(tmp_path: Path, task: Task) -> None:
    folder = written(tmp_path / "scene", task)
    taken = with_parts(folder, task)
    parts = shapes_of(folder, taken)["cube"].parts_m
    assert list(parts) == ["top"]
    assert parts["top"][:, 2].min() > 0.0
    assert np.abs(parts["top"]).max() <= 0.0201  # moved back with the surface
    assert shapes_of(folder, task)["cube"].parts_m == {}


def with_keypoints(folder: Path, **changes: Any) -> None:
    """A scene that names two points of its cube, in the base frame it was scanned in."""
    T = se3.transform_from(np.array([0.8, 0.0, 0.0, 0.6]), np.array([0.5, 0.1, 0.02]))
    places = {"top": (0.0, 0.0, 0.02), "centre": (0.0, 0.0, 0.0)}
    points = {name: se3.apply(T, np.array(p) + SHIFT_M).tolist() for name, p in places.items()}
    about = {"object": "cube", "num_splats": 60, "keypoints_m": points | changes}
    record: dict[str, Any] = {**dict.fromkeys(NEEDED, ""), "schema_version": SCENE_VERSION}
    record |= {"semantics": {"instances": [about, {"object": None, "num_splats": 1}]}}
    record |= {"objects": {"cube": {"T_base_object": se3.pose_record(T)}}}
    (folder / SCENE_FILE).write_text(json.dumps(record))


def test_keypoints_of_the_scene_are_numbered_and_where_the_surface_is(
    tmp_path: Path, task: Task
) -> None:
    folder = written(tmp_path / "scene", task)
    with_keypoints(folder)
    centre, top = keypoints_of(shapes_of(folder, task))
    assert (centre.words, top.words) == ("cube's centre", "cube's top")
    assert top.object_id == "cube"
    np.testing.assert_allclose(centre.p_m, 0.0, atol=1e-6)  # moved back with the surface
    np.testing.assert_allclose(top.p_m, (0.0, 0.0, 0.02), atol=1e-6)
    assert keypoints_of(shapes_of(None, task)) == ()


def test_keypoints_that_are_none_name_the_file(tmp_path: Path, task: Task) -> None:
    folder = written(tmp_path / "scene", task)
    with_keypoints(folder, top=[0.0, 1.0])
    with pytest.raises(UnreadableSceneError, match=SCENE_FILE):
        shapes_of(folder, task)


@pytest.mark.slow
def test_a_part_restricts_the_grasp_or_is_said_to_be_missing(tmp_path: Path, task: Task) -> None:
    folder = written(tmp_path / "scene", task)
    sure = {name: np.eye(6) * 1e-8 for name in task.objects}
    replay = replace(scene_of_test(), covariances=sure)
    free = Problem(
        scene=replay, robot=load_robot(ROBOT.urdf_text()), shapes=shapes_of(folder, task)
    )
    taken = with_parts(folder, task)
    problem = replace(free, scene=replace(replay, task=taken), shapes=shapes_of(folder, taken))
    proposer = PlanProposer(SINGLE)

    def grasp_x_m(part_x_m: float) -> float:
        """Where along x the cube is taken whose part is a strip of its two faces across y."""
        z = np.linspace(-0.015, 0.015, 9)
        strip = [np.stack([0 * z + part_x_m, 0 * z + y, z], axis=1) for y in (-0.02, 0.02)]
        cube = replace(problem.shapes["cube"], parts_m={"top": np.concatenate(strip)})
        here = replace(problem, shapes={**problem.shapes, "cube": cube})
        (found,) = proposer.propose(here, plan_id="p", seed=0, count=1, steer=None)
        return float(tried_in(found.plan)[0].T_object_tcp[0, 3])

    assert grasp_x_m(0.012) > 0.002
    assert grasp_x_m(-0.012) < -0.002
    lost = replace(problem, shapes=free.shapes)
    with pytest.raises(NoPlanError, match="takes cube by its top, and the scene has no such part"):
        proposer.propose(lost, plan_id="p", seed=0, count=1, steer=None)
    corner = replace(problem.shapes["cube"], parts_m={"top": np.array([[0.02, 0.02, 0.02]])})
    tight = replace(problem, shapes={**problem.shapes, "cube": corner})
    with pytest.raises(NoPlanError, match="not on the named part"):
        proposer.propose(tight, plan_id="p", seed=0, count=1, steer=None)
