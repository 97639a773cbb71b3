"""Masks of what does not belong to the static scene: what moved, and what moves with a camera.

Moving things (a robot, a hand, an object) show as a surface in a few frames, while other frames
measure something farther behind it. No model of the robot is needed; what never moves, such as the
robot's base, is static.

The ego mask is what is fixed to a camera whose robot is not known by joints, such as a gripper
before a wrist camera. While the camera scans, the scene runs through its image and these pixels
stay: their edges point the same way in all frames and their brightness follows the exposure only.
An edge along the camera's path, or the point a camera circles around, does so too: where depth was
measured, other frames say whether it stood still in the scene, and then it counts as scene. No
held-out frame is looked at.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bridge.geometry import se3
from twin.scene.frames.camera_poses import same_pose
from twin.scene.frames.downscaled import pixels_of
from twin.scene.frames.rgbd import PointSet, TrainingView
from twin.scene.frames.selection import spread

VOXEL_M = 0.02
"""Points are judged in groups of this size."""
MARGIN_M = 0.03
MARGIN_FRACTION = 0.02
"""A measurement must lie this much behind a point to have passed it."""
MAX_REFERENCE_VIEWS = 40
"""Frames that are asked; more only cost time."""
MIN_THROUGH = 2
MIN_THROUGH_IN_TURN = 4
"""What some frames of a scan confirm and at least so many look through, all later or all earlier,
came or went, however long it stood there."""
MIN_REGION_VOXELS = 8
"""Fewer connected ones are noise, or too small to say."""
OUTLINE_PX = 3
"""Poses and depth are noisy: closer to a nearer surface than this, at half size, nobody knows."""
MOVING_GROW_PX = 2
"""Masks grow by this much at half size, because depth fails along outlines."""
INDEX_BITS = 20


@dataclass(frozen=True, kw_only=True)
class MovingVoxels:
    """Where something was that is not part of the static scene."""

    keys: Int64[np.ndarray, " num_voxels"]

    def largest_place(self) -> str:
        """Size and middle of the largest connected group of these voxels; empty for noise."""
        shifts = np.array([2 * INDEX_BITS, INDEX_BITS, 0])
        packed = (self.keys[:, None] >> shifts) & ((1 << INDEX_BITS) - 1)
        cells = packed - (1 << (INDEX_BITS - 1))
        if not len(cells):
            return ""
        pairs = cKDTree(cells).query_pairs(1.8, output_type="ndarray")  # corners touch, too
        links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cells), len(cells)))
        _, labels = connected_components(links, directed=False)
        sizes = np.bincount(labels)
        if sizes.max() < MIN_REGION_VOXELS:
            return ""
        mine = cells[labels == sizes.argmax()] * VOXEL_M
        low, high = mine.min(axis=0), mine.max(axis=0) + VOXEL_M
        size = " x ".join(f"{100 * side:.0f}" for side in high - low)
        return f"{size} cm around ({', '.join(f'{side:.2f}' for side in (low + high) / 2)}) m"

    def contains(self, p_m: Float32[np.ndarray, "num_points 3"]) -> Bool[np.ndarray, " num_points"]:
        """Say which points (root frame, metres) belong to something that moved."""
        return np.isin(_keys(p_m), self.keys)

    def mask_in(self, view: TrainingView) -> TrainingView:
        """Mark the pixels that show something moving, so that the fit passes them over."""
        if not len(self.keys):
            return view
        half = view.half
        known = half.depth_m > 0
        p_camera = half.camera.unproject(half.depth_m)[known]
        hit = np.zeros_like(known)
        hit[known] = self.contains(se3.apply(view.T_base_color, p_camera).astype(np.float32))
        around = np.ones((2 * MOVING_GROW_PX + 1, 2 * MOVING_GROW_PX + 1), dtype=bool)
        return view.without(ndimage.binary_dilation(hit, around))


@dataclass(frozen=True, kw_only=True)
class ReferenceView:
    """What one training frame can say about other frames' points."""

    view: TrainingView
    scan: int = 0
    """Frames of one scan are compared in the order of their time, those of several are not."""

    @cached_property
    def nearest_m(self) -> Float32[np.ndarray, "height width"]:
        """Smallest measurement within a few pixels: beside an outline nothing counts as passed."""
        depth_m = self.view.half.depth_m
        nearest = np.where(depth_m > 0, depth_m, np.float32(np.inf))
        return np.asarray(ndimage.minimum_filter(nearest, 2 * OUTLINE_PX + 1, mode="nearest"))

    def look_through(
        self, p_base: Float[np.ndarray, "num_points 3"]
    ) -> tuple[Bool[np.ndarray, " num_points"], Bool[np.ndarray, " num_points"]]:
        """Say which points it looks through, and which it sees where they should be."""
        p_camera = se3.apply(se3.invert(self.view.T_base_color), p_base)
        row, column, inside = pixels_of(self.view.half.camera, p_camera)
        z = p_camera[:, 2]
        inside &= z > MARGIN_M
        measured, nearest = np.zeros(len(p_base)), np.zeros(len(p_base))
        measured[inside] = self.view.half.depth_m[row[inside], column[inside]]
        nearest[inside] = self.nearest_m[row[inside], column[inside]]
        margin = MARGIN_M + MARGIN_FRACTION * z
        known = measured > 0
        return known & (nearest > z + margin), known & (np.abs(measured - z) <= margin)


