"""A shape from triangles that somebody else made: filled, and told apart what was measured."""

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from twin.scene.shape.carve import Evidence
from twin.scene.shape.masked_view import ShapeError
from twin.scene.shape.mesh import Faces, Vertices, volume_m3
from twin.scene.shape.reconstruct import ObjectShape, ShapeConfig, describe_solid, voxel_box
from twin.scene.shape.sdf import SdfGrid, distances_of_solid, smoothed
from twin.scene.shape.voxels import VoxelBox

MAX_SAMPLES = 2_000_000
MEASURED_VOXELS = 2.0
"""Faces this near to a measured point were measured; the rest is somebody's guess."""


def shape_of_mesh(
    vertices_m: Vertices,
    faces: Faces,
    points_m: Float[np.ndarray, "num_points 3"],
    config: ShapeConfig | None = None,
) -> ObjectShape:
    """Fill a mesh and describe it like a reconstructed shape.

    It need not be closed: gaps below a voxel or two close, inner faces vanish. Faces that no
    measured point lies near are marked as completed.

    Args:
        vertices_m: In the frame that is wanted, z up.
        faces: Triangles, wound alike.
        points_m: What was measured on the object, in the same frame.
        config: Size of the voxels; the defaults when None.

    Raises:
        ShapeError: When the triangles enclose nothing.
    """
    config = ShapeConfig() if config is None else config
    low, high = vertices_m.min(axis=0), vertices_m.max(axis=0)
    box, truncation = voxel_box(low, high, config)
    solid = _filled(vertices_m, faces, box)
    if int(solid.sum()) < 1:
        message = f"{len(faces)} triangles enclose no voxel of {box.voxel_m * 1e3:.1f} mm."
        raise ShapeError(message)
    distances = distances_of_solid(solid, box.voxel_m)
    values = smoothed(distances, box.voxel_m, config.smoothing_voxels)
    grid = SdfGrid(values_m=values, origin_m=box.origin_m, voxel_m=box.voxel_m)
    weight = _near_points(points_m, box).astype(np.float32)
    evidence = Evidence(
        box=box, tsdf=np.zeros_like(weight), weight=weight, free=~solid, empty=~solid
    )
    return describe_solid(grid, evidence, solid, 1, truncation)


def _filled(
    vertices_m: Vertices, faces: Faces, box: VoxelBox
) -> Bool[np.ndarray, "num_x num_y num_z"]:
    """Voxels inside: the skin is closed and filled, then skin voxels outside are taken off."""
    p, normals = _dense(vertices_m, faces, box.voxel_m / 2)
    index = np.rint((p - box.origin_m) / box.voxel_m).astype(np.int64)
    skin = np.zeros(box.counts, dtype=bool)
    skin[tuple(np.clip(index, 0, np.array(box.counts) - 1).T)] = True
    tight = ndimage.binary_closing(skin, iterations=2) | skin
    solid = np.asarray(ndimage.binary_fill_holes(tight))
    ids = np.flatnonzero(tight)
    centres = box.centres_m(ids)
    _, nearest = cKDTree(p).query(centres)
    outside = np.einsum("ni,ni->n", centres - p[nearest], normals[nearest]) > 0
    solid.ravel()[ids[outside]] = False
    return solid


def _dense(vertices_m: Vertices, faces: Faces, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Points on a mesh no farther apart than a spacing, and normals that look outwards."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    longest = np.max([np.linalg.norm(e, axis=1) for e in (b - a, c - b, a - c)], axis=0)
    steps = np.maximum(np.ceil(longest / spacing_m).astype(np.int64), 1)
    total = int(((steps + 1) * (steps + 2) // 2).sum())
    if total > MAX_SAMPLES:
        message = f"{len(faces)} triangles would need {total} points; the mesh is too fine."
        raise ShapeError(message)
    normals = cross / np.maximum(area, 1e-300)[:, None]
    if volume_m3(vertices_m, faces) < 0:
        normals = -normals
    points, owners = [], []
    for step in np.unique(steps):
        own = np.flatnonzero(steps == step)
        i, j = np.nonzero(np.add.outer(np.arange(step + 1), np.arange(step + 1)) <= step)
        u, v = (i / step)[None, :, None], (j / step)[None, :, None]
        p = a[own][:, None] * (1 - u - v) + b[own][:, None] * u + c[own][:, None] * v
        points.append(p.reshape(-1, 3))
        owners.append(np.repeat(own, len(i)))
    return np.concatenate(points), normals[np.concatenate(owners)]


def _near_points(
    points_m: Float[np.ndarray, "num_points 3"], box: VoxelBox
) -> Bool[np.ndarray, "num_x num_y num_z"]:
    """Voxels near a measured point."""
    index = np.rint((points_m - box.origin_m) / box.voxel_m).astype(np.int64)
    index = index[np.all((index >= 0) & (index < box.counts), axis=1)]
    hit = np.zeros(box.counts, dtype=bool)
    hit[tuple(index.T)] = True
    return np.asarray(ndimage.distance_transform_edt(~hit) <= MEASURED_VOXELS)
