"""The first Gaussians: depth points fused in voxels as large as the pixels that saw them.

Measurements of one surface by many views scatter by more than a voxel: noise, and poses that are
off. Voxels then lie in several layers one behind the other, each view meets the front one first,
and depth comes out too near. So each voxel is moved along its normal to where the views measured
the surface on average.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Float32, Int8

from bridge.geometry import se3
from twin.errors import TwinError
from twin.scene.frames.downscaled import pixels_of
from twin.scene.frames.rgbd import NEAR_M, PointSet, TrainingView
from twin.scene.gaussians import GaussianCloud, as_float32, morton_order

MAX_LEVEL = 6
INDEX_BITS = 19
FOOTPRINTS = 1.6
"""Size of a voxel in pixel footprints z/f."""
FLATNESS, OPACITY = 0.1, 0.95
"""Of a new Gaussian: deviation along the normal, in that in the plane; opacity."""
IN_PLANE_SIGMA = 0.55
"""Standard deviation in the plane, in voxels (measured best for a closed surface)."""
MIN_POINTS = 2
"""A voxel seen by fewer points is noise."""


SETTLE_ROUNDS = 3
SETTLE_SIGMA = 4.0
"""Measurements within this many times their scatter are of the same surface."""
OTHER_SURFACE = 0.05
"""Those whose depth differs by more than this share never are."""
LEAST_COSINE = 0.2
"""Of the angle between a ray and the normal; flatter looks measure nothing along the normal."""


class NoSurfaceError(TwinError):
    """The depth images hold no usable surface."""


def fuse(points: list[PointSet], most: int, views: Sequence[TrainingView] = ()) -> GaussianCloud:
    """Average points in voxels of 1.6 pixel footprints, and flatten them along their normal.

    Voxel sizes are powers of two times a base size, so that near surfaces keep detail and far
    ones do not waste Gaussians. A coarse voxel gives way where finer ones cover it. All voxels
    grow together until there are few enough.

    Args:
        most: Gaussians.
        views: Whose depth says where the surface is on average; none: voxels stay where they are.
    """
    p = np.concatenate([item.p_m for item in points])
    if len(p) < MIN_POINTS:
        raise NoSurfaceError(_no_surface(len(p)))
    p -= p.min(axis=0)
    wanted = np.float32(FOOTPRINTS) * np.concatenate([item.footprint_m for item in points])
    base = float(np.quantile(wanted, 0.05))
    level = np.clip(np.rint(np.log2(wanted / np.float32(base))), 0, MAX_LEVEL).astype(np.int8)
    inverse, kept, sizes = _voxels(p, level, base)
    while kept.sum() > most:
        base *= 1.05 * float(np.sqrt(kept.sum() / most))
        inverse, kept, sizes = _voxels(p, level, base)
    if not kept.any():
        raise NoSurfaceError(_no_surface(len(p)))
    del p, wanted, level
    count = np.bincount(inverse, minlength=len(kept))[kept]
    means, normals, colors = (
        _average([getattr(item, name) for item in points], inverse, kept, count)
        for name in ("p_m", "normals", "colors")
    )
    if len(views) > 0:
        means = _settled(means, normals, views)
    cloud = flat_gaussians(means, normals, colors, sizes[kept])
    return cloud.take(morton_order(cloud.means_m))


def _settled(
    means: Float[np.ndarray, "num_voxels 3"],
    normals: Float[np.ndarray, "num_voxels 3"],
    views: Sequence[TrainingView],
) -> Float[np.ndarray, "num_voxels 3"]:
    """Voxels moved along their normals to the mean of what the views measured there.

    Near measurements and those seen straight on count more, as the noise of depth cameras grows
    with the square of the distance.
    """
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    means, unit = as_float32(means), as_float32(unit)
    for _ in range(SETTLE_ROUNDS):
        seen = list(_measured_offsets(means, unit, views))
        scatter = np.concatenate([np.abs(off_m) / depth_m for _, off_m, depth_m, _ in seen])
        if len(scatter) == 0:
            break
        limit = SETTLE_SIGMA * 1.4826 * np.median(scatter)
        total, weights = (np.zeros(len(means), np.float32) for _ in range(2))
        for voxel, off_m, depth_m, cosine in seen:
            weight = cosine / np.square(depth_m)
            weight *= np.abs(off_m) <= limit * depth_m
            total[voxel] += weight * off_m
            weights[voxel] += weight
        means += (total / np.where(weights > 0, weights, 1.0))[:, None] * unit
    return means.astype(np.float64)


def _measured_offsets(
    means: Float32[np.ndarray, "num_voxels 3"],
    normals: Float32[np.ndarray, "num_voxels 3"],
    views: Sequence[TrainingView],
) -> Iterator[tuple[np.ndarray, ...]]:
    """Look each voxel up in each depth image; what another surface hides is left out.

    Yields:
        Of each view the voxels whose surface it measured; how far away it did [m], along their
        normals to the plane through the measured point; that depth [m]; and the cosine between
        ray and normal.
    """
    for view in views:
        camera, T = view.full.camera, as_float32(se3.invert(view.T_base_color))
        p = means @ T[:3, :3].T + T[:3, 3]
        row, column, inside = pixels_of(camera, p)
        voxel = np.flatnonzero(inside & (p[:, 2] > NEAR_M))
        x, y = column[voxel], row[voxel]
        depth = view.full.depth_m[y, x]
        ray = as_float32(camera.rays()[y, x])
        p, n = p[voxel], normals[voxel] @ T[:3, :3].T
        cosine = -np.einsum("ni,ni->n", n, ray) / np.linalg.norm(ray, axis=1)
        offset = np.einsum("ni,ni->n", n, depth[:, None] * ray - p)
        same = (depth > 0) & (cosine > LEAST_COSINE)
        same &= np.abs(depth - p[:, 2]) < OTHER_SURFACE * p[:, 2]
        yield voxel[same], offset[same], depth[same], cosine[same]


def _no_surface(num_points: int) -> str:
    return (
        f"the depth images hold only {num_points} usable points. Check that depth is in "
        "millimetres, that the camera sees surfaces nearer than --max-depth-m, and that most "
        "pixels have a measurement: points without measured neighbours are not trusted."
    )


def _voxels(
    p: Float32[np.ndarray, "num_points 3"], level: Int8[np.ndarray, " num_points"], base_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voxel of each point (from a corner), which voxels to keep, and their sizes [m]."""
    inverse_size = np.float32(1 / base_m) * np.exp2(-level.astype(np.float32))
    keys = level.astype(np.int64)
    for axis in range(3):
        cell = (p[:, axis] * inverse_size).astype(np.int32)
        keys <<= INDEX_BITS
        keys |= np.minimum(cell, (1 << INDEX_BITS) - 1)
    key, inverse, count = np.unique(keys, return_inverse=True, return_counts=True)
    kept = count >= MIN_POINTS
    covered = _covered_by_finer(key, kept)
    sizes = base_m * 2.0 ** (key >> (3 * INDEX_BITS))
    return inverse.astype(np.int32), kept & ~covered, sizes


