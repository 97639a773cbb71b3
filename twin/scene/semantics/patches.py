"""Cut what hangs together but is too large for a thing: a shelf with what stands and leans in it.

Neighbouring voxels that face the same way and have one colour grow into patches, cheapest border
first, as long as a border is not clearly more than what varies within (Felzenszwalb and
Huttenlocher 2004, on the graph of voxels instead of pixels). What is then still large is structure
(walls, cupboards), and so is what touches it and has its colour. The rest is joined over outward
bends, and what stands out is a thing: most of its border is an edge, not a line drawn on a surface
that goes on.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from twin.naming.colours import LIGHTNESS_WEIGHT, without_shading
from twin.scene.semantics.cluster import (
    SurfacePoints,
    Voxels,
    make_voxels,
    neighbour_pairs,
    numbered,
)
from twin.scene.semantics.shape_descriptors import sides_m

VOXEL_M = 0.008
"""Least size of the voxels: on finer ones noise of depth bends every surface."""
MAX_VOXEL_M = 0.04
"""Sparser points show no surface."""
COLOUR_GAP = 12.0
"""Lab distance, shading taken out, that costs as much as ``ANGLE_RAD``."""
REACH_VOXELS = 1.8
"""Voxels nearer than this are neighbours."""
ANGLE_RAD = 0.44
"""Bend between neighbours that costs 1; an outward one costs ``CONVEX_SHARE`` of that."""
CONVEX_SHARE = 0.4
"""Things bend outwards, and meet others at inward bends."""
STEP_SLOPE = 0.4
"""Neighbours of one surface are not farther apart across it than this share along it."""
LOOSENESS = 6.0
"""Cost times voxels up to which small patches join (k of the paper)."""
MIN_VOXELS = 25
"""Smaller patches join the neighbour with the cheapest border."""
LEAST_BEND = -0.1
"""Mean (n_j - n_i) . d over a border from which two patches are one thing."""
LEAST_CONTACT = 0.2
"""And which is at least this share of the whole border of one of the two."""
MAX_SIZE_M = 0.45
"""Larger is no thing."""
MIN_AREA_M2 = 0.01
"""Smaller surfaces are fragments."""
DARK = 18.0
"""Below this lightness (L) a colour says nothing: what is so dark and near structure is its
shadow."""
WALL_M = (0.25, 0.2)
"""What is at least this long and wide is structure."""
NEAR_WALL_M = 0.05
"""What is this near to structure and has its colour is structure, hidden in between."""
MIN_WIDTH_M = 0.03
"""Things have at least this extent in two directions."""
MAX_DRAWN_SHARE = 0.7
"""Of a thing's border, where the surface just goes on."""


def cut_into_patches(
    points: SurfacePoints, spacing_m: float, scale: float = 1.0
) -> Int[np.ndarray, " num_points"]:
    """Number the things in one large group from 1; 0 is the rest."""
    voxel_m = scale * max(VOXEL_M, 2.0 * spacing_m)
    if voxel_m > MAX_VOXEL_M:
        return np.zeros(len(points), dtype=np.int64)
    voxels = make_voxels(points, voxel_m)
    pairs = neighbour_pairs(voxels.p_m, REACH_VOXELS * voxel_m)
    labels = np.zeros(len(voxels), dtype=np.int64)
    if len(voxels) < MIN_VOXELS or not len(pairs):
        return np.asarray(labels[voxels.of_point])
    normals, colour = _smoothed(voxels, voxel_m)
    border = _borders(voxels.p_m, normals, colour, pairs)
    patch = _grown(len(voxels), pairs, border.cost)
    num = int(patch.max(initial=-1)) + 1
    middle = np.array([np.median(colour[patch == k], axis=0) for k in range(num)])
    structure = _structure(patch, num, middle, voxels.p_m)
    joined = _joined_outwards(patch, structure, voxels.p_m, pairs, border)
    links = joined[pairs]
    found = 0
    for number in np.unique(joined[~structure[patch]]):
        ids = np.flatnonzero(joined == number)
        around = (links == number).sum(axis=1) == 1
        drawn = float(border.is_flat[around].mean()) if around.any() else 0.0
        wide = sides_m(voxels.p_m[ids])[1] >= MIN_WIDTH_M
        large = len(ids) * voxel_m**2 >= MIN_AREA_M2
        if large and wide and drawn <= MAX_DRAWN_SHARE:
            found += 1
            labels[ids] = found
    return np.asarray(labels[voxels.of_point])


def _smoothed(
    voxels: Voxels, voxel_m: float
) -> tuple[Float[np.ndarray, "num_voxels 3"], Float[np.ndarray, "num_voxels 3"]]:
    """Normals and colours averaged over neighbours that face the same way and look alike."""
    normals, colour = voxels.normals, without_shading(voxels.lab)
    pairs, itself = neighbour_pairs(voxels.p_m, 2.6 * voxel_m), np.arange(len(voxels))
    a = np.concatenate([pairs[:, 0], pairs[:, 1], itself])
    b = np.concatenate([pairs[:, 1], pairs[:, 0], itself])
    for _ in range(2):
        alike = np.clip((normals[a] * normals[b]).sum(axis=1), 0.0, 1.0) ** 4
        gap = np.linalg.norm(colour[a] - colour[b], axis=1) / COLOUR_GAP
        weight = alike * np.exp(-0.5 * gap**2) + 1e-6
        spread = csr_matrix((weight, (a, b)), shape=(len(voxels), len(voxels)))
        normals = spread @ normals
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        colour = spread @ colour / np.asarray(spread.sum(axis=1))
    return normals, colour


