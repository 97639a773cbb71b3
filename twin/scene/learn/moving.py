"""What moved during the recording: surfaces that other frames look through.

The scene folder holds the static place. A robot, a hand or an object that was carried shows up as
a surface in a few frames, while other frames measure something farther behind it. No model of the
robot is needed. A thing that never moves, such as the robot's base, is static and stays.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from bridge.geometry import se3
from twin.scene.frames.points import PointSet
from twin.scene.frames.training_view import TrainingView

VOXEL_M = 0.02
"""Points are judged in groups of this size."""
MARGIN_M = 0.03
MARGIN_FRACTION = 0.02
"""A measurement must lie this much behind a point to have passed it."""
MAX_WITNESSES = 40
"""Frames that are asked; more only cost time."""
MIN_THROUGH = 2
OUTLINE_PX = 3
"""Poses and depth are noisy: closer to a nearer surface than this, at half size, nobody knows."""
GROW_PX = 2
"""Masks grow by this much at half size, because depth fails along outlines."""
INDEX_BITS = 20


@dataclass(frozen=True, kw_only=True)
class MovingVoxels:
    """Where something was that is not part of the static place."""

    keys: Int64[np.ndarray, " num_voxels"]

    def contains(self, p_m: Float32[np.ndarray, "num_points 3"]) -> Bool[np.ndarray, " num_points"]:
        """Say which points (root frame, metres) belong to something that moved."""
        return np.isin(_keys(p_m), self.keys)

    def drop_from(self, points: PointSet) -> PointSet:
        """Return the static points only."""
        return points.take(~self.contains(points.p_m))

    def mask_in(self, view: TrainingView) -> TrainingView:
        """Mark the pixels that show something moving, so that the fit passes them over."""
        if not len(self.keys):
            return view
        half = view.half
        known = half.depth_m > 0
        p_camera = half.camera.unproject(half.depth_m)[known]
        hit = np.zeros_like(known)
        hit[known] = self.contains(se3.apply(view.T_base_color, p_camera).astype(np.float32))
        return view.without(_grown(hit))


@dataclass(frozen=True, kw_only=True)
class Witness:
    """What one training frame can say about other frames' points."""

    view: TrainingView
    nearest_m: Float32[np.ndarray, "height width"]

    def testify(
        self, p_base: Float[np.ndarray, "num_points 3"]
    ) -> tuple[Bool[np.ndarray, " num_points"], Bool[np.ndarray, " num_points"]]:
        """Say which points it looks through, and which it sees where they should be."""
        target = self.view.half
        camera = target.camera
        p_camera = se3.apply(se3.invert(self.view.T_base_color), p_base)
        front = p_camera[:, 2] > MARGIN_M
        uv, z = camera.project(np.where(front[:, None], p_camera, 1.0))
        column, row = np.floor(uv[:, 0]).astype(int), np.floor(uv[:, 1]).astype(int)
        inside = front & (column >= 0) & (column < camera.width)
        inside &= (row >= 0) & (row < camera.height)
        measured, nearest = np.zeros(len(p_base)), np.zeros(len(p_base))
        measured[inside] = target.depth_m[row[inside], column[inside]]
        nearest[inside] = self.nearest_m[row[inside], column[inside]]
        margin = MARGIN_M + MARGIN_FRACTION * z
        known = measured > 0
        return known & (nearest > z + margin), known & (np.abs(measured - z) <= margin)


def choose_witnesses(views: Sequence[TrainingView]) -> list[Witness]:
    """Take training frames spread evenly; their depth images are the witnesses."""
    step = max(1, -(-len(views) // MAX_WITNESSES))
    return [
        Witness(view=view, nearest_m=nearest_around(view.half.depth_m)) for view in views[::step]
    ]


def find_moving(points: Sequence[PointSet], witnesses: Sequence[Witness]) -> MovingVoxels:
    """Find voxels that more frames look through than confirm.

    Args:
        points: Surface points of all training frames, or of one held-out frame.
        witnesses: Training frames.
    """
    p = np.concatenate([item.p_m for item in points])
    keys, inverse, counts = np.unique(_keys(p), return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(inverse, weights=c) / counts for c in p.T], axis=1)
    through = np.zeros(len(keys), dtype=np.int32)
    confirmed = np.zeros(len(keys), dtype=np.int32)
    for witness in witnesses:
        passed, met = witness.testify(means)
        through += passed
        confirmed += met
    return MovingVoxels(keys=keys[(through >= MIN_THROUGH) & (through > confirmed)])


def nearest_around(depth_m: np.ndarray) -> np.ndarray:
    """Smallest measurement within a few pixels: beside an outline nothing counts as passed."""
    nearest = np.where(depth_m > 0, depth_m, np.float32(np.inf))
    for axis in (0, 1):
        once = nearest.copy()
        for shift in range(1, OUTLINE_PX + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(shift, None), slice(None, -shift)
            for to, source in ((tuple(ahead), tuple(behind)), (tuple(behind), tuple(ahead))):
                nearest[to] = np.minimum(nearest[to], once[source])
    return np.asarray(nearest)


def _keys(p_m: np.ndarray) -> np.ndarray:
    cell = np.floor(p_m / VOXEL_M).astype(np.int64) + (1 << (INDEX_BITS - 1))
    cell = np.clip(cell, 0, (1 << INDEX_BITS) - 1)
    packed = (cell[:, 0] << (2 * INDEX_BITS)) | (cell[:, 1] << INDEX_BITS) | cell[:, 2]
    return np.asarray(packed)


def _grown(mask: np.ndarray) -> np.ndarray:
    grown: np.ndarray = mask.copy()
    for axis in (0, 1):
        once = grown.copy()
        for shift in range(1, GROW_PX + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(shift, None), slice(None, -shift)
            grown[tuple(ahead)] |= once[tuple(behind)]
            grown[tuple(behind)] |= once[tuple(ahead)]
    return grown
