"""The first Gaussians: depth points fused in voxels as large as the pixels that saw them."""

import numpy as np
from jaxtyping import Float, Float32, Int8

from twin.errors import TwinError
from twin.scene.frames.rgbd import PointSet
from twin.scene.gaussians import GaussianCloud, as_float32, morton_order
from twin.scene.settings import InitialiseConfig

MAX_LEVEL = 6
INDEX_BITS = 19
IN_PLANE_SIGMA = 0.55
"""Standard deviation in the plane, in voxels (measured best for a closed surface)."""
MIN_POINTS = 2
"""A voxel seen by fewer points is noise."""


class NoSurfaceError(TwinError):
    """The depth images hold no usable surface."""


def fuse(points: list[PointSet], config: InitialiseConfig) -> GaussianCloud:
    """Average points in voxels of 1.6 pixel footprints, and flatten them along their normal.

    Voxel sizes are powers of two times a base size, so that near surfaces keep detail and far
    ones do not waste Gaussians. A coarse voxel gives way where finer ones cover it. All voxels
    grow together until the budget, less what is left to the fit, holds.

    Args:
        points: What each frame measured, all in one frame.
        config: Voxel size, budget and the shape of new Gaussians.

    Raises:
        NoSurfaceError: When no voxel has two points.
    """
    p = np.concatenate([item.p_m for item in points])
    if len(p) < MIN_POINTS:
        raise NoSurfaceError(_no_surface(len(p)))
    p -= p.min(axis=0)
    wanted = np.float32(config.footprint_factor) * np.concatenate(
        [item.footprint_m for item in points]
    )
    base = float(np.quantile(wanted, 0.05))
    level = np.clip(np.rint(np.log2(wanted / np.float32(base))), 0, MAX_LEVEL).astype(np.int8)
    budget = max(round(config.max_splats * (1 - config.growth)), 1)
    inverse, kept, sizes = _voxels(p, level, base)
    while kept.sum() > budget:
        base *= 1.05 * float(np.sqrt(kept.sum() / budget))
        inverse, kept, sizes = _voxels(p, level, base)
    if not kept.any():
        raise NoSurfaceError(_no_surface(len(p)))
    del p, wanted, level
    count = np.bincount(inverse, minlength=len(kept))[kept]
    means, normals, colors = (
        _average([getattr(item, name) for item in points], inverse, kept, count)
        for name in ("p_m", "normals", "colors")
    )
    cloud = flat_gaussians(means, normals, colors, sizes[kept], config)
    return cloud.take(morton_order(cloud.means_m))


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
    config: InitialiseConfig,
) -> GaussianCloud:
    """Gaussians as wide as what they stand for, flat along their normals.

    Args:
        means: Where they are [m].
        normals: Along which they are flat; any length.
        colors: sRGB, 0..1.
        sizes: Edge of the square or voxel each stands for [m].
        config: How flat and how opaque.
    """
    sigma = IN_PLANE_SIGMA * sizes
    scales = np.stack([sigma, sigma, config.flatness * sigma], axis=1)
    logit = np.log(config.opacity / (1 - config.opacity))
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
