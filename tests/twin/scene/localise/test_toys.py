"""Meshes and soft toys in ray-cast frames: laws, equal ones, deformed ones, and none at all."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.record import check_record
from bridge.task.task_file import Task, load_task
from twin.scene.localise.mesh import agreeing, known_surface, seen_through, surface_of
from twin.scene.localise.objects import LocaliseConfig, localise, localise_objects
from twin.scene.localise.points import fuse_stills
from twin.scene.shape.known import pose_of

SLOTH, DUCKS = load_task("sloth_into_basket"), load_task("five_ducks_into_basket")
DUCK = DUCKS.objects["duck_1"]
SIDE = ("side", (1.15, -0.15, 0.65), (0.45, 0.0, 0.0))
WRIST = ("wrist", (0.48, -0.1, 0.55), (0.49, -0.12, 0.0))
AT = pose_of(np.array([0.50, -0.15, 0.03, 0.4]))


def only(task: Task, *names: str) -> Task:
    objects = {key: task.objects[key] for key in names}
    return replace(task, objects=objects, start={key: task.start[key] for key in names})


def shoot(scene: Any, seed: int = 0) -> list[RgbdFrame]:
    rng = np.random.default_rng(seed)
    return [scene.frame(name, eye, target, rng) for name, eye, target in (SIDE, WRIST)]


def table_with(stage: Callable[..., Any], *things: tuple[Any, np.ndarray]) -> Any:
    """A table, and models put down on it."""
    scene = stage({})
    for model, T in things:
        mesh = object_mesh(model)
        scene.add_mesh(mesh.vertices_m, mesh.triangles, model.color_srgb, T)
    return scene


def off(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    angle = np.degrees(se3.rotation_angle_rad(T[:3, :3].T @ T_true[:3, :3]))
    return float(np.linalg.norm((T - T_true)[:3, 3])) * 1e3, float(angle)


@pytest.mark.parametrize("yaw", [2.9, -1.7])
def test_a_toy_is_found_whichever_way_it_looks(stage: Callable[..., Any], yaw: float) -> None:
    T = pose_of(np.array([0.48, -0.17, 0.03, yaw]))
    toy = localise_objects(
        shoot(table_with(stage, (SLOTH.objects["sloth"], T))), only(SLOTH, "sloth")
    )["sloth"]
    assert toy.found, toy.reason
    distance_mm, angle_deg = off(toy.T_base_object, T)
    assert distance_mm < 2.0
    assert angle_deg < 2.0
    assert toy.confidence > 0.8
    assert np.all(np.linalg.eigvalsh(toy.covariance) > 0)
    assert np.degrees(np.sqrt(toy.covariance[5, 5])) < 5.0


def test_moving_toy_and_cameras_together_moves_the_pose(stage: Callable[..., Any]) -> None:
    task = only(SLOTH, "sloth")
    frames = shoot(table_with(stage, (SLOTH.objects["sloth"], AT)))
    T = pose_of(np.array([0.04, 0.03, 0.0, 0.35]))
    moved = [
        replace(f, T_base_color=T @ f.T_base_color, T_base_depth=T @ f.T_base_depth) for f in frames
    ]
    before = localise_objects(frames, task)["sloth"].T_base_object
    after = localise_objects(moved, task)["sloth"].T_base_object
    distance_mm, angle_deg = off(after, T @ before)
    assert distance_mm < 0.5
    assert angle_deg < 0.5


def test_a_quarter_turn_of_a_cube_changes_nothing(stage: Callable[..., Any], task: Task) -> None:
    task = only(task, "cube")
    turned = AT @ pose_of(np.array([0.0, 0.0, 0.0, np.pi / 2]))
    places = [T + np.diag([0.0, 0.0, 0.0, 0.0]) for T in (AT, turned)]
    for T in places:
        T[2, 3] = 0.02
    first, second = (
        localise_objects(shoot(stage({"cube": T})), task)["cube"].T_base_object for T in places
    )
    np.testing.assert_allclose(first, second, atol=2e-4)


def test_the_basket_looks_the_same_from_behind_and_its_pose_says_one_thing(
    stage: Callable[..., Any],
) -> None:
    model = SLOTH.objects["basket"]
    T = pose_of(np.array([0.48, 0.05, 0.0, 0.1]))
    basket = localise_objects(shoot(table_with(stage, (model, T))), only(SLOTH, "basket"))["basket"]
    assert basket.found, basket.reason
    distance_mm, angle_deg = off(basket.T_base_object, T)
    assert distance_mm < 3.0
    assert angle_deg < 1.5
    assert np.degrees(np.sqrt(basket.covariance[5, 5])) < 5.0  # the half turn is no doubt


def ducks_at(*places: tuple[float, float, float]) -> list[np.ndarray]:
    return [pose_of(np.array([x, y, 0.03, yaw])) for x, y, yaw in places]


PLACES = ducks_at((0.39, -0.27, 0.2), (0.55, -0.27, -0.8), (0.39, -0.13, 1.0))


def test_equal_toys_are_told_apart_by_where_they_start(stage: Callable[..., Any]) -> None:
    task = only(DUCKS, "duck_3", "duck_1", "duck_2")
    found = localise_objects(shoot(table_with(stage, *[(DUCK, T) for T in PLACES])), task)
    for name, T in zip(("duck_1", "duck_2", "duck_3"), PLACES, strict=True):
        assert found[name].found, found[name].reason
        distance_mm, angle_deg = off(found[name].T_base_object, T)
        assert distance_mm < 2.5
        assert angle_deg < 4.0
        assert found[name].detail["equal_objects"] == 3
        assert found[name].detail["assignment_margin_m"] > 0.02


@pytest.mark.slow
def test_toys_that_stayed_keep_their_names_when_another_one_was_moved(
    stage: Callable[..., Any],
) -> None:
    task = only(DUCKS, "duck_1", "duck_2", "duck_3")
    now = [PLACES[0], PLACES[2], *ducks_at((0.50, 0.0, 0.4))]
    last = {f"duck_{index + 1}": T[:3, 3] for index, T in enumerate(PLACES)}
    found = localise_objects(shoot(table_with(stage, *[(DUCK, T) for T in now])), task, None, last)
    for name, T in (("duck_1", now[0]), ("duck_3", now[1]), ("duck_2", now[2])):
        assert off(found[name].T_base_object, T)[0] < 2.5


def test_a_toy_that_is_not_there_is_not_found_and_the_others_are(
    stage: Callable[..., Any],
) -> None:
    task = only(DUCKS, "duck_1", "duck_2", "duck_3")
    found = localise_objects(shoot(table_with(stage, *[(DUCK, T) for T in PLACES[:2]])), task)
    assert [found[f"duck_{k}"].found for k in (1, 2, 3)] == [True, True, False]
    assert found["duck_3"].reason == "2 of 3 objects that look like duck_3 were seen"
    assert found["duck_3"].T_base_object is None


@pytest.mark.slow
def test_toys_that_touch_are_cut_apart(stage: Callable[..., Any]) -> None:
    task = only(DUCKS, "duck_1", "duck_3")
    places = ducks_at((0.45, -0.20, 0.0), (0.45, -0.148, 0.0))
    found = localise_objects(shoot(table_with(stage, *[(DUCK, T) for T in places])), task)
    for name, T in zip(("duck_1", "duck_3"), places, strict=True):
        assert found[name].found, found[name].reason
        assert off(found[name].T_base_object, T)[0] < 6.0


def test_a_toy_on_its_side_is_found_and_said_to_lie(stage: Callable[..., Any]) -> None:
    T = pose_of(np.array([0.47, -0.15, 0.025, 0.7]))
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("x", 90, degrees=True).as_matrix()
    toy = localise_objects(shoot(table_with(stage, (DUCK, T))), only(DUCKS, "duck_1"))["duck_1"]
    assert toy.found, toy.reason
    assert off(toy.T_base_object, T)[0] < 4.0
    assert "tilted by" in str(toy.reason)


@pytest.mark.slow
def test_a_squashed_toy_shows_in_its_extents(stage: Callable[..., Any]) -> None:
    """15 % wider and 15 % flatter; the record is valid JSON of its schema."""
    factors = np.array([1.0, 1.15, 0.85])
    mesh, T = object_mesh(DUCK), pose_of(np.array([0.47, -0.15, 0.03 * 0.85, 0.3]))
    rest, scene = table_with(stage, (DUCK, AT)), stage({})
    scene.add_mesh(mesh.vertices_m * factors, mesh.triangles, DUCK.color_srgb, T)
    shapes = []
    for shown in (rest, scene):
        toy = localise_objects(shoot(shown), only(DUCKS, "duck_1"))["duck_1"]
        record = json.loads(json.dumps(toy.to_record()))
        check_record(record, name="localisation")
        shapes.append(np.array(record["soft_shape"]["extents_m"]))
        true = AT if shown is rest else T
        np.testing.assert_allclose(record["soft_shape"]["centroid_m"], true[:3, 3], atol=0.005)
    np.testing.assert_allclose(shapes[0], DUCK.size_m, atol=0.008)
    assert shapes[1][1] > shapes[0][1] + 0.002
    assert shapes[1][2] < shapes[0][2] - 0.004


@pytest.mark.slow
def test_something_else_of_the_colour_is_not_taken_for_the_toy(stage: Callable[..., Any]) -> None:
    plate, post = stage({}), stage({})
    plate.add_box(np.array([0.45, -0.2, 0.01]), np.array([0.3, 0.2, 0.02]), DUCK.color_srgb)
    post.add_box(np.array([0.45, -0.2, 0.08]), np.array([0.02, 0.02, 0.16]), DUCK.color_srgb)
    task = only(DUCKS, "duck_1")
    too_large = localise_objects(shoot(plate), task)["duck_1"]
    assert not too_large.found
    assert "no cluster above the table" in str(too_large.reason)
    other = localise_objects(shoot(post), task)["duck_1"]
    assert not other.found
    assert other.reason


def test_nothing_to_look_at_finds_nothing_and_says_so(stage: Callable[..., Any]) -> None:
    for frames in ([], shoot(stage({}))):
        found = localise_objects(frames, DUCKS)
        assert list(found) == list(DUCKS.objects)
        assert not any(item.found for item in found.values())
        assert all(item.reason for item in found.values())


def test_depth_without_a_measurement_finds_nothing(stage: Callable[..., Any]) -> None:
    frames = [
        replace(frame, depth_m=np.zeros_like(frame.depth_m))
        for frame in shoot(table_with(stage, (DUCK, AT)))
    ]
    assert not localise(frames, only(DUCKS, "duck_1")).objects["duck_1"].found


def test_samples_lie_on_the_mesh_evenly_and_face_outwards() -> None:
    mesh = object_mesh(DUCK)
    surface = surface_of(mesh.vertices_m, mesh.triangles, 2000)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(mesh.vertices_m.astype(np.float32)),
        o3d.core.Tensor(mesh.triangles.astype(np.uint32)),
    )

    def distance(p: np.ndarray) -> np.ndarray:
        return scene.compute_signed_distance(o3d.core.Tensor(p.astype(np.float32))).numpy()

    assert np.abs(distance(surface.p_m)).max() < 1e-5
    assert (distance(surface.p_m + 5e-4 * surface.normals) > 0).mean() > 0.98
    corners = mesh.vertices_m[mesh.triangles]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    middle = (corners.mean(axis=1) * areas[:, None]).sum(axis=0) / areas.sum()
    np.testing.assert_allclose(surface.p_m.mean(axis=0), middle, atol=1e-3)


def test_a_mesh_where_nothing_is_is_seen_through(stage: Callable[..., Any]) -> None:
    task = only(DUCKS, "duck_1")
    frames, config = shoot(table_with(stage, (DUCK, AT))), LocaliseConfig()
    views = fuse_stills(frames, 3, 8, task, config.points)
    surface = known_surface(DUCK, 1000)
    assert seen_through(AT, surface, views, 0.012) < 0.1
    elsewhere = AT.copy()
    elsewhere[1, 3] += 0.1
    assert seen_through(elsewhere, surface, views, 0.012) > 0.6


def test_a_mesh_of_which_no_camera_measures_anything_is_not_believed(
    stage: Callable[..., Any],
) -> None:
    task = only(DUCKS, "duck_1")
    frames, config = shoot(table_with(stage, (DUCK, AT))), LocaliseConfig()
    views = fuse_stills(frames, 3, 8, task, config.points)
    surface, below = known_surface(DUCK, 1000), AT.copy()
    below[2, 3] -= 0.2  # hidden by the table, so nothing sees through it either
    assert agreeing(AT, surface, views, 0.012) > 0.8
    assert seen_through(below, surface, views, 0.012) < 0.05
    assert agreeing(below, surface, views, 0.012) < 0.05
