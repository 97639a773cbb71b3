"""One closed metric shape of an object, from masked depth or a foreign mesh."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bridge.task.meshes.solids import is_closed
from twin.robot.surface import ray_scene, tensor
from twin.scene.frames.selection import spread
from twin.scene.shape.carve import (
    MaskedView,
    ShapeError,
    VoxelBox,
    gather,
    signed_distances,
    solid_of,
)
from twin.scene.shape.isosurface import isosurface
from twin.scene.shape.mesh import Faces, Vertices, volume_m3
from twin.scene.shape.registration import laid_together
from twin.scene.shape.sdf import SdfGrid, smoothed

PAD_VOXELS = 4
"""Free voxels around the object, so that distances are known a little beyond it."""
MIN_POINTS = 30
"""Measured object pixels that make a view count."""
MIN_SPREAD_RAD = 0.2
"""Directions that differ by less see the same side; their free space carves nothing."""
CELL_M = 0.004
"""A measured point counts for the extent when two views measured one in the same cell."""
THIN_M = 0.004
LEAST_BEHIND_VOXELS = 1.6
"""A surface speaks for what is this far behind it, if two voxels are more: walls may be thin. With
less than 1.6 voxels a basket of 3.5 mm voxels gets a hole where noise meets."""
MIN_VOXEL_M, VOXELS_ALONG = 0.0015, 100
"""Finest voxel, and voxels along the longest side, unless that makes them finer."""
TRUNCATION_VOXELS, MIN_TRUNCATION_M = 4.0, 0.006
"""Depth this near to a surface, the larger of both, says how far the surface is."""
MIN_FREE_VIEWS = 2
"""Views that must look through a voxel before it is free."""
SMOOTHING_VOXELS = 0.5
"""Standard deviation of the mean over distances that takes the stairs off."""
MAX_VIEWS = 40
"""More views than this are thinned out evenly."""


@dataclass(frozen=True, kw_only=True)
class ObjectShape:
    """A closed shape in the frame of the views' poses."""

    vertices_m: Float[np.ndarray, "num_vertices 3"]
    faces: Faces
    """Counter-clockwise seen from outside."""
    sdf: SdfGrid
    is_watertight: bool
    volume_m3: float
    num_views: int
    truncation_m: float


def reconstruct(
    views: Sequence[MaskedView], support_z_m: float | None, *, align_rounds: int = 0
) -> ObjectShape:
    """Carve an object out of the views that see it, close it, and mesh it.

    Args:
        views: Depth with masks, in one frame whose z axis points up.
        support_z_m: Height of the plane the object stands on: its unseen underside is closed
            there. None when it does not stand on one.
        align_rounds: Steps in which every view is moved onto what the others saw.

    Raises:
        ShapeError: When fewer than two views show the object, all from one side, or nothing
            is left after carving.
    """
    useful = laid_together(_useful(views), support_z_m, align_rounds)
    low, high = _extent(useful, support_z_m)
    box, truncation = voxel_box(low, high)
    behind = max(min(2 * box.voxel_m, THIN_M), LEAST_BEHIND_VOXELS * box.voxel_m)
    evidence = gather(box, useful, truncation, MIN_FREE_VIEWS, behind)
    solid = solid_of(evidence, support_z_m, low - box.voxel_m, high + box.voxel_m)
    distances = signed_distances(solid, evidence, truncation)
    values = smoothed(distances, box.voxel_m, SMOOTHING_VOXELS)
    grid = SdfGrid(values_m=values, origin_m=box.origin_m, voxel_m=box.voxel_m)
    return _meshed(grid, len(useful), truncation)


def _useful(views: Sequence[MaskedView]) -> list[MaskedView]:
    """Views with enough measured pixels of the object; says what is wrong when too few."""
    if not any(view.mask.any() for view in views):
        message = f"none of {len(views)} views shows the object: all masks are empty."
        raise ShapeError(message)
    useful = [v for v in views if int((v.mask & (v.known_depth_m() > 0)).sum()) >= MIN_POINTS]
    if len(useful) < 2:
        message = (
            f"{len(useful)} of {len(views)} views measured at least {MIN_POINTS} pixels of the "
            "object, and at least 2 from different directions are needed. Scan it from more sides."
        )
        raise ShapeError(message)
    useful = [useful[index] for index in spread(np.arange(len(useful)), MAX_VIEWS)]
    middle = np.mean([view.points_m().mean(axis=0) for view in useful], axis=0)
    rays = np.array([view.T_base_camera[:3, 3] - middle for view in useful])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    turn = float(np.arccos(np.clip(rays @ rays.T, -1.0, 1.0)).max())
    if turn < MIN_SPREAD_RAD:
        message = (
            f"all {len(useful)} views see the object from within {np.degrees(turn):.0f} degrees; "
            f"at least {np.degrees(MIN_SPREAD_RAD):.0f} are needed. Scan it from more sides."
        )
        raise ShapeError(message)
    return useful


