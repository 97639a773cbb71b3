"""Cut what hangs together into things: by shape and colour, joined again where they touch.

Neighbouring voxels that face the same way and have one colour grow into patches, cheapest border
first, as long as a border is not clearly more than what varies within (Felzenszwalb and
Huttenlocher 2004, on the graph of voxels instead of pixels). Patches are joined over outward bends,
the sharpest first: things bend outwards, and meet others at inward bends.

On a plane, which is taken away first, a thing stands: what does not, and what lies over or within
its neighbour and has its colour, belongs to that. Without one, in a shelf, what is large is
structure (walls, cupboards), and so is what touches it and has its colour; of the rest a thing is
what most of whose border is an edge, not a line drawn on a surface that goes on.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import Delaunay, QhullError, cKDTree

from twin.naming.colours import LIGHTNESS_WEIGHT, lab_from_srgb, without_shading
from twin.scene.semantics.points import SurfacePoints
from twin.scene.semantics.shape_descriptors import sides_m

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
MIN_PATCH = 12
"""Patches of fewer voxels join the neighbour with the cheapest border."""
MIN_VOXELS = 25
"""Things of fewer are noise; on a floor, where they are larger, more are asked for."""
LEAST_BEND = -0.1
"""Mean (n_j - n_i) . d over a border from which two patches are one thing."""
LEAST_CONTACT = 0.2
"""And which is at least this share of the whole border of one of the two."""
MAX_SIZE_M = 0.45
"""Larger is furniture, the robot, a wall."""
DARK = 18.0
"""Below this lightness (L) a colour says nothing: what is so dark and near structure is its
shadow."""
WALL_M = (0.25, 0.2)
"""What is at least this long and wide is structure."""
NEAR_WALL_M = 0.05
"""What is this near to structure and has its colour is structure, hidden in between."""
MIN_AREA_M2 = 0.01
"""Before a wall smaller surfaces are fragments."""
MIN_WIDTH_M, MIN_WIDTH_ON_PLANE_M = 0.03, 0.012
"""Things have at least this extent in two directions."""
MAX_DRAWN_SHARE = 0.7
"""Of a thing's border, where the surface just goes on."""
MIN_COLOUR_GAP = 20.0
"""Distance of two colours on a plane that are two things, unless one is a marking."""
MARKING = 0.25
"""Of a neighbour of another colour: what is smaller, and does not bend inwards, is its marking."""
TOUCH_M, MAX_LIFT_M = 0.015, 0.2
"""What begins higher over the plane stands on something, or hangs."""
MIN_SHARE = 0.15
"""Of what touches and has its colour: smaller is a part, unless it is ``TOWERS`` times as high."""
TOWERS = 2.0
MAX_OVERLAP = 0.35
"""Of one outline seen from above within another of its colour: more is one thing."""


@dataclass(frozen=True, kw_only=True)
class Voxels:
    """Means of the points of each occupied voxel."""

    p_m: Float[np.ndarray, "num_voxels 3"]
    normals: Float[np.ndarray, "num_voxels 3"]
    """Unit length where the normals of a voxel agree at all, else zero."""
    colour: Float[np.ndarray, "num_voxels 3"]
    """Lab, shading taken out."""
    of_point: Int[np.ndarray, " num_points"]
    """The voxel of each point."""

    def __len__(self) -> int:
        """Return the number of voxels."""
        return len(self.p_m)


def make_voxels(points: SurfacePoints, voxel_m: float) -> Voxels:
    """Average the points of each occupied voxel."""
    cells = np.floor(points.p_m / voxel_m).astype(np.int64)
    _, index = np.unique(cells, axis=0, return_inverse=True)
    index = index.reshape(-1)
    normals = _means_of(points.normals, index)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Voxels(
        p_m=_means_of(points.p_m, index),
        normals=np.where(length > 0.1, normals / np.maximum(length, 1e-9), 0.0),
        colour=without_shading(_means_of(lab_from_srgb(points.colors), index)),
        of_point=index,
    )


def _means_of(
    values: Float[np.ndarray, "num_rows num_columns"], group: Int[np.ndarray, " num_rows"]
) -> Float[np.ndarray, "num_groups num_columns"]:
    """Average the rows of each group."""
    sums = np.stack([np.bincount(group, weights=column) for column in values.T], axis=1)
    return np.asarray(sums / np.bincount(group)[:, None])


