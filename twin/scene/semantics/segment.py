"""The default segmenter: no weights, only geometry and colour.

Things are what stands on the largest level plane, or before walls, cut where colour and shape say
that two touch (``patches``). Where one thing ends and the next begins is decided by thresholds, and
a grid that lies a little differently decides otherwise: so the segmenter looks several times, with
voxels of other sizes, and what it finds again most times is a thing (as Matas et al. 2002 choose
regions that stay when a threshold moves).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from twin.naming.colours import colour_name, lab_from_srgb, main_colour, without_shading
from twin.scene.semantics.patches import cut_into_patches, within_outline
from twin.scene.semantics.points import SurfacePoints
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
PLANE_COLOURS = 0.75
"""This share of the plane's points says how much its colour varies."""
FLOOR_M2, FURNITURE = 2.5, 3.0
"""A larger plane is a floor, and what stands on it may be so many times larger than on a table."""
HIDDEN_M = 0.12
"""Half the width of what hides the plane behind it, on a table."""
VOXEL_SCALES = (1.0, 1.2, 1.45)
"""Of the voxels that the spacing of the points asks for."""
SAME_IOU = 0.6
"""Two things are one when they share this much of their union."""
MAX_TAKEN = 0.3
"""Share of a thing that a stabler one may have."""
FACES_DOWN, MOSTLY, LAYER_M = -0.3, 1 / 3, 0.02
"""z of normals that a camera above seldom sees, and the share of a layer of a thing from which it
is the thing's image in a shining floor."""
ROUGHNESS_FACTOR = 3.0
"""Things are higher over the plane than so many times its roughness, as it was measured."""
FINEST_VOXEL_M, WALL_VOXEL_M = 0.004, 0.008
"""Size of the voxels on a plane and before walls; grows with the spacing of the points."""
MIN_HEIGHT_M, MAX_HEIGHT_M = 0.007, 0.6
"""What is taken for a thing over a table; higher points belong to the surroundings."""
PLANE_COLOUR_GAP = 12.0
"""Lab distance up to which a colour is the plane's."""
RELIEF_SCORE = 0.25
"""What rises so little (``Thing.score``) and has the plane's own colour is the plane: noise of its
depth, not a thing. So is a flat thing of exactly the plane's colour."""


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
        plane = as_measured(plane, points)
        rough_m = ROUGHNESS_FACTOR * roughness_m(points, plane)
        self._is_rough, self._least_m = rough_m > MIN_HEIGHT_M, max(MIN_HEIGHT_M, rough_m)
        self._furniture = FURNITURE if plane.area_m2 > FLOOR_M2 else 1.0
        self._points, self.plane = points, plane
        self._height = height = plane.height_m(points.p_m)
        self._lab = without_shading(lab_from_srgb(points.colors))
        around = plane.behind_things(self._furniture * HIDDEN_M)
        free = around.under(points.p_m) & (height < self._furniture * MAX_HEIGHT_M)
        self._low = free & (np.abs(height) <= self._least_m)
        self._above = np.flatnonzero(free & (height > self._least_m))
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
        points, height, above = self._points, self._height, self._above
        voxel_m = scale * self._voxel_m
        labels = np.zeros(len(points), dtype=np.int64)
        labels[above] = cut_into_patches(
            points.take(above), voxel_m, height[above], self._furniture
        )
        labels = _largest_first(labels)
        _add_floors(labels, points.p_m, self._lab, self._low)
        return _without_relief(labels, self._lab, self._low, height, self._least_m), voxel_m

    def thing(self, mask: Bool[np.ndarray, " num_points"], voxel_m: float) -> Thing:
        """Describe the points of one thing."""
        mine, height = self._points.take(mask), self._height[mask]
        return _thing(mine, height, voxel_m, self._least_m, self._is_rough)


class WithoutPlane:
    """Points where nothing level was measured, a shelf of bare metal: all of it is cut."""

    plane = None

    def __init__(self, points: SurfacePoints) -> None:
        """Measure how far points lie apart."""
        self._points, self._voxel_m = points, max(WALL_VOXEL_M, 2.0 * _spacing(points.p_m))
        self.nothing = no_support(points)

    def look(self, scale: float) -> Look:
        """Cut them, with voxels so many times as large as their spacing asks for."""
        labels = _largest_first(cut_into_patches(self._points, scale * self._voxel_m))
        for number in range(1, int(labels.max(initial=0)) + 1):
            labels[self._mirrored(np.flatnonzero(labels == number))] = 0
        return labels, WALL_VOXEL_M

    def _mirrored(self, ids: Int[np.ndarray, " num_mine"]) -> Int[np.ndarray, " num_mirrored"]:
        """Of a thing's points those that metal under it mirrors: its lowest layers face down."""
        height = self._points.p_m[ids, 2]
        layer = ((height - height.min()) / LAYER_M).astype(np.int64)
        down = self._points.normals[ids, 2] < FACES_DOWN
        count, num_down = np.bincount(layer), np.bincount(layer, weights=down)
        return np.asarray(ids[layer < int(np.argmax(num_down < MOSTLY * count))])

    def thing(self, mask: Bool[np.ndarray, " num_points"], voxel_m: float) -> Thing:
        """Describe the points of one thing."""
        mine = self._points.take(mask)
        height = mine.p_m[:, 2] - float(np.quantile(mine.p_m[:, 2], 0.01))
        return _thing(mine, height, voxel_m, MIN_HEIGHT_M, rough=True)


def _spacing(p_m: np.ndarray) -> float:
    """Median distance to the nearest other point."""
    if len(p_m) < 3:
        return 0.0
    some = p_m[:: max(1, len(p_m) // 2000)]
    distance, _ = cKDTree(p_m).query(some, k=2)
    return float(np.median(distance[:, 1]))


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
    least_m: float,
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
        is_flat = _firmness(height_m[mine], least_m) < RELIEF_SCORE
        if not (is_flat and away < max(own, PLANE_COLOUR_GAP)):
            kept[mine] = kept.max() + 1
    return kept


def _firmness(height_m: np.ndarray, least_m: float) -> float:
    """Share of points that noise of the plane does not explain."""
    return float((height_m > 2 * least_m).mean())


def _thing(
    points: SurfacePoints, height_m: np.ndarray, voxel_m: float, least_m: float, rough: bool
) -> Thing:
    xyh = np.concatenate([points.p_m[:, :2], height_m[:, None]], axis=1)
    shape = measure_shape(xyh, voxel_m, rough=rough)
    score = _firmness(height_m, least_m)
    return Thing(label=f"{colour_name(main_colour(points.colors))} {shape.word}", score=score)
