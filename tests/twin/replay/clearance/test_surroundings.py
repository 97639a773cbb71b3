"""Pairs that are looked at nearest first: nothing that touches may be skipped."""

from types import SimpleNamespace

import numpy as np
import pytest
from scripted_plans import joints_over

from bridge.geometry import se3
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import load_task
from twin.replay.clearance.bodies import TABLE, placed_panels, placement_of
from twin.replay.clearance.surroundings import Pair, Surroundings
from twin.replay.scene import ReplayScene
from twin.robot.collision import RobotHulls, hulls_of, signed_distance
from twin.robot.model import load_robot

WIDTH_M = 0.08


@pytest.fixture(scope="module")
def hulls(script: SimpleNamespace) -> RobotHulls:
    return hulls_of(load_robot(script.scene().urdf))


def every_distance(
    scene: ReplayScene, around: Surroundings, hulls: RobotHulls, poses: dict[str, np.ndarray]
) -> dict[tuple[str, str], float]:
    """The smallest distance of each pair of bodies, all pieces measured, by shapes alone."""
    found: dict[tuple[str, str], float] = {}

    def note(body: str, other: str, distance: float) -> None:
        found[body, other] = min(found.get((body, other), np.inf), distance)

    cubes = {name: (around.objects[name].shape, placement_of(T)) for name, T in poses.items()}
    placements = [hulls.placement(index) for index in range(len(hulls.hulls))]
    for link, placed in zip(around.links, placements, strict=True):
        for name, cube in cubes.items():
            note(link.body, name, signed_distance(link.shape, placed, *cube))
    movers = [
        *((link.body, link.shape, p) for link, p in zip(around.links, placements)),  # noqa: B905
        *((name, *cube) for name, cube in cubes.items()),
    ]
    for solid, _, T in around.static:
        for body, shape, placed in movers:
            if solid.body == TABLE and body in ("base_link", "shoulder_link"):
                continue
            distance = signed_distance(shape, placed, solid.shape, placement_of(T))
            note(body, solid.body, distance)
    return found


def test_near_pairs_are_those_of_measuring_every_pair(
    script: SimpleNamespace, hulls: RobotHulls
) -> None:
    scene = script.scene()
    around = Surroundings(scene, hulls, 0.002)
    near_m, rng, num_near = 0.03, np.random.default_rng(6), 0
    for _ in range(30):
        x, y, z = rng.uniform([0.45, -0.2, 0.02], [0.6, 0.25, 0.15])
        hulls.place(joints_over(scene, x, y, z), WIDTH_M)
        q = np.append(1.0, rng.uniform(-0.5, 0.5, 3))
        T = se3.transform_from(q / np.linalg.norm(q), np.array([x + 0.03, y, z]))
        distances, cut_m = around.measure(
            {"cube": T}, ["cube"], near_m=near_m, counts=lambda body, other: other != "cube"
        )
        measured: dict[tuple[str, str], float] = {}
        pair: Pair
        for pair, distance in distances.items():
            bodies = pair[0], pair[2]
            measured[bodies] = min(measured.get(bodies, np.inf), distance)
        for bodies, distance in every_distance(scene, around, hulls, {"cube": T}).items():
            if distance <= min(cut_m, near_m):
                assert measured[bodies] == distance
                num_near += 1
            else:
                assert measured.get(bodies, np.inf) >= cut_m or measured[bodies] == distance
        counted = [d for (_, other), d in measured.items() if other != "cube"]
        assert cut_m == max(near_m, min(counted))
    assert num_near > 60


def test_the_boxes_of_a_basket_hold_its_rim_its_corners_and_its_handles() -> None:
    """Otherwise the audit, which has the mesh, finds less distance than the clearance said."""
    basket = load_task("sloth_over_rim").objects["basket"]
    vertices = object_mesh(basket).vertices_m
    away = np.full(len(vertices), np.inf)
    for T, extents in placed_panels(basket, np.eye(4)):
        q = np.abs(se3.apply(se3.invert(T), vertices)) - extents / 2
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
        away = np.minimum(away, outside + np.minimum(q.max(axis=1), 0.0))
    assert away.max() < 5e-4
    assert away.min() > -0.01
