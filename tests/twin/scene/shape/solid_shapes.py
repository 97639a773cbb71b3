"""Shapes made straight from voxels, without any view."""

from functools import cache

import numpy as np

from bridge.task.meshes.solids import is_closed
from twin.scene.shape.isosurface import isosurface
from twin.scene.shape.mesh import volume_m3
from twin.scene.shape.reconstruct import ObjectShape
from twin.scene.shape.sdf import SdfGrid, distances_of_solid, smoothed


def shape_of(solid: np.ndarray, voxel_m: float) -> ObjectShape:
    origin_m = np.array([0.1, 0.2, 0.3])
    values = smoothed(distances_of_solid(solid, voxel_m), voxel_m, 0.5)
    vertices, faces = isosurface(values, origin_m, voxel_m)
    return ObjectShape(
        vertices_m=vertices,
        faces=faces,
        sdf=SdfGrid(values_m=values, origin_m=origin_m, voxel_m=voxel_m),
        is_watertight=is_closed(faces),
        volume_m3=volume_m3(vertices, faces),
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
