"""The default segmenter: no weights, only geometry and colour.

Things are what stands on the largest level plane and hangs together, cut where colour or shape
says that two things touch. Where one thing ends and the next begins is decided by thresholds, and a
grid that lies a little differently decides otherwise: so the segmenter looks several times, with
voxels of other sizes, and what it finds again most times is a thing (as Matas et al. 2002 choose
regions that stay when a threshold moves).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bridge.geometry import se3
from twin.naming.colours import colour_name, lab_from_srgb, without_shading
from twin.scene.gaussians import GaussianCloud
from twin.scene.semantics.cluster import (
    SurfacePoints,
    Voxels,
    components,
    extents_m,
    make_voxels,
    neighbour_pairs,
    pairs_among,
    split_by_colour,
    split_by_valleys,
    within_outline,
)
from twin.scene.semantics.patches import REACH_VOXELS, VOXEL_M, cut_into_patches
from twin.scene.semantics.shape_descriptors import measure_shape
from twin.scene.semantics.support import (
    NoSupportError,
    SupportPlane,
    as_measured,
    find_support,
    no_support,
    roughness_m,
)

SOURCE = "default segmenter"
MIN_FRAGMENT = 8
"""Voxels of the smallest fragment that may be joined to a thing."""
PLANE_COLOURS = 0.75
"""This share of the plane's points says how much its colour varies."""
FLOOR_M2, FURNITURE = 2.5, 3.0
"""A larger plane is a floor, and what stands on it may be so many times larger than on a table."""
VOXEL_SCALES = (1.0, 1.2, 1.45)
"""Of the voxels that the spacing of the points asks for."""
SAME_IOU = 0.6
"""Two things are one when they share this much of their union."""
MAX_TAKEN = 0.3
"""Share of a thing that a stabler one may have."""


ROUGHNESS_FACTOR = 3.0
"""Things are higher over the plane than so many times its roughness, as it was measured."""
FINEST_VOXEL_M = 0.004
"""Size of the voxels that hang together; grows with the spacing of the points."""
MIN_VOXELS = 25
"""Smaller groups are noise."""
MIN_SIZE_M = 0.012
"""Things have at least this extent in two directions."""
PLANE_COLOUR_GAP = 12.0
"""Lab distance up to which a colour is the plane's."""
RELIEF_SCORE = 0.25
"""What rises so little (``Thing.score``) and has the plane's own colour is the plane: noise of its
depth, not a thing. So is a flat thing of exactly the plane's colour."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What is taken for a thing over one plane."""

    min_height_m: float = 0.007
    max_height_m: float = 0.6
    """Higher points belong to the surroundings."""
    max_size_m: float = 0.45
    """Larger groups are furniture, the robot, a wall."""


@dataclass(frozen=True, kw_only=True)
class Thing:
    """One thing the default segmenter found."""

    label: str
    """Colour and shape, for example "red cube"."""
    score: float
    """Share of its points that are firmly above the plane, 0..1."""


@dataclass(frozen=True, kw_only=True)
class Segmentation:
    """Things among points."""

    labels: Int[np.ndarray, " num_points"]
    """Index of the thing plus one; 0 is the background."""
    things: tuple[Thing, ...]
    """Largest first."""
    plane: SupportPlane | None
    """What they stand on; None where nothing level was measured."""
    remark: str
    """Why nothing was found; empty otherwise."""


Look = tuple[Int[np.ndarray, " num_points"], float]
"""What belongs together, seen with voxels of one size: index of each point's thing plus one, the
largest first, 0 is the background; and the size of the cells in which their shape is measured."""


