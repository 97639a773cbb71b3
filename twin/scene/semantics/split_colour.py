"""Cut things that touch where their colours differ."""

import numpy as np
from jaxtyping import Float, Int

from twin.scene.semantics.cluster import Voxels, components, means_of, numbered
from twin.scene.semantics.colour import without_shading
from twin.scene.semantics.form import find_cavity, height_map
from twin.scene.semantics.split import SplitConfig


def split_by_colour(
    voxels: Voxels,
    height_m: Float[np.ndarray, " num_voxels"],
    pairs: Int[np.ndarray, "num_pairs 2"],
    config: SplitConfig,
) -> Int[np.ndarray, " num_voxels"]:
    """Number the pieces of one connected group that differ in colour.

    k-means in Lab for k = 1.. with a Schwarz criterion whose noise has a floor; then connected
    pieces of one colour. A piece much smaller than its neighbour is a marking (a beak, a label)
    and joins it, unless it lies in the neighbour's cavity.
    """
    colour = without_shading(voxels.lab, config.lightness_weight)
    classes = _colour_classes(colour, config)
    if classes.max(initial=0) == 0:
        return classes
    same = classes[pairs[:, 0]] == classes[pairs[:, 1]]
    pieces = components(len(voxels), pairs[same])
    while True:
        small = _smallest_marking(pieces, voxels, height_m, pairs, colour, config)
        if small is None:
            return numbered(pieces)
        pieces = np.where(pieces == small[0], small[1], pieces)


def _colour_classes(colour: np.ndarray, config: SplitConfig) -> np.ndarray:
    samples = max(config.samples_per_voxel * len(colour), 2.0)
    best, best_cost = np.zeros(len(colour), dtype=np.int64), np.inf
    for num in range(1, config.max_colours + 1):
        classes, centres = _k_means(colour, num)
        if num > 1 and _closest(centres) < config.min_colour_gap:
            continue
        spread = np.square(colour - centres[classes]).sum(axis=1).mean() / 3
        variance = max(float(spread), config.colour_noise**2)
        cost = 3 * samples * np.log(variance) + 4 * num * np.log(samples)
        if cost < best_cost - 1e-9:
            best, best_cost = classes, float(cost)
    return best


def _closest(centres: np.ndarray) -> float:
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    return float(gaps[np.triu_indices(len(centres), 1)].min())


def _k_means(values: np.ndarray, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Lloyd's iteration from the farthest points, so that the result needs no seed."""
    centres = [np.median(values, axis=0)]
    for _ in range(1, num):
        gap = np.min([np.square(values - c).sum(axis=1) for c in centres], axis=0)
        # Not the very farthest: a few mixed voxels at an edge should not seed a colour.
        centres.append(values[np.argsort(gap, kind="stable")[int(0.98 * (len(gap) - 1))]])
    middle = np.array(centres)
    classes = np.zeros(len(values), dtype=np.int64)
    for _ in range(20):
        classes = np.square(values[:, None] - middle[None]).sum(axis=2).argmin(axis=1)
        filled = np.bincount(classes, minlength=num) > 0
        moved = np.where(filled[:, None], means_of(values, classes, num), middle)
        if np.allclose(moved, middle, atol=1e-3):
            break
        middle = moved
    return classes, middle


def _smallest_marking(
    pieces: np.ndarray,
    voxels: Voxels,
    height_m: np.ndarray,
    pairs: np.ndarray,
    colour: np.ndarray,
    config: SplitConfig,
) -> tuple[int, int] | None:
    """The smallest piece that is no thing of its own, and the neighbour it belongs to."""
    counts = np.bincount(pieces)
    for piece in np.argsort(counts, kind="stable"):
        if counts[piece] == 0:
            continue
        neighbours = _neighbours(pieces, pairs, int(piece))
        if not len(neighbours):
            continue
        own = colour[pieces == piece].mean(axis=0)
        gaps = [np.linalg.norm(own - colour[pieces == other].mean(axis=0)) for other in neighbours]
        largest = int(neighbours[np.argmax(counts[neighbours])])
        if min(gaps) < config.min_colour_gap:
            return int(piece), int(neighbours[int(np.argmin(gaps))])
        if counts[piece] >= config.min_piece_fraction * counts[largest]:
            continue
        if counts[piece] >= 20 and _lies_in(pieces == piece, pieces == largest, voxels, height_m):
            continue
        return int(piece), largest
    return None


def _neighbours(pieces: np.ndarray, pairs: np.ndarray, piece: int) -> np.ndarray:
    a, b = pieces[pairs[:, 0]], pieces[pairs[:, 1]]
    return np.unique(
        np.concatenate([b[(a == piece) & (b != piece)], a[(b == piece) & (a != piece)]])
    )


def _lies_in(inner: np.ndarray, outer: np.ndarray, voxels: Voxels, height_m: np.ndarray) -> bool:
    """Whether most of one piece is over the cavity of the other."""
    xyh = np.concatenate([voxels.p_m[:, :2], height_m[:, None]], axis=1)
    span = float((xyh[outer].max(axis=0) - xyh[outer].min(axis=0)).max())
    heights = height_map(xyh[outer], max(span / 32, 1e-4))
    cavity = find_cavity(heights)
    if cavity is None:
        return False
    return bool(cavity.mask[heights.cells(xyh[inner])].mean() > 0.7)