def _pack(cell: np.ndarray, level: np.ndarray) -> np.ndarray:
    clipped = np.minimum(cell, (1 << INDEX_BITS) - 1)
    key = level
    for axis in range(3):
        key = (key << INDEX_BITS) | clipped[:, axis]
    return np.asarray(key)


def _covered_by_finer(key: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Say which voxels have a surface's worth (two or more) of next finer voxels inside."""
    mask = (1 << INDEX_BITS) - 1
    level = key >> (3 * INDEX_BITS)
    cell = np.stack([(key >> (shift * INDEX_BITS)) & mask for shift in (2, 1, 0)], axis=1)
    covered = np.zeros(len(key), dtype=bool)
    for finer in range(MAX_LEVEL):
        inside = (level == finer) & (kept | covered)
        parents, counts = np.unique(_pack(cell[inside] >> 1, level[inside] + 1), return_counts=True)
        covered |= np.isin(key, parents[counts >= 2])
    return covered


def _average(
    tables: list[np.ndarray], inverse: np.ndarray, kept: np.ndarray, count: np.ndarray
) -> Float[np.ndarray, "num_kept 3"]:
    """Mean of three columns in each voxel that is kept, one column in memory at a time."""
    means = np.empty((len(count), 3))
    for axis in range(3):
        column = np.concatenate([table[:, axis] for table in tables])
        means[:, axis] = np.bincount(inverse, weights=column, minlength=len(kept))[kept] / count
    return means


def flat_gaussians(
    means: np.ndarray,
    normals: np.ndarray,
    colors: np.ndarray,
    sizes: np.ndarray,
    flatness: float = FLATNESS,
) -> GaussianCloud:
    """Gaussians as wide as what they stand for, flat along their normals.

    Args:
        normals: Along which they are flat; any length.
        colors: sRGB, 0..1.
        sizes: Edge of the square or voxel each stands for [m].
        flatness: Deviation along the normal, in that in the plane.
    """
    sigma = IN_PLANE_SIGMA * sizes
    scales = np.stack([sigma, sigma, flatness * sigma], axis=1)
    logit = np.log(OPACITY / (1 - OPACITY))
    return GaussianCloud(
        means_m=as_float32(means),
        quats_wxyz=_quats_with_z_along(normals),
        scales_log=as_float32(np.log(scales)),
        opacities_logit=np.full(len(means), logit, dtype=np.float32),
        colors=as_float32(colors),
    )


def _quats_with_z_along(normals: np.ndarray) -> Float32[np.ndarray, "num_splats 4"]:
    """Shortest rotation from +Z to each normal: q = (1 + n_z, -n_y, n_x, 0), normalised."""
    length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    n = normals / length
    q = np.stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))], axis=1)
    upside_down = q[:, 0] < 1e-6
    q[upside_down] = (0.0, 1.0, 0.0, 0.0)
    return as_float32(q / np.linalg.norm(q, axis=1, keepdims=True))