def segment(points: SurfacePoints) -> Segmentation:
    """Find the things that most sizes of voxels find, the largest first."""
    ground: OverPlane | WithoutPlane
    try:
        ground = OverPlane(points, find_support(points))
    except NoSupportError:
        ground = WithoutPlane(points)
    looks = [ground.look(scale) for scale in VOXEL_SCALES]
    kept = stable(looks)
    labels = np.zeros(len(points), dtype=np.int64)
    for number, (mask, _) in enumerate(kept, start=1):
        labels[mask] = number
    things = tuple(ground.thing(mask, voxel_m) for mask, voxel_m in kept)
    remark = "" if things else ground.nothing
    if not things and looks[0][0].any():
        remark = f"of what stands out, no two of {len(looks)} sizes of voxels find the same"
    return Segmentation(labels=labels, things=things, plane=ground.plane, remark=remark)


def stable(looks: Sequence[Look]) -> list[tuple[Bool[np.ndarray, " num_points"], float]]:
    """What at least half the other looks find again, with the voxels it was found with."""
    found = []
    for labels, voxel_m in looks:
        others = [other for other, _ in looks if other is not labels]
        for number in range(1, int(labels.max(initial=0)) + 1):
            mask = labels == number
            best = np.array([_best_iou(mask, other) for other in others])
            share = float((best >= SAME_IOU).mean())
            if share >= 0.5:
                found.append((share + float(best.mean()), mask, voxel_m))
    kept: list[tuple[np.ndarray, float]] = []
    taken = np.zeros(len(looks[0][0]), dtype=bool)
    for _, mask, voxel_m in sorted(found, key=lambda item: -item[0]):
        if taken[mask].mean() <= MAX_TAKEN:
            kept.append((mask & ~taken, voxel_m))
            taken |= mask
    return sorted(kept, key=lambda pair: -int(pair[0].sum()))


def _best_iou(mask: np.ndarray, labels: np.ndarray) -> float:
    sizes = np.bincount(labels)
    shared = np.bincount(labels[mask], minlength=len(sizes))
    return float((shared / (mask.sum() + sizes - shared))[1:].max(initial=0.0))


class OverPlane:
    """Points on a level plane, with all that does not depend on the size of voxels."""

    def __init__(self, points: SurfacePoints, plane: SupportPlane) -> None:
        """Measure heights, and choose what is free to be a thing."""
        plane, usual = as_measured(plane, points), Limits()
        least = max(usual.min_height_m, ROUGHNESS_FACTOR * roughness_m(points, plane))
        self._is_rough = least > usual.min_height_m
        large = FURNITURE if plane.area_m2 > FLOOR_M2 else 1.0
        self._limits = limits = Limits(
            min_height_m=least,
            max_height_m=large * usual.max_height_m,
            max_size_m=large * usual.max_size_m,
        )
        self._points, self.plane = points, plane
        self._height = height = plane.height_m(points.p_m)
        under = plane.under(points.p_m)
        self._lab = without_shading(lab_from_srgb(points.colors))
        free = under & (height < limits.max_height_m)
        raised = free & (height > limits.min_height_m)
        self._low = free & (np.abs(height) <= limits.min_height_m)
        self._above = np.flatnonzero(raised)
        self._voxel_m = max(FINEST_VOXEL_M, 2.0 * _spacing(points.p_m[self._above]))

    @property
    def nothing(self) -> str:
        """Why no thing was found, where none was."""
        z_m = self.plane.offset_m / self.plane.normal[2]
        return (
            f"nothing stands on the level plane at z = {z_m:.3f} m "
            f"({len(self._above)} points above it, none hang together as a thing of 1 to 45 cm)"
        )

    def look(self, scale: float) -> Look:
        """Group them, with voxels so many times as large as their spacing asks for."""
        points, height, above, limits = self._points, self._height, self._above, self._limits
        voxel_m = scale * self._voxel_m
        labels = np.zeros(len(points), dtype=np.int64)
        labels[above] = _things(points.take(above), height[above], voxel_m, limits)
        labels = _largest_first(labels)
        _add_floors(labels, points.p_m, self._lab, self._low)
        labels = _without_relief(labels, self._lab, self._low, height, limits)
        return labels, voxel_m

    def thing(self, mask: Bool[np.ndarray, " num_points"], voxel_m: float) -> Thing:
        """Describe the points of one thing."""
        mine, height = self._points.take(mask), self._height[mask]
        return _thing(mine, height, voxel_m, self._limits, self._is_rough)


