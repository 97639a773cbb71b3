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

from twin.scene.fit.initialise import flat_gaussians
from twin.scene.fit.on_mesh import WIDER, Triangles, even_points
from twin.scene.frames.rgbd import PointSet
from twin.scene.gaussians import GaussianCloud
from twin.scene.settings import InitialiseConfig

FITS_M = 0.006
"""Half of the measured points lie nearer to a shape that is the link's."""
REACH_M = 0.03
"""Colours of points farther away are not the surface's."""
NEIGHBOURS = 16
BLUR_M = 0.006


def on_surface(
    shapes: Sequence[Triangles],
    sets: Sequence[PointSet],
    spacing_m: float,
    config: InitialiseConfig,
) -> GaussianCloud | None:
    """Gaussians on a link's shapes, in its frame; None where these do not fit what was measured.

    Args:
        shapes: All shapes of the link.
        sets: What was measured of it, in its frame.
        spacing_m: From one Gaussian to the next.
        config: How flat and how opaque.
    """
    p, normals = even_points(shapes, spacing_m)
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
