"""Gaussians under and beside a toy: the reconstructed shape decides, not the box around it."""

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import load_task
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.localise.mesh_fit import mesh_surface
from twin.scene.objects.assignment import assign_splats
from twin.scene.shape.known import pose_of
from twin.scene.shape.reconstruct import ObjectShape

TASK = load_task("sloth_into_basket")
SLOTH = TASK.objects["sloth"]
T = pose_of(np.array([0.48, -0.17, SLOTH.rest_height_m, 0.3]))
WOOD = (150, 116, 84)
"""A table of nearly the sloth's own colour: colour alone cannot tell."""


@pytest.fixture(scope="module")
def scene(shape: ObjectShape) -> tuple[GaussianCloud, np.ndarray]:
    """The toy and the table around it as cameras see them, and which is which."""
    mesh = object_mesh(SLOTH)
    toy = se3.apply(T, mesh_surface(mesh.vertices_m, mesh.triangles, 3000).p_m)
    toy = toy[toy[:, 2] > 0.004]
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform([0.36, -0.29], [0.60, -0.05], (6000, 2)), np.zeros(6000)])
    table[:, 2] = rng.normal(0, 0.0007, 6000)
    inside = shape.sdf.distance(se3.apply(se3.invert(T), table)) < 0.001
    table = table[~inside]  # nobody sees the table where the toy stands
    count = len(toy) + len(table)
    is_toy = np.arange(count) < len(toy)
    colors = np.where(is_toy[:, None], SLOTH.color_srgb, WOOD) / 255
    cloud = GaussianCloud(
        means_m=as_float32(np.concatenate([toy, table])),
        quats_wxyz=as_float32(np.tile([1.0, 0, 0, 0], (count, 1))),
        scales_log=as_float32(np.full((count, 3), np.log(0.002))),
        opacities_logit=as_float32(np.full(count, 2.0)),
        colors=as_float32(colors),
    )
    return cloud, is_toy


def wrong(given: np.ndarray, is_toy: np.ndarray) -> tuple[float, float]:
    """Share of the toy that is table, and of the toy that was left behind."""
    mine = given == 0
    return float((mine & ~is_toy).sum() / mine.sum()), float((is_toy & ~mine).sum() / is_toy.sum())


def test_the_table_beside_a_toy_stays_with_the_table(
    scene: tuple[GaussianCloud, np.ndarray], shape: ObjectShape
) -> None:
    cloud, is_toy = scene
    poses = {"sloth": T}
    boxed = wrong(assign_splats(cloud, poses, TASK), is_toy)
    shaped = wrong(assign_splats(cloud, poses, TASK, {"sloth": shape}), is_toy)
    assert boxed[0] > 0.2  # the box around it holds the table between its legs
    assert shaped[0] < 0.07
    assert shaped[1] < 0.01