def choose_reference_views(
    views: Sequence[TrainingView], scans: Sequence[int] | None = None
) -> list[ReferenceView]:
    """Take training frames spread evenly; their depth images are compared with.

    Args:
        scans: Which scan each is of; all of one without it.
    """
    step = max(1, -(-len(views) // MAX_REFERENCE_VIEWS))
    of_scan = [0] * len(views) if scans is None else scans
    return [
        ReferenceView(view=view, scan=scan)
        for view, scan in zip(views[::step], of_scan[::step], strict=True)
    ]


def find_moving(points: Sequence[PointSet], references: Sequence[ReferenceView]) -> MovingVoxels:
    """Find voxels that more frames look through than confirm, or first one, then the other."""
    p = np.concatenate([item.p_m for item in points])
    keys, inverse, counts = np.unique(_keys(p), return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(inverse, weights=c) / counts for c in p.T], axis=1)
    through = np.zeros(len(keys), dtype=np.int32)
    confirmed = np.zeros(len(keys), dtype=np.int32)
    in_turn = np.zeros(len(keys), dtype=bool)
    for scan in sorted({reference.scan for reference in references}):
        votes = _Votes(len(keys))
        mine = [reference for reference in references if reference.scan == scan]
        for reference in sorted(mine, key=lambda reference: reference.view.stamp_ns):
            votes.add(*reference.look_through(means))
        through += votes.through
        confirmed += votes.confirmed
        in_turn |= votes.in_turn()
    return MovingVoxels(keys=keys[((through >= MIN_THROUGH) & (through > confirmed)) | in_turn])


class _Votes:
    """How often voxels were looked through and confirmed, and in which order."""

    def __init__(self, count: int) -> None:
        self.through, self.confirmed = (np.zeros(count, dtype=np.int32) for _ in range(2))
        self._asked = 0
        self._first = np.full((2, count), np.iinfo(np.int32).max, dtype=np.int32)
        self._last = np.full((2, count), -1, dtype=np.int32)

    def add(self, passed: np.ndarray, met: np.ndarray) -> None:
        """What the next frame says of each."""
        self.through += passed
        self.confirmed += met
        for row, voted in enumerate((passed, met)):
            self._first[row, voted] = np.minimum(self._first[row, voted], self._asked)
            self._last[row, voted] = self._asked
        self._asked += 1

    def in_turn(self) -> Bool[np.ndarray, " num_voxels"]:
        """Which were there only until others looked through them, or only afterwards."""
        left, came = self._last[1] < self._first[0], self._last[0] < self._first[1]
        both = (self.through >= MIN_THROUGH_IN_TURN) & (self.confirmed > 0)
        return np.asarray(both & (left | came))


def _keys(p_m: np.ndarray) -> np.ndarray:
    cell = np.floor(p_m / VOXEL_M).astype(np.int64) + (1 << (INDEX_BITS - 1))
    cell = np.clip(cell, 0, (1 << INDEX_BITS) - 1)
    packed = (cell[:, 0] << (2 * INDEX_BITS)) | (cell[:, 1] << INDEX_BITS) | cell[:, 2]
    return np.asarray(packed)


MIN_VIEWS, MAX_VIEWS = 6, 24
"""Views from different places that can tell, and how many are asked."""
APART_M, APART_RAD = 0.02, 0.03
"""Views less far apart than both show the scene at the same place of the image."""
BLUR_PX = 1.0
WINDOW_PX = 5
EDGE_LEVELS = 2.5
"""Mean gradient, in 8-bit levels per pixel at half size, from which there is an edge to judge."""
STRONG_LEVELS = 12.0
"""Stronger gradients count as this: one bright edge that passes by outweighs no other frames."""
PERSISTENT = 0.8
"""Length of the sum of all frames' gradients over the sum of their lengths: 1 for an edge that
stays, about one over the root of the number of frames for one that comes and goes."""
CALM_LEVELS, CALM_SHARE = 6.0, 0.12
"""Spread of brightness that noise explains, fixed and relative."""
REACH = 0.08
"""Even surfaces count as fixed up to this far from an edge that stays, in image heights."""
EVIDENCE_PX, EVIDENCE_STRIDE, EVIDENCE_VIEWS = 5, 2, 12
"""Depth is judged over neighbourhoods of this size, at every second pixel, in so many views."""
MIN_SHARE, MAX_SHARE = 0.002, 0.5
"""Of the image: smaller is chance, larger is a camera that hardly moved."""
EDGE_SHARE = 0.2
"""Of a piece must be edges that stay: an even surface alone could be anything."""
STEADY_VIEWS, STEADY_FRACTION = 3, 0.05
"""A depth that so many views or more measure, and that varies by less, stays."""
REACH_PERCENTILE = 95.0
"""Of the depths that stay in what was found: as far as that it may have more."""
DARK_LEVELS = 8
EGO_GROW_PX = 3
"""Masks grow by this much at half size: what is so near is out of focus and shadows its edge."""


def without_ego(
    points: PointSet, view: TrainingView, mask: Bool[np.ndarray, "half_height half_width"]
) -> tuple[PointSet, TrainingView]:
    """A frame's points without those in an ego mask, and its view with these pixels passed over."""
    p_camera = se3.apply(se3.invert(view.T_base_color), points.p_m.astype(np.float64))
    row, column, inside = pixels_of(view.half.camera, p_camera)
    inside[inside] = mask[row[inside], column[inside]]
    return points.take(~inside), view.without(mask)


def find_ego_mask(views: Sequence[TrainingView]) -> Bool[np.ndarray, "height width"] | None:
    """Find what moves with a camera in the views it took; None when nothing can be said to.

    Pixels of the half-size image.

    Args:
        views: Of one camera; the robot need not be masked in them.
    """
    chosen = _from_other_places(views)
    if len(chosen) < MIN_VIEWS:
        return None
    planes = np.stack([view.half.planes_u8 for view in chosen]).astype(np.float32)
    images = ndimage.gaussian_filter(planes, (0.0, 0.0, BLUR_PX, BLUR_PX))
    stays = _edges_that_stay(images)
    if stays.mean() < MIN_SHARE / 10:
        return None
    near = ndimage.distance_transform_edt(~stays) <= REACH * len(stays)
    found = (stays | (_calm(images, stays) & near)) & ~_stands_in_scene(chosen)
    mask = _solid(found, stays)
    if not MIN_SHARE <= mask.mean() <= MAX_SHARE:
        return None
    mask = mask | _more_of_it(mask, np.stack([view.half.depth_m for view in chosen]))
    return mask if mask.mean() <= MAX_SHARE else None


def find_dark_rim(views: Sequence[TrainingView]) -> Bool[np.ndarray, "height width"] | None:
    """Find what lies beside a fisheye's circle: the corners that are black in all views."""
    halves = [view.half for view in views]
    dark = np.all([(h.planes_u8.max(0) <= DARK_LEVELS) & (h.depth_m <= 0) for h in halves], axis=0)
    pieces, _ = ndimage.label(dark)
    corners = pieces[[0, 0, -1, -1], [0, -1, 0, -1]]
    if (corners == 0).sum() > 1:
        return None
    rim = np.isin(pieces, corners[corners > 0])
    mask = np.asarray(ndimage.binary_dilation(rim, iterations=EGO_GROW_PX), dtype=bool)
    return mask if mask.mean() <= MAX_SHARE else None


def _from_other_places(views: Sequence[TrainingView]) -> list[TrainingView]:
    """Views from places that differ, spread evenly when there are many."""
    kept: list[TrainingView] = []
    for view in views:
        pose = view.T_base_color
        if not any(
            same_pose(pose, other.T_base_color, distance_m=APART_M, angle_rad=APART_RAD)
            for other in kept
        ):
            kept.append(view)
    return [kept[index] for index in spread(np.arange(len(kept)), MAX_VIEWS)]


def _edges_that_stay(
    images: Float32[np.ndarray, "num_views 3 height width"],
) -> Bool[np.ndarray, "height width"]:
    """Places with edges that point the same way in all frames, whatever the exposure."""
    down, right = np.gradient(images, axis=(2, 3))
    strength = np.hypot(down, right)
    shorter = np.minimum(1.0, STRONG_LEVELS / np.maximum(strength, 1e-6))
    down, right, strength = down * shorter, right * shorter, strength * shorter
    length = strength.mean(axis=(0, 1))
    together = np.hypot(down.mean(axis=0), right.mean(axis=0)).mean(axis=0)
    length, together = (ndimage.uniform_filter(item, WINDOW_PX) for item in (length, together))
    return np.asarray((length > EDGE_LEVELS) & (together > PERSISTENT * length))


def _calm(
    images: Float32[np.ndarray, "num_views 3 height width"], stays: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Places whose brightness follows the exposure of the frame and nothing else."""
    grey = images.mean(axis=1)
    middle = np.median(grey, axis=0)
    exposure = [float(np.median(item[stays] / np.maximum(middle[stays], 1.0))) for item in grey]
    levelled = grey / np.maximum(np.array(exposure, dtype=np.float32), 0.1)[:, None, None]
    middle = np.median(levelled, axis=0)
    spread = 1.48 * np.median(np.abs(levelled - middle), axis=0)
    return np.asarray(spread < CALM_LEVELS + CALM_SHARE * middle)


def _stands_in_scene(views: Sequence[TrainingView]) -> Bool[np.ndarray, "height width"]:
    """Pixels whose measured places more of the other frames confirm than look through."""
    through = np.zeros(views[0].half.depth_m.shape, dtype=np.float32)
    confirmed, grid = np.zeros_like(through), np.zeros(through.shape, dtype=bool)
    grid[::EVIDENCE_STRIDE, ::EVIDENCE_STRIDE] = True
    asked = views[:: -(-len(views) // EVIDENCE_VIEWS)]
    references = [ReferenceView(view=view) for view in asked]
    for view in asked:
        known = (view.half.depth_m > 0) & grid
        p_camera = view.half.camera.unproject(view.half.depth_m)[known]
        p_base = se3.apply(view.T_base_color, p_camera)
        for reference in references:
            if reference.view is view:
                continue
            passed, met = reference.look_through(p_base)
            through[known] += passed
            confirmed[known] += met
    window = EVIDENCE_PX
    return np.asarray(
        ndimage.uniform_filter(confirmed, window) > ndimage.uniform_filter(through, window) + 1e-3
    )


def _more_of_it(
    mask: Bool[np.ndarray, "height width"], depth_m: Float32[np.ndarray, "num_views height width"]
) -> Bool[np.ndarray, "height width"]:
    """What wobbles has no edge that stays, but a depth: that of the other masked pixels, or less.

    The scene does not come so near, and where it does, not by the same depth in every view.
    """
    known = depth_m > 0
    measured = np.where(known | ~known.any(axis=0), depth_m, np.nan)
    middle = np.nanmedian(measured, axis=0)
    spread = np.nanmedian(np.abs(measured - middle), axis=0)
    steady = (known.sum(axis=0) >= STEADY_VIEWS) & (spread < STEADY_FRACTION * middle)
    if not (steady & mask).any():
        return np.zeros_like(mask)
    farthest_m = np.percentile(middle[steady & mask], REACH_PERCENTILE)
    like_it = ndimage.binary_closing(mask | (steady & (middle <= farthest_m)), iterations=2)
    pieces, _ = ndimage.label(like_it | mask)
    more = np.isin(pieces, np.unique(pieces[mask])) & ~mask
    return np.asarray(ndimage.binary_dilation(more, iterations=EGO_GROW_PX), dtype=bool)


def _solid(
    found: Bool[np.ndarray, "height width"], stays: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Pieces that are large enough and hold edges that stay, without holes, grown a little."""
    pieces, count = ndimage.label(ndimage.binary_opening(found, iterations=1))
    if count == 0:
        return np.zeros_like(found)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    edges = np.bincount(pieces[stays], minlength=count + 1)
    large = (sizes >= MIN_SHARE * found.size) & (edges >= EDGE_SHARE * sizes)
    large[0] = False
    whole = ndimage.binary_fill_holes(large[pieces])
    return np.asarray(ndimage.binary_dilation(whole, iterations=EGO_GROW_PX), dtype=bool)
