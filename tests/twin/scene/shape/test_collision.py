"""Convex parts: they hold the solid, leave the cavity free, and engines can load them."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from twin.scene.shape.carve import ShapeError, VoxelBox
from twin.scene.shape.collision import (
    CollisionConfig,
    CollisionParts,
    collision_parts,
    hull_of_points,
    thinned,
    voxel_corners,
)
from twin.scene.shape.files import write_shape
from twin.scene.shape.isosurface import isosurface
from twin.scene.shape.mesh import is_watertight, read_mesh, volume_m3
from twin.scene.shape.reconstruct import ObjectShape, find_cavity
from twin.scene.shape.sdf import SdfGrid, distances_of_solid, smoothed


def shape_of(solid: np.ndarray, voxel_m: float) -> ObjectShape:
    """A shape straight from voxels, everything outside known to be free."""
    box = VoxelBox(origin_m=np.array([0.1, 0.2, 0.3]), voxel_m=voxel_m, counts=solid.shape)
    values = smoothed(distances_of_solid(solid, voxel_m), voxel_m, 0.5)
    vertices, faces = isosurface(values, box.origin_m, voxel_m)
    return ObjectShape(
        vertices_m=vertices,
        faces=faces,
        sdf=SdfGrid(values_m=values, origin_m=box.origin_m, voxel_m=voxel_m),
        completed=np.zeros(len(faces), dtype=bool),
        completed_fraction=0.0,
        unseen_top_m2=0.0,
        is_watertight=is_watertight(faces),
        volume_m3=volume_m3(vertices, faces),
        cavity=find_cavity(solid, ~solid, box),
        num_views=1,
        truncation_m=0.01,
    )


def grid(num: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    axis = np.arange(num) - (num - 1) / 2
    return np.meshgrid(axis, axis, axis, indexing="ij")


@cache
def ball_shape() -> ObjectShape:
    x, y, z = grid(40)
    return shape_of(np.sqrt(x * x + y * y + z * z) < 15, 0.002)


@cache
def box_shape() -> ObjectShape:
    x, y, z = grid(50)
    outer = (np.abs(x) < 20) & (np.abs(y) < 16) & (z > -12) & (z < 10)
    inner = (np.abs(x) < 17) & (np.abs(y) < 13) & (z > -9)
    return shape_of(outer & ~inner, 0.0025)


@cache
def basket_shape() -> ObjectShape:
    x, y, z = grid(60)
    r = np.hypot(x, y)
    return shape_of((r < 26) & (z > -12) & (z < 10) & ~((r < 22) & (z > -8)), 0.0025)


@cache
def ell_shape() -> ObjectShape:
    x, y, z = grid(40)
    ell = (np.abs(z) < 5) & (np.abs(x) < 15) & (np.abs(y) < 15) & ((x < -5) | (y < -5))
    return shape_of(ell, 0.002)


@cache
def parts_of(make: Callable[[], ObjectShape]) -> CollisionParts:
    """Found with the default settings."""
    return collision_parts(make())


def held(shape: ObjectShape, parts: tuple, margin_m: float) -> np.ndarray:
    """Solid voxels that lie in a part."""
    box = VoxelBox(
        origin_m=shape.sdf.origin_m, voxel_m=shape.sdf.voxel_m, counts=shape.sdf.values_m.shape
    )
    centres = box.centres_m(np.flatnonzero(shape.sdf.values_m < 0))
    return np.logical_or.reduce([part.contains(centres, margin_m) for part in parts])


def test_a_convex_shape_is_one_hull() -> None:
    shape, found = ball_shape(), parts_of(ball_shape)
    assert len(found.parts) == 1
    assert found.hull_ratio < 1.05
    assert found.cavity_blocked is None
    assert held(shape, found.parts, 0.002).all()
    assert len(found.parts[0].vertices_m) <= 180


@pytest.mark.parametrize("make", [box_shape, basket_shape])
def test_a_container_keeps_its_cavity_and_its_walls(make: Callable[[], ObjectShape]) -> None:
    shape, found = make(), parts_of(make)
    assert shape.cavity is not None
    assert found.hull_ratio > 1.5
    assert found.cavity_blocked == 0.0
    assert 5 <= len(found.parts) <= 16
    assert held(shape, found.parts, 1e-6).all()
    assert found.volume_ratio < 1.35
    # Drop test: a small ball sinks to the floor without touching a part.
    points = shape.cavity.points_m
    assert not held_points(points, found.parts).any()


def held_points(points: np.ndarray, parts: tuple) -> np.ndarray:
    return np.logical_or.reduce([part.contains(points) for part in parts])


def test_a_box_falls_apart_into_floor_and_four_walls() -> None:
    found = parts_of(box_shape)
    assert len(found.parts) == 5
    assert found.volume_ratio == pytest.approx(1.0, abs=0.1)


def test_one_hull_over_a_container_would_block_it() -> None:
    found = collision_parts(box_shape(), CollisionConfig(max_parts=1))
    assert len(found.parts) == 1
    assert found.cavity_blocked == 1.0


def test_a_concave_shape_is_cut_until_little_is_added() -> None:
    shape = ell_shape()
    found = collision_parts(shape)
    assert found.hull_ratio > 1.15
    assert len(found.parts) == 2
    assert found.volume_ratio < 1.1
    assert held(shape, found.parts, 1e-6).all()


def test_parts_are_closed_and_as_large_as_qhull_says() -> None:
    for part in parts_of(basket_shape).parts:
        assert is_watertight(part.faces)
        assert volume_m3(part.vertices_m, part.faces) == pytest.approx(part.volume_m3, rel=1e-6)
        assert part.volume_m3 == pytest.approx(ConvexHull(part.vertices_m).volume)


def test_row_ends_are_enough_for_the_hull_of_voxels() -> None:
    rng = np.random.default_rng(0)
    voxels = np.argwhere(rng.random((9, 8, 7)) < 0.1)
    cube = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    every = (voxels[:, None] + cube).reshape(-1, 3)
    corners = voxel_corners(voxels)
    assert len(corners) < len(every)
    assert ConvexHull(corners).volume == pytest.approx(ConvexHull(every).volume)


def test_a_thinned_hull_of_a_box_is_the_box() -> None:
    rng = np.random.default_rng(0)
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * 1.0
    points = np.concatenate([rng.uniform(-1, 1, (2000, 3)), corners])
    assert hull_of_points(thinned(points)).volume_m3 == pytest.approx(8.0)


def test_points_in_a_plane_and_a_shape_without_volume_are_refused() -> None:
    with pytest.raises(ShapeError, match="no volume"):
        hull_of_points(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]))
    shape = ball_shape()
    empty = ObjectShape(**{**vars(shape), "volume_m3": 0.0})
    with pytest.raises(ShapeError, match="no collision parts"):
        collision_parts(empty)


def test_the_parts_are_read_back_and_pybullet_takes_their_vertices(tmp_path: Path) -> None:
    """No engine needs a file of its own kind: the hull of a part's vertices is the part."""
    import pybullet

    shape = box_shape()
    names, about = write_shape(tmp_path, shape, "box", soft=False)
    found = parts_of(box_shape).parts
    parts = [read_mesh(path) for path in sorted((tmp_path / "collision").glob("*.ply"))]
    assert len(parts) == len(found) == about["collision"]["num_parts"]
    assert sorted(n for n in names if n.startswith("collision/"))[0] == "collision/00.ply"
    client = pybullet.connect(pybullet.DIRECT)
    try:
        for (vertices, faces), part in zip(parts, found, strict=True):
            np.testing.assert_allclose(vertices, part.vertices_m, atol=1e-7)
            assert is_watertight(faces)
            shape_id = pybullet.createCollisionShape(
                pybullet.GEOM_MESH, vertices=vertices.tolist(), physicsClientId=client
            )
            body = pybullet.createMultiBody(0, shape_id, physicsClientId=client)
            low, high = pybullet.getAABB(body, physicsClientId=client)
            np.testing.assert_allclose(low, vertices.min(axis=0), atol=0.003)
            np.testing.assert_allclose(high, vertices.max(axis=0), atol=0.003)
    finally:
        pybullet.disconnect(client)