@dataclass(frozen=True, kw_only=True)
class _Borders:
    """What lies between the two voxels of each pair."""

    cost: Float[np.ndarray, " num_pairs"]
    bend: Float[np.ndarray, " num_pairs"]
    """(n_j - n_i) . d: positive outwards."""
    is_flat: Bool[np.ndarray, " num_pairs"]
    """The surface goes on."""
    is_step: Bool[np.ndarray, " num_pairs"]
    """One lies before the other."""


def _borders(
    p_m: np.ndarray, normals: np.ndarray, colour: np.ndarray, pairs: np.ndarray
) -> _Borders:
    """Compare the two of each pair."""
    a, b = pairs.T
    away = p_m[b] - p_m[a]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    angle = np.arccos(np.clip((normals[a] * normals[b]).sum(axis=1), -1.0, 1.0))
    bent = ((normals[b] - normals[a]) * away).sum(axis=1)
    mean = normals[a] + normals[b]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    step = np.maximum(np.abs((mean * away).sum(axis=1)) - STEP_SLOPE, 0.0)
    bend = np.where(bent > 0, CONVEX_SHARE, 1.0) * angle / ANGLE_RAD + 2 * step
    gap = np.linalg.norm(colour[a] - colour[b], axis=1) / COLOUR_GAP
    return _Borders(
        cost=np.hypot(bend, gap),
        bend=bent,
        is_flat=(angle < ANGLE_RAD) & (step == 0),
        is_step=step > 0,
    )


def _grown(num: int, pairs: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Join along the cheapest borders first; then give small patches to a neighbour."""
    owner, size, limit = list(range(num)), [1] * num, [LOOSENESS] * num

    def root(node: int) -> int:
        while owner[node] != node:
            owner[node] = owner[owner[node]]
            node = owner[node]
        return node

    order = np.argsort(cost, kind="stable")
    links, costs = pairs[order].tolist(), cost[order].tolist()
    for (left, right), value in zip(links, costs, strict=True):
        a, b = root(left), root(right)
        if a != b and value <= min(limit[a], limit[b]):
            owner[b] = a
            size[a] += size[b]
            limit[a] = value + LOOSENESS / size[a]
    for left, right in links:
        a, b = root(left), root(right)
        if a != b and min(size[a], size[b]) < MIN_VOXELS:
            owner[b] = a
            size[a] += size[b]
    return numbered(np.array([root(node) for node in range(num)], dtype=np.int64))


def _structure(
    patch: np.ndarray, num: int, colour: np.ndarray, p_m: np.ndarray
) -> Bool[np.ndarray, " num_patches"]:
    """Patches that are walls, or near one and of its colour."""
    extents = np.array([sides_m(p_m[patch == k])[:2] for k in range(num)]).reshape(num, 2)
    found = np.all(extents >= WALL_M, axis=1)
    trees = [cKDTree(p_m[patch == k]) for k in range(num)]
    is_dark = colour[:, 0] < LIGHTNESS_WEIGHT * DARK
    todo = list(np.flatnonzero(found))
    while todo:
        wall = todo.pop()
        alike = np.linalg.norm(colour - colour[wall], axis=1) < COLOUR_GAP
        for other in np.flatnonzero((alike | is_dark) & ~found):
            small, large = sorted((trees[wall], trees[other]), key=lambda tree: tree.n)
            gap = large.query(small.data, distance_upper_bound=NEAR_WALL_M)[0].min()
            if np.isfinite(gap):
                found[other] = True
                todo.append(other)
    return np.asarray(found)


def _joined_outwards(
    patch: np.ndarray, structure: np.ndarray, p_m: np.ndarray, pairs: np.ndarray, border: _Borders
) -> Int[np.ndarray, " num_voxels"]:
    """Join patches that are no structure where their border bends outwards, the sharpest first."""
    joined = patch.copy()
    free = ~structure[patch]
    while True:
        links = joined[pairs]
        open_ = (links[:, 0] != links[:, 1]) & free[pairs].all(axis=1)
        keys, index = np.unique(np.sort(links[open_], axis=1), axis=0, return_inverse=True)
        index = index.reshape(-1)
        count = np.maximum(np.bincount(index, minlength=len(keys)), 1)
        bend = np.bincount(index, weights=border.bend[open_], minlength=len(keys)) / count
        steps = np.bincount(index, weights=border.is_step[open_], minlength=len(keys)) / count
        outer = np.bincount(links[links[:, 0] != links[:, 1]].reshape(-1), minlength=len(patch))
        contact = count / np.maximum(outer[keys].min(axis=1), 1)
        fits = (contact >= LEAST_CONTACT) & (steps < MAX_DRAWN_SHARE)
        fits &= bend > LEAST_BEND
        for number in np.argsort(-bend, kind="stable"):
            a, b = keys[number]
            if fits[number] and (sides_m(p_m[(joined == a) | (joined == b)])[0] <= MAX_SIZE_M):
                joined = np.where(joined == b, a, joined)
                break
        else:
            return np.asarray(joined)