def voxel_box(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> tuple[VoxelBox, float]:
    """Voxels around an extent, and the truncation that goes with their size [m]."""
    voxel = max(MIN_VOXEL_M, float((high - low).max()) / VOXELS_ALONG)
    truncation = max(TRUNCATION_VOXELS * voxel, MIN_TRUNCATION_M)
    # Faces between voxels lie on the plane: half a voxel above and below it are the centres.
    origin = low - (PAD_VOXELS - 0.5) * voxel
    num_x, num_y, num_z = (np.ceil((high - low) / voxel).astype(int) + 2 * PAD_VOXELS).tolist()
    return VoxelBox(origin_m=origin, voxel_m=voxel, counts=(num_x, num_y, num_z)), truncation


def _meshed(grid: SdfGrid, num_views: int, truncation_m: float) -> ObjectShape:
    vertices, faces = isosurface(grid.values_m, grid.origin_m, grid.voxel_m)
    return ObjectShape(
        vertices_m=vertices,
        faces=faces,
        sdf=grid,
        is_watertight=is_closed(faces),
        volume_m3=volume_m3(vertices, faces),
        num_views=num_views,
        truncation_m=truncation_m,
    )


def _extent(
    views: Sequence[MaskedView], support_z_m: float | None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Corners of the box of points that two views agree on; flying pixels are on their own.

    The plane, when there is one, closes it below.
    """
    cells = [np.floor(view.points_m() / CELL_M).astype(np.int64) for view in views]
    first = np.min([c.min(axis=0) for c in cells], axis=0)
    spans = np.max([c.max(axis=0) for c in cells], axis=0) - first + 1
    keys = [np.unique(np.ravel_multi_index((c - first).T, spans)) for c in cells]
    each, count = np.unique(np.concatenate(keys), return_counts=True)
    kept = first + np.stack(np.unravel_index(each[count >= 2], spans), axis=1)
    if len(kept) == 0:
        message = (
            f"no two of {len(views)} views measured the object at the same place: the poses do "
            "not fit together. Check the camera poses."
        )
        raise ShapeError(message)
    low, high = kept.min(axis=0) * CELL_M, (kept.max(axis=0) + 1) * CELL_M
    if support_z_m is not None:
        low[2] = support_z_m
        if high[2] <= low[2]:
            message = f"all measured points lie below the plane z = {support_z_m:.4f} m."
            raise ShapeError(message)
    return low, high


def shape_of_mesh(vertices_m: Vertices, faces: Faces, num_views: int = 1) -> ObjectShape:
    """Describe a mesh of closed pieces, which may overlap, like a reconstructed shape.

    Args:
        vertices_m: In the frame that is wanted, z up.
        num_views: How many showed it.
    """
    box, truncation = voxel_box(vertices_m.min(axis=0), vertices_m.max(axis=0))
    places = box.centres_m(np.arange(box.num_voxels))
    values = _signed_m(vertices_m, faces, places).reshape(box.counts)
    if not (values < 0).any():
        message = f"{len(faces)} triangles enclose no voxel of {box.voxel_m * 1e3:.1f} mm."
        raise ShapeError(message)
    grid = SdfGrid(values_m=values, origin_m=box.origin_m, voxel_m=box.voxel_m)
    return _meshed(grid, num_views, truncation)


def _signed_m(
    vertices_m: Vertices, faces: Faces, places: Float[np.ndarray, "num_places 3"]
) -> Float32[np.ndarray, " num_places"]:
    """Distance of places to the union of closed pieces, negative inside of one."""
    count, ends = len(vertices_m), np.concatenate([faces[:, :2], faces[:, 1:]]).T
    _, piece = connected_components(coo_array((np.ones(ends.shape[1]), ends), shape=(count, count)))
    nearest = np.full(len(places), np.inf, dtype=np.float32)
    for number in np.unique(piece[faces[:, 0]]):
        scene = ray_scene([(vertices_m, faces[piece[faces[:, 0]] == number])])
        away = scene.compute_signed_distance(tensor(places.astype(np.float32)))
        nearest = np.minimum(nearest, away.numpy())
    return nearest
