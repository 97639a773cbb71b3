"""Cut things that touch along valleys where both sides stand on their own, and join what is one.

``split_colour`` cuts them by colour before.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay, QhullError

from twin.scene.semantics.cluster import (
    Voxels,
    make_patches,
    numbered,
)
from twin.scene.semantics.colour import without_shading
from twin.scene.semantics.form import measure_form


@dataclass(frozen=True, kw_only=True)
class SplitConfig:
    """When one connected group is several things."""

    max_colours: int = 4
    """Colours to look for in one group."""
    lightness_weight: float = 0.3
    """Shading changes lightness, not the ratios of a and b to it."""
    colour_noise: float = 5.0
    """Spread of one colour, in Lab units; groups tighter than this gain nothing by a cut."""
    min_colour_gap: float = 20.0
    """Distance between two colours that may be two things."""
    samples_per_voxel: float = 0.05
    """Neighbouring voxels are alike: so many independent samples each counts for."""
    min_piece_fraction: float = 0.25
    """Of the larger neighbour; smaller pieces are its markings, unless they lie in its cavity."""
    valley: float = 0.3
    """(n_j - n_i) . d below minus this is a valley: 0.3 is an edge of about 17 degrees."""
    patch_voxels: float = 3.0
    """Size of the patches between which valleys are looked for."""
    min_valley_fraction: float = 0.15
    """Smallest share of a piece that is cut off along a valley."""
    touch_m: float = 0.015
    """A piece whose lowest points are below this stands on the plane."""
    max_overlap_fraction: float = 0.35
    """Of a piece's outline seen from above, within the other's."""


def split_by_valleys(
    voxels: Voxels,
    height_m: Float[np.ndarray, " num_voxels"],
    pairs: Int[np.ndarray, "num_pairs 2"],
    voxel_m: float,
    config: SplitConfig,
) -> Int[np.ndarray, " num_voxels"]:
    """Number the pieces of one connected group that valleys separate.

    Local convexity as in Stein et al. 2014 (LCCP) between small patches. A neck or an armpit is
    a valley too, so a cut counts only between pieces that each stand on the plane and whose
    outlines seen from above hardly overlap: heads, handles and the floor of a box stay.
    """
    patch, p, normals = make_patches(voxels, config.patch_voxels * voxel_m)
    links = np.sort(patch[pairs], axis=1)
    links = np.unique(links[links[:, 0] != links[:, 1]], axis=0)
    away = p[links[:, 1]] - p[links[:, 0]]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    bend = ((normals[links[:, 1]] - normals[links[:, 0]]) * away).sum(axis=1)
    pieces = _merged(len(p), links, bend, -config.valley)[patch]
    while True:
        merge = _first_dependent(pieces, voxels.p_m, height_m, pairs, config)
        if merge is None:
            return numbered(pieces)
        pieces = np.where(pieces == merge[0], merge[1], pieces)


def _merged(
    num_patches: int,
    links: Int[np.ndarray, "num_links 2"],
    bend: Float[np.ndarray, " num_links"],
    least: float,
) -> Int[np.ndarray, " num_patches"]:
    """Join neighbours, the most convex border first, until every border is a valley.

    A border counts by the mean of its links: one convex link, where noise bridges a valley, does
    not join what the rest of the border tells apart.
    """
    borders: list[dict[int, tuple[float, int]]] = [{} for _ in range(num_patches)]
    for (a, b), value in zip(links.tolist(), bend.tolist(), strict=True):
        borders[a][b] = borders[b][a] = (value, 1)
    queue = [(-value, a, b) for (a, b), value in zip(links.tolist(), bend.tolist(), strict=True)]
    heapq.heapify(queue)
    owner = list(range(num_patches))
    while queue and -queue[0][0] > least:
        cost, a, b = heapq.heappop(queue)
        total, count = borders[a].get(b, (np.nan, 1))
        if -cost != total / count:
            continue  # an older state of this border
        if len(borders[a]) < len(borders[b]):
            a, b = b, a
        owner[b] = a
        for other, (value, number) in borders[b].items():
            del borders[other][b]
            if other != a:
                old = borders[a].get(other, (0.0, 0))
                new = (old[0] + value, old[1] + number)
                borders[a][other] = borders[other][a] = new
                heapq.heappush(queue, (-new[0] / new[1], a, other))
        borders[b] = {}
    for patch in range(num_patches):
        root = patch
        while owner[root] != root:
            root = owner[root]
        owner[patch] = root
    return numbered(np.array(owner, dtype=np.int64))


def joined_by_outline(
    pieces: Sequence[Int[np.ndarray, " _"]],
    voxels: Voxels,
    height_m: Float[np.ndarray, " num_voxels"],
    voxel_m: float,
    config: SplitConfig,
) -> list[Int[np.ndarray, " _"]]:
    """Join pieces of one colour of which one lies over the other, or that make a container.

    What one camera sees of a thing may fall into pieces: the far wall of a box behind the near
    one, a head in front of its body.
    """
    xyh = np.concatenate([voxels.p_m[:, :2], height_m[:, None]], axis=1)
    left = sorted(pieces, key=len)
    colours = [
        np.median(without_shading(voxels.lab[ids], config.lightness_weight), axis=0) for ids in left
    ]
    joined: list[np.ndarray] = []
    for index, ids in enumerate(left):
        for other in range(index + 1, len(left)):
            alike = np.linalg.norm(colours[index] - colours[other]) < config.min_colour_gap
            if alike and _belong_together(xyh[ids], xyh[left[other]], voxel_m, config):
                left[other] = np.concatenate([left[other], ids])
                break
        else:
            joined.append(ids)
    return joined


def _belong_together(a: np.ndarray, b: np.ndarray, voxel_m: float, config: SplitConfig) -> bool:
    """Whether one lies over the other, or both are beside each other and hold a cavity."""
    if _overlap(a, b) > config.max_overlap_fraction:
        return True
    gap = np.maximum(a.min(axis=0), b.min(axis=0)) - np.minimum(a.max(axis=0), b.max(axis=0))
    if max(gap[:2]) > 2 * voxel_m:
        return False
    return measure_form(np.concatenate([a, b]), voxel_m).cavity is not None


def _first_dependent(
    pieces: np.ndarray,
    p_m: np.ndarray,
    height_m: np.ndarray,
    pairs: np.ndarray,
    config: SplitConfig,
) -> tuple[int, int] | None:
    """The smallest piece that is not a thing of its own, and the neighbour it belongs to."""
    counts = np.bincount(pieces)
    touch = max(config.touch_m, 0.25 * float(height_m.max()))
    for piece in np.argsort(counts, kind="stable"):
        if counts[piece] == 0:
            continue
        links = pieces[pairs]
        links = links[(links == piece).sum(axis=1) == 1]
        if not len(links):
            continue
        others, strength = np.unique(links[links != piece], return_counts=True)
        strongest = int(others[np.argmax(strength)])
        own = pieces == piece
        small = counts[piece] < config.min_valley_fraction * len(pieces)
        if small or np.quantile(height_m[own], 0.03) > touch:
            return int(piece), strongest
        for other in others:
            if _overlap(p_m[own], p_m[pieces == other]) > config.max_overlap_fraction:
                return int(piece), int(other)
    return None


def _overlap(a_m: np.ndarray, b_m: np.ndarray) -> float:
    """Share of one set of points within the other's outline seen from above, the larger."""
    return max(float(_within(a_m, b_m).mean()), float(_within(b_m, a_m).mean()))


def _within(points: np.ndarray, outline: np.ndarray) -> Bool[np.ndarray, " num_points"]:
    try:
        hull = Delaunay(outline[:, :2])
    except (QhullError, ValueError):
        return np.zeros(len(points), dtype=bool)
    return np.asarray(hull.find_simplex(points[:, :2]) >= 0)
