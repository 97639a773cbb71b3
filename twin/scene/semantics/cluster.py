"""Divide points into things: connected voxels, cut along valleys and where colours differ."""

import heapq
import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError, cKDTree
from scipy.spatial.distance import pdist

from twin.naming.colours import lab_from_srgb, without_shading
from twin.scene.semantics.shape_descriptors import find_height_map_cavity, height_map


@dataclass(frozen=True, kw_only=True)
class SurfacePoints:
    """Coloured, oriented points of visible surfaces in the root frame."""

    p_m: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    """Unit vectors out of the surface, towards whoever saw it."""
    colors: Float[np.ndarray, "num_points 3"]
    """sRGB, 0..1."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.p_m)

    def take(self, index: np.ndarray) -> "SurfacePoints":
        """Select points by a mask or by ids."""
        return SurfacePoints(**{name: rows[index] for name, rows in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class Voxels:
    """Means of the points of each occupied voxel."""

    p_m: Float[np.ndarray, "num_voxels 3"]
    normals: Float[np.ndarray, "num_voxels 3"]
    """Unit length where the normals of a voxel agree at all, else zero."""
    lab: Float[np.ndarray, "num_voxels 3"]
    count: Int[np.ndarray, " num_voxels"]
    of_point: Int[np.ndarray, " num_points"]
    """The voxel of each point."""

    def __len__(self) -> int:
        """Return the number of voxels."""
        return len(self.p_m)


def make_voxels(points: SurfacePoints, voxel_m: float) -> Voxels:
    """Average the points of each occupied voxel."""
    cells = np.floor(points.p_m / voxel_m).astype(np.int64)
    _, index, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    normals = means_of(points.normals, index, len(count))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Voxels(
        p_m=means_of(points.p_m, index, len(count)),
        normals=np.where(length > 0.1, normals / np.maximum(length, 1e-9), 0.0),
        lab=means_of(lab_from_srgb(points.colors), index, len(count)),
        count=count,
        of_point=index,
    )


def means_of(
    values: Float[np.ndarray, "num_rows num_columns"],
    group: Int[np.ndarray, " num_rows"],
    num_groups: int,
) -> Float[np.ndarray, "num_groups num_columns"]:
    """Average the rows of each group; a group without rows gives zero."""
    count = np.maximum(np.bincount(group, minlength=num_groups), 1)
    sums = [np.bincount(group, weights=column, minlength=num_groups) for column in values.T]
    return np.asarray(np.stack(sums, axis=1) / count[:, None])


def neighbour_pairs(
    p_m: Float[np.ndarray, "num_voxels 3"], reach_m: float
) -> Int[np.ndarray, "num_pairs 2"]:
    """Pairs of points nearer than a distance, each once."""
    if len(p_m) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    pairs = cKDTree(p_m).query_pairs(reach_m, output_type="ndarray")
    return np.asarray(pairs, dtype=np.int64)


def components(
    num_nodes: int, pairs: Int[np.ndarray, "num_pairs 2"]
) -> Int[np.ndarray, " num_nodes"]:
    """Number the connected groups of a graph from 0, in the order of their first node."""
    weights = np.ones(len(pairs), dtype=np.int8)
    graph = coo_matrix((weights, (pairs[:, 0], pairs[:, 1])), shape=(num_nodes, num_nodes))
    _, labels = connected_components(graph, directed=False)
    return numbered(np.asarray(labels, dtype=np.int64))


def pairs_among(
    ids: Int[np.ndarray, " num_members"], pairs: Int[np.ndarray, "num_pairs 2"], num_nodes: int
) -> Int[np.ndarray, "num_own 2"]:
    """The pairs that lie among some nodes, in the numbering of these."""
    rank = np.full(num_nodes, -1, dtype=np.int64)
    rank[ids] = np.arange(len(ids))
    own = rank[pairs]
    return np.asarray(own[(own >= 0).all(axis=1)])


def extents_m(p_m: Float[np.ndarray, "num_points 3"]) -> Float[np.ndarray, "3"]:
    """Extents along the axes, largest first."""
    return np.asarray(np.sort(p_m.max(axis=0) - p_m.min(axis=0))[::-1])


def numbered(labels: Int[np.ndarray, " num_nodes"]) -> Int[np.ndarray, " num_nodes"]:
    """Renumber labels from 0 in the order in which they first appear."""
    _, first, index = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[index.reshape(-1)]


def make_patches(
    voxels: Voxels, size_m: float
) -> tuple[
    Int[np.ndarray, " num_voxels"],
    Float[np.ndarray, "num_patches 3"],
    Float[np.ndarray, "num_patches 3"],
]:
    """Group voxels that are near and face the same way: patch of each, centres, normals."""
    cells = np.floor(voxels.p_m / size_m).astype(np.int64)
    axis = np.abs(voxels.normals).argmax(axis=1)
    forward = np.take_along_axis(voxels.normals, axis[:, None], axis=1)[:, 0] > 0
    keys = np.concatenate([cells, (2 * axis + forward)[:, None]], axis=1)
    _, patch = np.unique(keys, axis=0, return_inverse=True)
    patch = patch.reshape(-1)
    num = int(patch.max(initial=-1)) + 1
    normals = means_of(voxels.normals, patch, num)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return patch, means_of(voxels.p_m, patch, num), normals / np.maximum(length, 1e-9)


MAX_COLOURS = 4
"""Colours to look for in one group."""
COLOUR_NOISE = 5.0
"""Spread of one colour, in Lab units; groups tighter than this gain nothing by a cut."""
MIN_COLOUR_GAP = 20.0
"""Distance between two colours that may be two things."""
SAMPLES_PER_VOXEL = 0.05
"""Neighbouring voxels are alike: so many independent samples each counts for."""
MIN_PIECE_FRACTION = 0.25
"""Of the larger neighbour; smaller pieces are its markings, unless they lie in its cavity."""
VALLEY = 0.3
"""(n_j - n_i) . d below minus this is a valley: 0.3 is an edge of about 17 degrees."""
PATCH_VOXELS = 3.0
"""Size of the patches between which valleys are looked for."""
MIN_VALLEY_FRACTION = 0.15
"""Smallest share of a piece that is cut off along a valley."""
TOUCH_M = 0.015
"""A piece whose lowest points are below this stands on the plane."""
MAX_OVERLAP_FRACTION = 0.35
"""Of a piece's outline seen from above, within the other's."""


def split_by_valleys(
    voxels: Voxels,
    height_m: Float[np.ndarray, " num_voxels"],
    pairs: Int[np.ndarray, "num_pairs 2"],
    voxel_m: float,
) -> Int[np.ndarray, " num_voxels"]:
    """Number the pieces of one connected group that valleys separate.

    Local convexity as in Stein et al. 2014 (LCCP) between small patches. A neck or an armpit is
    a valley too, so a cut counts only between pieces that each stand on the plane and whose
    outlines seen from above hardly overlap: heads, handles and the floor of a box stay.
    """
    patch, p, normals = make_patches(voxels, PATCH_VOXELS * voxel_m)
    links = np.sort(patch[pairs], axis=1)
    links = np.unique(links[links[:, 0] != links[:, 1]], axis=0)
    away = p[links[:, 1]] - p[links[:, 0]]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    bend = ((normals[links[:, 1]] - normals[links[:, 0]]) * away).sum(axis=1)
    pieces = _merged(len(p), links, bend, -VALLEY)[patch]
    while True:
        merge = _first_dependent(pieces, voxels.p_m, height_m, pairs)
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


def _first_dependent(
    pieces: np.ndarray, p_m: np.ndarray, height_m: np.ndarray, pairs: np.ndarray
) -> tuple[int, int] | None:
    """The smallest piece that is not a thing of its own, and the neighbour it belongs to."""
    counts = np.bincount(pieces)
    touch = max(TOUCH_M, 0.25 * float(height_m.max()))
    for piece in np.argsort(counts, kind="stable"):
        if counts[piece] == 0:
            continue
        others, strength = _neighbours(pieces, pairs, int(piece))
        if not len(others):
            continue
        strongest = int(others[np.argmax(strength)])
        own = pieces == piece
        small = counts[piece] < MIN_VALLEY_FRACTION * len(pieces)
        if small or np.quantile(height_m[own], 0.03) > touch:
            return int(piece), strongest
        for other in others:
            if _overlap(p_m[own], p_m[pieces == other]) > MAX_OVERLAP_FRACTION:
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


def split_by_colour(
    voxels: Voxels,
    height_m: Float[np.ndarray, " num_voxels"],
    pairs: Int[np.ndarray, "num_pairs 2"],
) -> Int[np.ndarray, " num_voxels"]:
    """Number the pieces of one connected group that differ in colour.

    k-means in Lab for k = 1.. with a Schwarz criterion whose noise has a floor; then connected
    pieces of one colour. A piece much smaller than its neighbour is a marking (a beak, a label)
    and joins it, unless it lies in the neighbour's cavity.
    """
    colour = without_shading(voxels.lab)
    classes = _colour_classes(colour)
    if classes.max(initial=0) == 0:
        return classes
    same = classes[pairs[:, 0]] == classes[pairs[:, 1]]
    pieces = components(len(voxels), pairs[same])
    while True:
        small = _smallest_marking(pieces, voxels, height_m, pairs, colour)
        if small is None:
            return numbered(pieces)
        pieces = np.where(pieces == small[0], small[1], pieces)


def _colour_classes(colour: np.ndarray) -> np.ndarray:
    samples = max(SAMPLES_PER_VOXEL * len(colour), 2.0)
    best, best_cost = np.zeros(len(colour), dtype=np.int64), np.inf
    for num in range(1, MAX_COLOURS + 1):
        classes, centres = _k_means(colour, num)
        if num > 1 and pdist(centres).min() < MIN_COLOUR_GAP:
            continue
        spread = np.square(colour - centres[classes]).sum(axis=1).mean() / 3
        variance = max(float(spread), COLOUR_NOISE**2)
        cost = 3 * samples * np.log(variance) + 4 * num * np.log(samples)
        if cost < best_cost - 1e-9:
            best, best_cost = classes, float(cost)
    return best


def _k_means(values: np.ndarray, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Lloyd's iteration from the farthest points, so that the result needs no seed."""
    centres = [np.median(values, axis=0)]
    for _ in range(1, num):
        gap = np.min([np.square(values - c).sum(axis=1) for c in centres], axis=0)
        # Not the very farthest: a few mixed voxels at an edge should not seed a colour.
        centres.append(values[np.argsort(gap, kind="stable")[int(0.98 * (len(gap) - 1))]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a class that nothing is nearest to keeps its centre
        middle, classes = kmeans2(values, np.array(centres), iter=20, minit="matrix")
    return classes.astype(np.int64), middle


def _smallest_marking(
    pieces: np.ndarray, voxels: Voxels, height_m: np.ndarray, pairs: np.ndarray, colour: np.ndarray
) -> tuple[int, int] | None:
    """The smallest piece that is no thing of its own, and the neighbour it belongs to."""
    counts = np.bincount(pieces)
    for piece in np.argsort(counts, kind="stable"):
        if counts[piece] == 0:
            continue
        neighbours, _ = _neighbours(pieces, pairs, int(piece))
        if not len(neighbours):
            continue
        own = colour[pieces == piece].mean(axis=0)
        gaps = [np.linalg.norm(own - colour[pieces == other].mean(axis=0)) for other in neighbours]
        largest = int(neighbours[np.argmax(counts[neighbours])])
        if min(gaps) < MIN_COLOUR_GAP:
            return int(piece), int(neighbours[int(np.argmin(gaps))])
        if counts[piece] >= 20 and _lies_in(pieces == piece, pieces == largest, voxels, height_m):
            continue
        inside = _is_set_in(pieces == piece, pieces == largest, voxels, height_m)
        if counts[piece] >= MIN_PIECE_FRACTION * counts[largest] and not inside:
            continue
        return int(piece), largest
    return None


def _neighbours(pieces: np.ndarray, pairs: np.ndarray, piece: int) -> tuple[np.ndarray, np.ndarray]:
    """The pieces that one touches, and by how many pairs."""
    links = pieces[pairs]
    links = links[(links == piece).sum(axis=1) == 1]
    return np.unique(links[links != piece], return_counts=True)


SET_IN_SHARE = 0.5
"""Of a marking's outline within that of what it is on."""
STANDS_ON = 0.8
"""What begins above this quantile of the other's heights stands on it."""


def _is_set_in(inner: np.ndarray, outer: np.ndarray, voxels: Voxels, height_m: np.ndarray) -> bool:
    """Whether one piece lies in the other's surface, seen from above, and does not stand on it."""
    if np.quantile(height_m[inner], 0.1) > np.quantile(height_m[outer], STANDS_ON):
        return False
    return bool(within_outline(voxels.p_m[inner], voxels.p_m[outer]).mean() > SET_IN_SHARE)


def _lies_in(inner: np.ndarray, outer: np.ndarray, voxels: Voxels, height_m: np.ndarray) -> bool:
    """Whether most of one piece is over the cavity of the other."""
    xyh = np.concatenate([voxels.p_m[:, :2], height_m[:, None]], axis=1)
    span = float((xyh[outer].max(axis=0) - xyh[outer].min(axis=0)).max())
    heights = height_map(xyh[outer], max(span / 32, 1e-4))
    cavity = find_height_map_cavity(heights)
    if cavity is None:
        return False
    return bool(cavity.mask[heights.cells(xyh[inner])].mean() > 0.7)