def cut_into_patches(
    points: SurfacePoints,
    voxel_m: float,
    height_m: Float[np.ndarray, " num_points"] | None = None,
    furniture: float = 1.0,
) -> Int[np.ndarray, " num_points"]:
    """Number the things among points from 1; 0 is the rest.

    Args:
        height_m: Over the plane that was taken away from under them; None where there is none.
        furniture: Things are so many times larger than on a table, and of many colours.
    """
    labels = np.zeros(len(points), dtype=np.int64)
    if voxel_m > MAX_VOXEL_M or not len(points):
        return labels
    voxels = make_voxels(points, voxel_m)
    pairs = cKDTree(voxels.p_m).query_pairs(REACH_VOXELS * voxel_m, output_type="ndarray")
    if len(voxels) < MIN_VOXELS or not len(pairs):
        return labels
    p_m, max_size_m = voxels.p_m, furniture * MAX_SIZE_M
    normals, colour = _smoothed(voxels, voxel_m)
    border = _borders(p_m, normals, colour, pairs)
    patch = _grown(len(voxels), pairs, border.cost)
    height = np.zeros(len(voxels))
    if height_m is None:
        walls = _walls(patch, colour, p_m)[patch]
        piece = _joined_outwards(patch, ~walls, p_m, pairs, border, None, max_size_m)
    else:
        height = _means_of(height_m[:, None], voxels.of_point)[:, 0]
        sizes_m = np.array([sides_m(p_m[patch == k]) for k in range(int(patch.max()) + 1)])
        is_panel = np.all(sizes_m[:, :2] >= np.multiply(WALL_M, furniture), axis=1)
        walls = ((sizes_m[:, 0] > max_size_m) | (is_panel & (furniture > 1)))[patch]
        piece = _joined_outwards(patch, ~walls, p_m, pairs, border, colour, max_size_m)
        told = 0.0 * colour if furniture > 1 else colour  # furniture has many
        piece = _with_parts(piece, ~walls, p_m, height, pairs, told)
    number = np.zeros(len(voxels), dtype=np.int64)
    for key in np.unique(piece[~walls]):
        ids = np.flatnonzero(piece == key)
        wide_m = sides_m(p_m[ids])[1]
        if height_m is None:
            around = (piece[pairs] == key).sum(axis=1) == 1
            drawn = float(border.is_flat[around].mean()) if around.any() else 0.0
            is_large = len(ids) * voxel_m**2 >= MIN_AREA_M2 and wide_m >= MIN_WIDTH_M
            is_thing = is_large and drawn <= MAX_DRAWN_SHARE
        else:
            stands = np.quantile(height[ids], 0.03) < furniture * MAX_LIFT_M
            is_thing = stands and wide_m >= MIN_WIDTH_ON_PLANE_M
        if is_thing and len(ids) >= furniture * MIN_VOXELS:
            number[ids] = number.max() + 1
    return np.asarray(number[voxels.of_point])


def _smoothed(
    voxels: Voxels, voxel_m: float
) -> tuple[Float[np.ndarray, "num_voxels 3"], Float[np.ndarray, "num_voxels 3"]]:
    """Normals and colours averaged over neighbours that face the same way and look alike."""
    normals, colour = voxels.normals, voxels.colour
    left, right = cKDTree(voxels.p_m).query_pairs(2.6 * voxel_m, output_type="ndarray").T
    itself = np.arange(len(voxels))
    a, b = (np.concatenate(each) for each in ([left, right, itself], [right, left, itself]))
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
        if a != b and min(size[a], size[b]) < MIN_PATCH:
            owner[b] = a
            size[a] += size[b]
    roots = np.array([root(node) for node in range(num)], dtype=np.int64)
    return np.unique(roots, return_inverse=True)[1].reshape(-1)


def _walls(
    patch: np.ndarray, colour: np.ndarray, p_m: np.ndarray
) -> Bool[np.ndarray, " num_patches"]:
    """Patches that are walls, or near one and of its colour."""
    num = int(patch.max()) + 1
    middle = np.array([np.median(colour[patch == k], axis=0) for k in range(num)])
    extents = np.array([sides_m(p_m[patch == k])[:2] for k in range(num)])
    found = np.all(extents >= WALL_M, axis=1)
    trees = [cKDTree(p_m[patch == k]) for k in range(num)]
    is_dark = middle[:, 0] < LIGHTNESS_WEIGHT * DARK
    todo = list(np.flatnonzero(found))
    while todo:
        wall = todo.pop()
        alike = np.linalg.norm(middle - middle[wall], axis=1) < COLOUR_GAP
        for other in np.flatnonzero((alike | is_dark) & ~found):
            small, large = sorted((trees[wall], trees[other]), key=lambda tree: tree.n)
            gap = large.query(small.data, distance_upper_bound=NEAR_WALL_M)[0].min()
            if np.isfinite(gap):
                found[other] = True
                todo.append(other)
    return np.asarray(found)


