"""The light on the arm: found from links that turned, taken off their paint, put on again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twin.scene.fit.initialise import flat_gaussians
from twin.scene.fit.lighting import EVEN, Lighting, fit_lighting, read_lighting
from twin.scene.frames.rgbd import PointSet
from twin.scene.gaussians import as_float32
from twin.scene.movable_scene import MovableScene
from twin.scene.objects.decompose import ObjectSplats
from twin.scene.robot.extraction import SeenLink, link_lighting, on_surface, own_colors

HALF_M = np.array([0.05, 0.04, 0.12])
TRUE = Lighting(coefficients=(1.0, 0.1, -0.15, 0.35, 0.05, 0.0, 0.03, -0.04, 0.02))
PAINT = np.array([[0.5, 0.2, 0.2], [0.2, 0.5, 0.2], [0.3, 0.3, 0.3],
                  [0.2, 0.2, 0.5], [0.4, 0.4, 0.1], [0.1, 0.4, 0.4]])  # fmt: skip
"""Of the sides towards +x, +y, +z, -x, -y, -z."""


def box() -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return corners * HALF_M, triangles


def seen(count: int, seed: int = 0) -> list[SeenLink]:
    """The whole box, measured with noise in its first posture and in others."""
    rng = np.random.default_rng(seed)
    found = []
    for R in Rotation.random(count, random_state=seed).as_matrix():
        side = np.repeat(np.arange(6), 300)
        axis, up = side % 3, np.where(side < 3, 1.0, -1.0)
        rows = np.arange(len(side))
        p = rng.uniform(-1, 1, (len(side), 3)) * HALF_M
        p[rows, axis] = up * HALF_M[axis]
        normals = np.eye(3)[axis] * up[:, None]
        light = TRUE.brightness(normals @ R.T)
        colors = PAINT[side] * light[:, None] + rng.normal(0, 0.01, (len(side), 3))
        noisy = normals + rng.normal(0, 0.1, normals.shape)
        points = PointSet(
            p_m=as_float32(p + rng.normal(0, 0.001, p.shape)),
            normals=as_float32(noisy / np.linalg.norm(noisy, axis=1, keepdims=True)),
            colors=as_float32(colors),
            footprint_m=as_float32(np.full(len(side), 0.003)),
        )
        found.append(SeenLink(points=points, R_base_link=R))
    return found


def test_light_is_found_from_a_link_that_turns_and_its_paint_is_the_same_all_over() -> None:
    found = link_lighting({"arm": [box()]}, {"arm": seen(12)})
    directions = Rotation.random(200, random_state=3).apply([0.0, 0.0, 1.0])
    ours, true = found.brightness(directions), TRUE.brightness(directions)
    factor = float((ours * true).sum() / (true * true).sum())  # paint and light share a factor
    np.testing.assert_allclose(ours / factor, true, atol=0.05)
    sets = own_colors([box()], seen(12), found)
    cloud = on_surface([box()], sets, 0.01)
    assert cloud is not None
    p = cloud.means_m / HALF_M
    for side in range(6):
        axis, up = side % 3, 1.0 if side < 3 else -1.0
        on = (p[:, axis] * up > 0.999) & (np.delete(np.abs(p), axis, axis=1) < 0.8).all(axis=1)
        assert on.sum() > 20
        paint = np.median(cloud.colors[on] * factor, axis=0)
        np.testing.assert_allclose(paint, PAINT[side], atol=0.015)


def test_lit_gaussians_are_as_bright_as_where_they_face() -> None:
    normals = Rotation.random(50, random_state=1).apply([0.0, 0.0, 1.0])
    gray = np.full((50, 3), 0.4)
    cloud = flat_gaussians(np.zeros((50, 3)), normals, gray, np.ones(50))
    expected = 0.4 * TRUE.brightness(normals)
    np.testing.assert_allclose(TRUE.on(cloud).colors[:, 1], expected, atol=1e-5)
    assert EVEN.on(cloud) is cloud


def test_light_is_kept_in_the_record_and_older_scenes_are_lit_evenly() -> None:
    record = {"robot": {"lighting": TRUE.to_record()}}
    assert read_lighting(record) == TRUE
    assert read_lighting({"robot": {"links": {}}}) == read_lighting({}) == EVEN


@pytest.mark.parametrize("count", [0, 1])
def test_one_posture_says_nothing_of_light(count: int) -> None:
    """Every piece faces one way: paint alone explains it all."""
    found = link_lighting({"arm": [box()]}, {"arm": seen(count)})
    directions = Rotation.random(100, random_state=3).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(found.brightness(directions), 1.0, atol=0.02)
    assert fit_lighting([]) == EVEN


def test_an_object_that_lies_turned_is_lit_as_it_lies() -> None:
    normals, paint = (
        Rotation.random(60, random_state=1).as_matrix()[:, :, 0],
        np.tile(PAINT, (10, 1)),
    )
    seen_as = paint * TRUE.brightness(normals)[:, None]
    cloud = flat_gaussians(HALF_M * normals, normals, seen_as, np.full(60, 0.01))
    toy = ObjectSplats(cloud=cloud, T_base_object=np.eye(4))
    scene = MovableScene(background=cloud, objects={"toy": toy}, links={}, lighting=TRUE)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([2.0, 0.5, 0.1]).as_matrix()
    lit = paint * TRUE.brightness(normals @ T[:3, :3].T)[:, None]
    np.testing.assert_allclose(scene.object_at("toy", {"toy": T}).colors, lit, atol=1e-4)