class WithoutPlane:
    """Points where nothing level was measured, a shelf of bare metal: all of it is cut."""

    plane = None

    def __init__(self, points: SurfacePoints) -> None:
        """Measure how far points lie apart."""
        self._points, self._spacing_m = points, _spacing(points.p_m)
        self.nothing = no_support(points)

    def look(self, scale: float) -> Look:
        """Cut them, with voxels so many times as large as their spacing asks for."""
        labels = cut_into_patches(self._points, self._spacing_m, scale)
        return _largest_first(labels), VOXEL_M

    def thing(self, mask: Bool[np.ndarray, " num_points"], voxel_m: float) -> Thing:
        """Describe the points of one thing."""
        mine = self._points.take(mask)
        height = mine.p_m[:, 2] - float(np.quantile(mine.p_m[:, 2], 0.01))
        return _thing(mine, height, voxel_m, Limits(), rough=True)


def _spacing(p_m: np.ndarray) -> float:
    """Median distance to the nearest other point."""
    if len(p_m) < 3:
        return 0.0
    some = p_m[:: max(1, len(p_m) // 2000)]
    distance, _ = cKDTree(p_m).query(some, k=2)
    return float(np.median(distance[:, 1]))


def _things(
    points: SurfacePoints, height_m: np.ndarray, voxel_m: float, limits: Limits
) -> np.ndarray:
    """Number the things among points above the plane from 1; 0 is none."""
    if len(points) < MIN_VOXELS:
        return np.zeros(len(points), dtype=np.int64)
    voxels = make_voxels(points, voxel_m)
    height = np.bincount(voxels.of_point, weights=height_m) / voxels.count
    pairs = neighbour_pairs(voxels.p_m, REACH_VOXELS * voxel_m)
    labels = np.zeros(len(voxels), dtype=np.int64)
    groups = branches(
        voxels.p_m,
        height,
        pairs,
        voxel_m=voxel_m,
        max_size_m=limits.max_size_m,
        min_voxels=MIN_FRAGMENT,
    )
    pieces: list[np.ndarray] = []
    for ids in groups:
        pieces += _pieces(voxels, ids, height, pairs, voxel_m)
    found = 0
    for piece in pieces:
        extent = extents_m(voxels.p_m[piece])
        stands = np.quantile(height[piece], 0.03) < limits.max_height_m / 3
        if stands and len(piece) >= MIN_VOXELS and extent[1] >= MIN_SIZE_M:
            found += 1
            labels[piece] = found
    return np.asarray(labels[voxels.of_point])


def _pieces(
    voxels: Voxels, ids: np.ndarray, height_m: np.ndarray, pairs: np.ndarray, voxel_m: float
) -> list[np.ndarray]:
    """Cut one connected group by colour, and each piece of it along valleys."""
    pieces = []
    group, group_pairs = _within(voxels, ids, pairs)
    colours = split_by_colour(group, height_m[ids], group_pairs)
    for colour in range(int(colours.max()) + 1):
        part = ids[colours == colour]
        own, own_pairs = _within(voxels, part, pairs)
        cut = split_by_valleys(own, height_m[part], own_pairs, voxel_m)
        pieces += [part[cut == number] for number in range(int(cut.max()) + 1)]
    return pieces


def _within(voxels: Voxels, ids: np.ndarray, pairs: np.ndarray) -> tuple[Voxels, np.ndarray]:
    """Some voxels, and the pairs among them in their own numbering."""
    part = Voxels(
        p_m=voxels.p_m[ids],
        normals=voxels.normals[ids],
        lab=voxels.lab[ids],
        count=voxels.count[ids],
        of_point=np.zeros(0, dtype=np.int64),
    )
    return part, pairs_among(ids, pairs, len(voxels))


def _largest_first(labels: np.ndarray) -> np.ndarray:
    counts = np.bincount(labels, minlength=1)[1:]
    order = np.argsort(-counts, kind="stable")
    rank = np.zeros(len(counts) + 1, dtype=np.int64)
    rank[order + 1] = np.arange(1, len(counts) + 1)
    return np.asarray(rank[labels])


def _add_floors(
    labels: Int[np.ndarray, " num_points"],
    p_m: Float[np.ndarray, "num_points 3"],
    lab: Float[np.ndarray, "num_points 3"],
    low: Bool[np.ndarray, " num_points"],
) -> None:
    """Give low points to the thing around them whose colour they have and the plane has not."""
    free = np.flatnonzero(low & (labels == 0))
    if not len(free):
        return
    to_plane = np.linalg.norm(lab[free] - np.median(lab[free], axis=0), axis=1)
    for number in range(1, int(labels.max(initial=0)) + 1):
        mine = labels == number
        to_thing = np.linalg.norm(lab[free] - np.median(lab[mine], axis=0), axis=1)
        clear = (to_thing < PLANE_COLOUR_GAP) & (to_thing < 0.5 * to_plane)
        clear[clear] = within_outline(p_m[free[clear]], p_m[mine])
        labels[free[clear]] = number


def _without_relief(
    labels: Int[np.ndarray, " num_points"],
    lab: Float[np.ndarray, "num_points 3"],
    low: Bool[np.ndarray, " num_points"],
    height_m: np.ndarray,
    limits: Limits,
) -> Int[np.ndarray, " num_points"]:
    """Give back to the plane what hardly rises above it and looks like it."""
    plane = low & (labels == 0)
    if not plane.any():
        return labels
    middle = np.median(lab[plane], axis=0)
    own = float(np.quantile(np.linalg.norm(lab[plane] - middle, axis=1), PLANE_COLOURS))
    kept = np.zeros_like(labels)
    for number in range(1, int(labels.max(initial=0)) + 1):
        mine = labels == number
        away = float(np.linalg.norm(np.median(lab[mine], axis=0) - middle))
        is_flat = _firmness(height_m[mine], limits) < RELIEF_SCORE
        if not (is_flat and away < max(own, PLANE_COLOUR_GAP)):
            kept[mine] = kept.max() + 1
    return kept


def _firmness(height_m: np.ndarray, limits: Limits) -> float:
    """Share of points that noise of the plane does not explain."""
    return float((height_m > 2 * limits.min_height_m).mean())


def _thing(
    points: SurfacePoints, height_m: np.ndarray, voxel_m: float, limits: Limits, rough: bool
) -> Thing:
    xyh = np.concatenate([points.p_m[:, :2], height_m[:, None]], axis=1)
    shape = measure_shape(xyh, voxel_m, rough=rough)
    color = np.median(points.colors, axis=0).astype(np.float64)
    score = _firmness(height_m, limits)
    return Thing(label=f"{colour_name(color)} {shape.word}", score=score)


LEVELS_M = (0.012, 0.018, 0.026, 0.036, 0.05, 0.07)
"""Heights over the plane at which a group that is too large is looked at again."""
BESIDE = 1.2
"""Voxels this near to a branch, seen from above, lie below it."""
BELOW = 2.0
"""And no higher over its lowest voxel than so many voxels."""


def branches(
    p_m: Float[np.ndarray, "num_voxels 3"],
    height_m: Float[np.ndarray, " num_voxels"],
    pairs: Int[np.ndarray, "num_pairs 2"],
    *,
    voxel_m: float,
    max_size_m: float,
    min_voxels: int,
) -> list[Int[np.ndarray, " num_members"]]:
    """Groups of connected voxels that are small enough; what no level parts is left out.

    Low down things hang together, as papers under mugs do. The groups are the branches of the tree
    of components over rising levels, cut where they first are small enough (Jones 1999 on component
    trees). What lies below a branch belongs to it.
    """
    groups: list[np.ndarray] = []
    group = components(len(p_m), pairs)
    large = np.flatnonzero(np.bincount(group, minlength=1) >= min_voxels)
    todo: list[tuple[np.ndarray, tuple[float, ...]]]
    todo = [(np.flatnonzero(group == number), LEVELS_M) for number in large]
    while todo:
        ids, levels = todo.pop(0)
        if extents_m(p_m[ids])[0] <= max_size_m:
            groups.append(ids)
            continue
        parts, left = _parted(ids, p_m, height_m, pairs, levels, max_size_m, min_voxels)
        todo[:0] = [(part, left) for part in parts]
    return _with_what_lies_below(groups, p_m, height_m, voxel_m)


def _parted(
    ids: np.ndarray,
    p_m: np.ndarray,
    height_m: np.ndarray,
    pairs: np.ndarray,
    levels_m: Sequence[float],
    max_size_m: float,
    min_voxels: int,
) -> tuple[list[np.ndarray], tuple[float, ...]]:
    """What is left of a group above the lowest level that parts it, and the levels above that."""
    for place, level_m in enumerate(levels_m):
        high = ids[height_m[ids] > level_m]
        if len(high) < min_voxels:
            break
        group = components(len(high), pairs_among(high, pairs, len(p_m)))
        parts = [high[group == n] for n in np.flatnonzero(np.bincount(group) >= min_voxels)]
        if len(parts) > 1 or (parts and extents_m(p_m[parts[0]])[0] <= max_size_m):
            return parts, tuple(levels_m[place + 1 :])
    return [], ()


def _with_what_lies_below(
    groups: list[np.ndarray], p_m: np.ndarray, height_m: np.ndarray, voxel_m: float
) -> list[np.ndarray]:
    """Each group with the voxels below it that are nobody's; the first group comes first."""
    owner = np.full(len(p_m), -1, dtype=np.int64)
    for number, ids in enumerate(groups):
        owner[ids] = number
    for number, ids in enumerate(groups):
        free = np.flatnonzero(owner < 0)
        free = free[height_m[free] < height_m[ids].min() + BELOW * voxel_m]
        if len(free):
            beside, _ = cKDTree(p_m[ids, :2]).query(
                p_m[free, :2], distance_upper_bound=BESIDE * voxel_m
            )
            owner[free[np.isfinite(beside)]] = number
    return [np.flatnonzero(owner == number) for number in range(len(groups))]


MIN_OPACITY = 0.3
MAX_SPLAT_M = 0.04
"""Larger Gaussians are walls or fog."""


def solid_splats(cloud: GaussianCloud) -> np.ndarray:
    """Which Gaussians are surface: opaque and small."""
    small = np.exp(cloud.scales_log.max(axis=1)) < MAX_SPLAT_M if len(cloud) else np.zeros(0, bool)
    return np.asarray((cloud.opacities() > MIN_OPACITY) & small)


def points_of(cloud: GaussianCloud) -> SurfacePoints:
    """Gaussians as surface points: the normal is the thinnest axis.

    The initialisation turns the third axis towards the camera; where another axis became the
    thinnest, upwards is the better guess.
    """
    if len(cloud) == 0:
        none = np.zeros((0, 3))
        return SurfacePoints(p_m=none, normals=none, colors=none)
    R = se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))
    thinnest = cloud.scales_log.argmin(axis=1)
    normals = np.take_along_axis(R, thinnest[:, None, None], axis=2)[:, :, 0]
    unsure = (thinnest != 2) & (normals[:, 2] < 0)
    normals[unsure] *= -1
    return SurfacePoints(
        p_m=cloud.means_m.astype(np.float64),
        normals=normals,
        colors=np.clip(cloud.colors, 0.0, 1.0).astype(np.float64),
    )
