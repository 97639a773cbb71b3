"""Soft bodies: what they are made of, and what the world of the robot does with them."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.task.meshes.lattice import volumes_m3
from bridge.task.task_file import ObjectModel, load_task
from twin.physics.arm import PhysicsError
from twin.physics.config import PhysicsConfig
from twin.physics.soft import SoftBodyError, SoftModel, rigid_fit, surface_triangles
from twin.physics.world import World

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
Boxes = Callable[..., SoftModel]


def at(x: float, y: float, z: float) -> np.ndarray:
    return se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([x, y, z]))


def closed_on(world: World, model: SoftModel, steps: int = 120) -> np.ndarray:
    """Close the fingers on a body between them; where the tool is."""
    world.reset_robot(HOME, 0.043)
    T_tcp = world.robot.T_base_link("tcp")
    world.soft_bodies().add("toy", model, T_tcp)
    for _ in range(steps):
        world.robot.command(HOME, np.zeros(6), 0.0)
        world.step()
    return T_tcp


def test_fingers_stop_on_a_soft_body_and_hold_it(urdf: str, box_of_cells: Boxes) -> None:
    model = box_of_cells((3, 3, 3), young_pa=8e4)
    with World(urdf, {}, PhysicsConfig()) as world:
        T_tcp = closed_on(world, model)
        width = world.robot.width_m()
        assert 0.015 < width < 0.041, "they pressed into it, and did not go through it"
        assert world.finger_touches("toy")
        drift = world.T_base_object("toy")[:3, 3] - T_tcp[:3, 3]
        assert np.linalg.norm(drift) < 5e-3, "the grasp does not hold against gravity"
        assert world.soft_bodies().health("toy").sound
        widths = []
        for _ in range(60):
            world.robot.command(HOME, np.zeros(6), 0.0)
            world.step()
            widths.append(world.robot.width_m())
        assert np.ptp(widths) < 1e-3, "the fingers shake"


def test_a_body_let_go_falls_and_takes_its_shape_again(urdf: str, box_of_cells: Boxes) -> None:
    model = box_of_cells((3, 3, 3), young_pa=4e4)
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_table(0.0)
        closed_on(world, model)
        assert world.robot.width_m() < 0.038, "it is not squeezed"
        for _ in range(240):
            world.robot.command(HOME, np.zeros(6), 0.085)
            world.step()
        assert not world.finger_touches("toy")
        assert world.T_base_object("toy")[2, 3] < 0.05
        np.testing.assert_allclose(
            world.soft_bodies().extents_m("toy") / model.size_m, 1.0, atol=0.05
        )


def test_a_soft_body_rests_on_a_free_box(urdf: str, box_of_cells: Boxes) -> None:
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_table(0.0)
        world.reset_robot(HOME, 0.08)
        world.add_free("cube", np.full(3, 0.06), 0.2, at(0.6, 0.3, 0.0301))
        world.soft_bodies().add("toy", box_of_cells((3, 3, 2)), at(0.6, 0.3, 0.076))
        for _ in range(240):
            world.step()
        assert world.T_base_object("toy")[2, 3] == pytest.approx(0.074, abs=2e-3)
        assert world.T_base_object("cube")[2, 3] == pytest.approx(0.03, abs=1e-3)


def test_every_run_gives_the_same_bits(urdf: str, box_of_cells: Boxes) -> None:
    found = set()
    for _ in range(2):
        with World(urdf, {}, PhysicsConfig()) as world:
            closed_on(world, box_of_cells((3, 3, 3)), 30)
            digest = hashlib.sha256(world.soft_bodies().nodes_m("toy").astype(np.float32).tobytes())
            digest.update(world.robot.posture()[0].tobytes())
            found.add(digest.hexdigest())
    assert len(found) == 1


def test_poses_and_extents_at_rest_are_those_given(urdf: str) -> None:
    duck = load_task("five_ducks_into_basket").objects["duck_1"]
    T = se3.transform_from(np.array([0.8, 0.0, 0.6, 0.0]), np.array([0.4, 0.1, 0.5]))
    with World(urdf, {}, PhysicsConfig()) as world:
        world.soft_bodies().add("duck", SoftModel.from_task(duck), T)
        np.testing.assert_allclose(world.T_base_object("duck"), T, atol=1e-6)
        np.testing.assert_allclose(world.soft_bodies().extents_m("duck"), duck.size_m, rtol=1e-5)
        assert not world.finger_touches("duck")


def test_an_unknown_object_is_named_with_those_there_are(urdf: str, box_of_cells: Boxes) -> None:
    with World(urdf, {}, PhysicsConfig()) as world:
        world.soft_bodies().add("toy", box_of_cells((2, 2, 2)), at(0.5, 0.0, 0.5))
        with pytest.raises(PhysicsError, match="There are: toy"):
            world.T_base_object("cube")


@pytest.fixture(scope="module")
def duck() -> ObjectModel:
    return load_task("five_ducks_into_basket").objects["duck_1"]


@pytest.fixture(scope="module")
def model(duck: ObjectModel) -> SoftModel:
    return SoftModel.from_task(duck)


def test_a_task_gives_a_lattice_with_its_mass_and_material(
    duck: ObjectModel, model: SoftModel
) -> None:
    assert 80 <= len(model.nodes_m) <= 250
    assert model.mass_fraction.sum() == pytest.approx(1.0, abs=1e-5)
    assert (model.mass_kg, model.young_pa, model.poisson) == (0.03, 8e4, 0.2)
    assert model.size_m == duck.size_m
    assert model.skin_m is not None
    np.testing.assert_allclose(np.ptp(model.skin_m, axis=0), duck.size_m, atol=1e-6)


def test_the_surface_is_closed_and_points_outward(model: SoftModel) -> None:
    triangles = surface_triangles(model.tets)
    edges = np.concatenate([triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    forward, backward = {tuple(e) for e in edges}, {tuple(e[::-1]) for e in edges}
    assert forward == backward
    a, b, c = (model.nodes_m[triangles[:, k]].astype(np.float64) for k in range(3))
    enclosed = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert enclosed == pytest.approx(model.volume_m3(), rel=1e-5)


def test_a_rigid_fit_recovers_the_motion(model: SoftModel) -> None:
    nodes = model.nodes_m.astype(np.float64)
    R, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    R *= np.sign(np.linalg.det(R))
    T = rigid_fit(nodes, nodes @ R.T + [1.0, 2.0, 3.0], model.mass_fraction.astype(np.float64))
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-9)
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3], atol=1e-9)
    assert np.isnan(rigid_fit(nodes, nodes * np.nan, np.ones(len(nodes)))[:3]).all()


def test_a_scene_gives_its_own_lattice(duck: ObjectModel, model: SoftModel) -> None:
    arrays = {
        "nodes_m": model.nodes_m,
        "tets": model.tets,
        "mass_fraction": model.mass_fraction,
        "spacing_m": np.float32(0.009),
    }
    found = SoftModel.from_lattice(arrays, duck)
    assert found.spacing_m == pytest.approx(0.009)
    assert found.young_pa == model.young_pa
    del arrays["tets"]
    with pytest.raises(SoftBodyError, match="without tets"):
        SoftModel.from_lattice(arrays, duck)


def test_a_rigid_object_is_no_soft_body() -> None:
    cube = load_task("cube_into_box").objects["cube"]
    with pytest.raises(SoftBodyError, match="cube is rigid"):
        SoftModel.from_task(cube)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poisson": 0.5}, "0.45 can be simulated"),
        ({"young_pa": 0.0}, "mass, stiffness"),
        ({"mass_kg": float("nan")}, "mass, stiffness"),
        ({"damping_s": -1.0}, "damping time"),
    ],
)
def test_impossible_material_is_refused(
    model: SoftModel, change: dict[str, float], message: str
) -> None:
    with pytest.raises(SoftBodyError, match=message):
        replace(model, **change)


def test_unusable_tetrahedra_are_refused(model: SoftModel) -> None:
    with pytest.raises(SoftBodyError, match="inside out at rest"):
        replace(model, tets=model.tets[:, [1, 0, 2, 3]])
    with pytest.raises(SoftBodyError, match="not there"):
        replace(model, tets=model.tets + len(model.nodes_m))
    with pytest.raises(SoftBodyError, match="no tetrahedra"):
        replace(model, tets=model.tets[:0])
    with pytest.raises(SoftBodyError, match="no numbers"):
        replace(model, nodes_m=model.nodes_m * np.float32(np.nan))
    assert (volumes_m3(model.nodes_m.astype(np.float64), model.tets) > 0).all()
