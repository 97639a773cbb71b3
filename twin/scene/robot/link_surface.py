"""A link's Gaussians on the surface its description states, in the colours that were seen of it.

Depth is noisy and postures are few, so points fused over a link leave ragged edges and gaps. Where
the description's shape lies within the measured points, Gaussians are set evenly on it, and each
takes the colour of the points near it that face the same way; a side that nobody saw takes the
link's own middle colour. A shape that does not fit reality is not used.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from twin.scene.fit.initialise import flat_gaussians
from twin.scene.fit.lighting import EVEN, Lighting, Patches, fit_lighting
from twin.scene.fit.on_mesh import WIDER, even_points, within_edges
from twin.scene.frames.rgbd import PointSet
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.shape.mesh import Mesh

FITS_M = 0.006
"""Half of the measured points lie nearer to a shape that is the link's."""
REACH_M = 0.03
"""Colours of points farther away are not the surface's."""
NEIGHBOURS = 16
BLUR_M = 0.006
PATCH_M, PATCH_NEIGHBOURS = 0.012, 4
"""Pieces of a link's surface whose light is compared between postures, and how many are looked at
to find the one that a point lies on."""
FACES_ALIKE = 0.7
"""Cosine between a measured normal and that of the surface it is of."""
MOST_WEIGHT = 10
"""More points on one piece count no more."""


@dataclass(frozen=True, kw_only=True)
class SeenLink:
    """What one frame measured of a link."""

    points: PointSet
    """In the link's frame."""
    R_base_link: Float[np.ndarray, "3 3"]
    """How the link was turned."""


def link_lighting(
    shapes: Mapping[str, Sequence[Mesh]], seen: Mapping[str, Sequence[SeenLink]]
) -> Lighting:
    """The light on a robot, from links that were seen turned in several ways."""
    patches: list[Patches] = []
    first = 0
    for link, items in sorted(seen.items()):
        if not shapes.get(link):
            continue
        p, normals = even_points(shapes[link], PATCH_M)
        tree = cKDTree(p)
        for item in items:
            piece, is_on = _pieces(item.points, tree, normals)
            ids, inverse = np.unique(piece[is_on], return_inverse=True)
            count = np.maximum(np.bincount(inverse, minlength=len(ids)), 1)
            colors = [
                np.bincount(inverse, item.points.colors[is_on, k], len(ids)) / count
                for k in range(3)
            ]
            patches.append(
                Patches(
                    ids=first + ids,
                    colors=np.stack(colors, axis=1),
                    normals=normals[ids] @ item.R_base_link.T,
                    weights=np.minimum(count, MOST_WEIGHT).astype(np.float64),
                )
            )
        first += len(p)
    return fit_lighting(patches)


def own_colors(
    shapes: Sequence[Mesh], seen: Sequence[SeenLink], lighting: Lighting
) -> list[PointSet]:
    """What was measured of a link with its own colours, as in even light.

    Args:
        shapes: Of the link, in its frame: measured normals are noisy, theirs are not; may be none.
    """
    if lighting == EVEN:
        return [item.points for item in seen]
    p, normals = even_points(shapes, PATCH_M) if shapes else (np.zeros((1, 3)), np.zeros((1, 3)))
    tree = cKDTree(p)
    result = []
    for item in seen:
        piece, is_on = _pieces(item.points, tree, normals)
        facing = np.where(is_on[:, None], normals[piece], item.points.normals)
        light = lighting.brightness(facing @ item.R_base_link.T)
        colors = as_float32(item.points.colors / light[:, None])
        result.append(replace(item.points, colors=colors))
    return result


def _pieces(
    points: PointSet, tree: cKDTree, normals: Float[np.ndarray, "num_pieces 3"]
) -> tuple[Int[np.ndarray, " num_points"], Bool[np.ndarray, " num_points"]]:
    """The piece of surface each point lies on, and whether it does."""
    count = min(PATCH_NEIGHBOURS, tree.n)
    distance, ids = tree.query(points.p_m, k=count)
    distance, ids = distance.reshape(-1, count), ids.reshape(-1, count)
    alike = np.einsum("pkc,pc->pk", normals[ids], points.normals)
    rows, best = np.arange(len(ids)), alike.argmax(axis=1)
    is_on = (alike[rows, best] > FACES_ALIKE) & (distance[rows, best] < 2 * PATCH_M)
    return ids[rows, best], is_on


def on_surface(
    shapes: Sequence[Mesh], sets: Sequence[PointSet], spacing_m: float
) -> GaussianCloud | None:
    """Gaussians on a link's shapes, in its frame; None where these do not fit what was measured."""
    p, normals = even_points(shapes, spacing_m)
    seen_m, seen_normals, seen_colors = (
        np.concatenate([getattr(item, name) for item in sets])
        for name in ("p_m", "normals", "colors")
    )
    away_m, _ = cKDTree(p).query(seen_m)
    if np.median(away_m) > FITS_M + spacing_m / 2:
        return None
    p = within_edges(p, normals, shapes, spacing_m)
    colors = _colors(p, normals, seen_m, seen_normals, seen_colors)
    sizes = np.full(len(p), WIDER * spacing_m)
    return flat_gaussians(p, normals, colors, sizes)


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
