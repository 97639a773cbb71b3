"""The closed surface where distances on a grid cross zero, by Open3D's marching cubes."""

from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from twin.scene.shape.mesh import Faces, Vertices

_CLEARANCE = 0.01
"""No value is nearer to zero than this share of a voxel: no triangle without area."""


def isosurface(
    values: Float32[np.ndarray, "num_x num_y num_z"],
    origin_m: Float[np.ndarray, "3"],
    voxel_m: float,
) -> tuple[Vertices, Faces]:
    """Triangles of the surface where values cross zero, facing the positive side [m].

    The surface is closed: what lies beyond the grid counts as outside.
    """
    import open3d  # noqa: PLC0415  # loads 300 modules; most who import this draw no surface

    outside = max(voxel_m, float(np.abs(values).max()))
    side = max(values.shape) + 2
    cube = np.full((side, side, side), outside)
    cube[tuple(slice(1, count + 1) for count in values.shape)] = values
    least = _CLEARANCE * voxel_m
    cube = np.where(np.abs(cube) < least, np.where(cube < 0, -least, least), cube) / outside
    integration: Any = open3d.pipelines.integration
    volume = integration.UniformTSDFVolume(
        length=float(side),
        resolution=side,
        sdf_trunc=1.0,
        color_type=integration.TSDFVolumeColorType.NoColor,
    )
    weighted = np.stack([cube.ravel(), np.ones(cube.size)], axis=1)
    volume.inject_volume_tsdf(open3d.utility.Vector2dVector(weighted))
    mesh = volume.extract_triangle_mesh()
    places = np.asarray(mesh.vertices) - 1.5  # voxels have their middle at one half
    return origin_m + voxel_m * places, np.asarray(mesh.triangles).astype(np.int64)
