"""A link's Gaussians on the surface its description states, in the colours that were seen of it.

Depth is noisy and postures are few, so points fused over a link leave ragged edges and gaps. Where
the description's shape lies within the measured points, Gaussians are set evenly on it, and each
takes the colour of the points near it that face the same way; a side that nobody saw takes the
link's own middle colour. A shape that does not fit reality is not used.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from bridge.geometry.mesh import sample_triangles
from twin.robot.surface import LinkSurface
from twin.scene.fit.initialise import flat_gaussians
from twin.scene.frames.rgbd import PointSet
from twin.scene.gaussians import GaussianCloud
from twin.scene.settings import InitialiseConfig

FITS_M = 0.006
"""Half of the measured points lie nearer to a shape that is the link's."""
PER_CELL = 12
"""Samples for each that is kept: nearly every cell of the surface then has one."""
REACH_M = 0.03
"""Colours of points farther away are not the surface's."""
NEIGHBOURS = 16
BLUR_M = 0.006
WIDER = 1.15
"""Gaussians are wider than their spacing by this, so that nothing shows through."""


def surface_area_m2(surfaces: Sequence[LinkSurface]) -> float:
    """Area of all triangles of a link."""
    return float(sum(_areas(item).sum() for item in surfaces))


def on_surface(
    surfaces: Sequence[LinkSurface],
    sets: Sequence[PointSet],
    spacing_m: float,
    config: InitialiseConfig,
) -> GaussianCloud | None:
    """Gaussians on a link's shapes, in its frame; None where these do not fit what was measured.

    Args:
        surfaces: All shapes of the link.
        sets: What was measured of it, in its frame.
        spacing_m: From one Gaussian to the next.
        config: How flat and how opaque.
    """
    p, normals = _samples(surfaces, spacing_m)
    seen_m, seen_normals, seen_colors = (
        np.concatenate([getattr(item, name) for item in sets])
        for name in ("p_m", "normals", "colors")
    )
    away_m, _ = cKDTree(p).query(seen_m)
    if np.median(away_m) > FITS_M + spacing_m / 2:
        return None
    colors = _colors(p, normals, seen_m, seen_normals, seen_colors)
    sizes = np.full(len(p), WIDER * spacing_m)
    return flat_gaussians(p, normals, colors, sizes, config)


def _areas(item: LinkSurface) -> Float[np.ndarray, " num_triangles"]:
    a, b, c = (item.vertices_m[item.triangles[:, k]] for k in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def _samples(
    surfaces: Sequence[LinkSurface], spacing_m: float
) -> tuple[Float[np.ndarray, "num_points 3"], Float[np.ndarray, "num_points 3"]]:
    """One point in each cell of the surface, with its outward normal; the same ones each time."""
    rng = np.random.default_rng(0)
    points, normals = [], []
    for item in surfaces:
        areas = _areas(item)
        count = max(int(PER_CELL * areas.sum() / spacing_m**2), 1)
        chosen, u, v = sample_triangles(areas, count, rng)
        a, b, c = (item.vertices_m[item.triangles[chosen, k]] for k in range(3))
        points.append(a + u * (b - a) + v * (c - a))
        normal = np.cross(b - a, c - a)
        normals.append(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))
    p, n = np.concatenate(points), np.concatenate(normals)
    cells = np.floor((p - p.min(axis=0)) / spacing_m).astype(np.int64)
    facing = (n[np.arange(len(n)), np.abs(n).argmax(axis=1)] > 0).astype(np.int64)
    axis = np.abs(n).argmax(axis=1)
    keys = np.column_stack([cells, axis, facing])  # both sides of a thin plate are kept
    _, first = np.unique(keys, axis=0, return_index=True)
    return p[np.sort(first)], n[np.sort(first)]


def _colors(
    p: Float[np.ndarray, "num_points 3"],
    normals: Float[np.ndarray, "num_points 3"],
    seen_m: Float[np.ndarray, "num_seen 3"],
    seen_normals: Float[np.ndarray, "num_seen 3"],
    seen_colors: Float[np.ndarray, "num_seen 3"],
) -> Float[np.ndarray, "num_points 3"]:
    """Mean colour of the measured points around that face the same way."""
    distance, ids = cKDTree(seen_m).query(p, k=min(NEIGHBOURS, len(seen_m)))
    distance, ids = distance.reshape(len(p), -1), ids.reshape(len(p), -1)
    alike = np.einsum("pkc,pc->pk", seen_normals[ids], normals).clip(0.0)
    nearest = distance.min(axis=1, keepdims=True)
    weight = alike * np.exp(-0.5 * ((distance - nearest) / BLUR_M) ** 2) * (distance < REACH_M)
    total = weight.sum(axis=1, keepdims=True)
    mean = np.einsum("pk,pkc->pc", weight, seen_colors[ids]) / np.maximum(total, 1e-9)
    middle = np.median(seen_colors, axis=0)
    return np.asarray(np.where(total > 0.05, mean, middle))
