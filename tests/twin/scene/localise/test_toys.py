"""Meshes and soft toys in ray-cast frames: laws, sides, deformed ones, and none at all."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toy_frames import AT, DUCK, DUCKS, SLOTH, off, only, shoot, table_with

from bridge.geometry import se3
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.record import check_record
from twin.scene.localise import mesh_fit, soft
from twin.scene.localise.mesh_fit import facing, known_surface
from twin.scene.localise.objects import localise_objects
from twin.scene.localise.points import Cluster, fuse_stationary
from twin.scene.shape.known import pose_of


@pytest.mark.parametrize("q", [(0.12, 0, 0, 0.99), (0.66, 0, 0, -0.75), (0.76, 0.25, -0.43, 0.42)])
def test_a_toy_is_found_whichever_way_it_looks(
    stage: Callable[..., Any], q: tuple[float, ...]
) -> None:
    """Standing it would explain less than half of the last one's points."""
    q_wxyz, z_m = np.array(q) / np.linalg.norm(q), 0.088 if q[1] else 0.03
    T = se3.transform_from(q_wxyz, np.array([0.48, -0.17, z_m]))
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


def test_what_looks_the_same_from_behind_is_said_to_be_doubtful(
    stage: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = SLOTH.objects["basket"]  # the same after half a turn, which the fit is not told
    T = pose_of(np.array([0.48, 0.05, 0.0, 0.1]))
    task = only(SLOTH, "basket")
    views = fuse_stationary(shoot(table_with(stage, (model, T))), 3, 8, task)
    surface, other = known_surface(model, 2500), known_surface(model, 2700)
    seen = [se3.apply(T, other.p_m[facing(se3.invert(T), view, other)]) for view in views]
    points = np.concatenate(seen)
    points += np.random.default_rng(3).normal(scale=0.002, size=points.shape)
    group = Cluster(
        p_base=points, view_ids=np.repeat(np.arange(len(views)), [len(rows) for rows in seen])
    )
    monkeypatch.setattr(mesh_fit, "NUM_REFINED", 12)
    fit = mesh_fit.fit_mesh(group, views, surface, tilt_sigma_rad=0.01)
    assert np.degrees(np.sqrt(fit.covariance[5, 5])) > 45.0


def test_a_fleck_of_its_colour_is_not_turned_over_beside_a_toy_on_its_side(
    stage: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Looking for the other sides takes longest, and of a fleck they cannot be told apart."""
    T = pose_of(np.array([0.47, -0.15, 0.025, 0.7]))
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("x", 90, degrees=True).as_matrix()
    scene, turned = table_with(stage, (DUCK, T)), []
    scene.add_box(np.array([0.45, 0.0, 0.01]), np.array([0.025, 0.015, 0.02]), DUCK.color_srgb)
    lay = soft.fit_mesh

    def counted(group: Any, *arguments: Any, lying: bool = False, **options: Any) -> Any:
        turned.append((len(group), lying))
        return lay(group, *arguments, lying=lying, **options)

    monkeypatch.setattr(soft, "fit_mesh", counted)
    toy = localise_objects(shoot(scene), only(DUCKS, "duck_1"))["duck_1"]
    assert len([size for size, lying in turned if not lying]) == 2
    assert [size for size, lying in turned if lying] == [max(turned)[0]]
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