def _joined_outwards(
    patch: np.ndarray,
    free: np.ndarray,
    p_m: np.ndarray,
    pairs: np.ndarray,
    border: _Borders,
    colour: np.ndarray | None,
    max_size_m: float,
) -> Int[np.ndarray, " num_voxels"]:
    """Join free patches where their border bends outwards, the sharpest first.

    Args:
        colour: Keep pieces of two colours apart, unless one is a marking; None: a bag in a shelf
            has many.
    """
    joined = patch.copy()
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
            both = (joined == a) | (joined == b)
            if fits[number] and sides_m(p_m[both])[0] <= max_size_m:
                if colour is not None and _are_two(joined == a, joined == b, colour):
                    continue
                joined[both] = a
                break
        else:
            return joined


def _are_two(a: np.ndarray, b: np.ndarray, colour: np.ndarray) -> bool:
    """Whether two pieces differ in colour, and none is small enough to be a marking."""
    small, large = sorted((int(a.sum()), int(b.sum())))
    return small >= MARKING * large and _colour_gap(a, b, colour) >= MIN_COLOUR_GAP


def _colour_gap(a: np.ndarray, b: np.ndarray, colour: np.ndarray) -> float:
    return float(np.linalg.norm(np.median(colour[a], axis=0) - np.median(colour[b], axis=0)))


def _with_parts(
    pieces: np.ndarray,
    free: np.ndarray,
    p_m: np.ndarray,
    height_m: np.ndarray,
    pairs: np.ndarray,
    colour: np.ndarray,
) -> Int[np.ndarray, " num_voxels"]:
    """Join pieces that are no things of their own with what they touch, the smallest first.

    A neck, an armpit and the foot of a handle are inward bends, too.
    """
    open_ = pairs[free[pairs].all(axis=1)]
    while True:
        part = _smallest_part(pieces, p_m, height_m, open_, colour)
        if part is None:
            return pieces
        pieces = np.where(pieces == part[0], part[1], pieces)


def _smallest_part(
    pieces: np.ndarray, p_m: np.ndarray, height_m: np.ndarray, pairs: np.ndarray, colour: np.ndarray
) -> tuple[int, int] | None:
    """The smallest piece that is part of a neighbour of its colour, and that neighbour."""
    counts, links = np.bincount(pieces), pieces[pairs]
    links = links[links[:, 0] != links[:, 1]]
    for piece in sorted(np.unique(links), key=lambda number: counts[number]):
        own = pieces == piece
        mine = links[(links == piece).any(axis=1)]
        others, strength = np.unique(mine[mine != piece], return_counts=True)
        alike = [_colour_gap(own, pieces == other, colour) < MIN_COLOUR_GAP for other in others]
        others, strength = others[alike], strength[alike]
        if not len(others):
            continue
        all_ = own | np.isin(pieces, others)
        touch_m = max(TOUCH_M, 0.25 * float(height_m[all_].max()))
        top_m, beside_m = (np.quantile(height_m[each], 0.97) for each in (own, all_ & ~own))
        is_small = counts[piece] < MIN_SHARE * all_.sum() and top_m < TOWERS * beside_m
        if is_small or np.quantile(height_m[own], 0.03) > touch_m:
            return int(piece), int(others[np.argmax(strength)])
        for other in others:
            if _overlap(p_m[own], p_m[pieces == other]) > MAX_OVERLAP:
                return int(piece), int(other)
    return None


def _overlap(a_m: np.ndarray, b_m: np.ndarray) -> float:
    """Share of one set of points within the other's outline seen from above, the larger."""
    return max(float(within_outline(a_m, b_m).mean()), float(within_outline(b_m, a_m).mean()))


def within_outline(points: np.ndarray, outline: np.ndarray) -> Bool[np.ndarray, " num_points"]:
    """Which points lie within the convex outline of others, seen from above."""
    try:
        hull = Delaunay(outline[:, :2])
    except (QhullError, ValueError):
        return np.zeros(len(points), dtype=bool)
    return np.asarray(hull.find_simplex(points[:, :2]) >= 0)
