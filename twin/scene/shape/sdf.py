"""Signed distances on a grid: negative inside, positive outside [m]."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage

from twin.npz import UnreadableArraysError, read_npz, write_npz

MAX_VOXELS = 16_000_000
"""Larger files are refused."""
LEVEL_STEPS = 24
"""Halvings on the way to the level that keeps a volume."""
_NAMES = ("values_m", "origin_m", "voxel_m", "closed")


@dataclass(frozen=True, kw_only=True)
class SdfGrid:
    """Distances at voxel centres, trilinear in between."""

    values_m: Float32[np.ndarray, "num_x num_y num_z"]
    origin_m: Float[np.ndarray, "3"]
    """Centre of the first voxel."""
    voxel_m: float
    closed: bool = True
    """All of the solid lies inside the grid. Otherwise nobody knows what is beyond."""

    def distance(self, points_m: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Distance to the surface [m]; beyond the grid a lower bound, never too large.

        With all solid inside, the nearest grid point b at distance e bounds the distance by
        sqrt(d(b)^2 + e^2): b is the projection onto a box that contains the solid, so the angle
        at b is at least a right one. When the solid may go on, only d(b) - e is certain.
        """
        place = (points_m.reshape(-1, 3) - self.origin_m) / self.voxel_m
        held = np.clip(place, 0.0, np.array(self.values_m.shape) - 1.0)
        value = ndimage.map_coordinates(self.values_m, held.T, output=np.float64, order=1)
        e = np.linalg.norm(place - held, axis=1) * self.voxel_m
        far = np.hypot(np.maximum(value, 0.0), e) if self.closed else value - e
        return np.asarray(np.where(e > 0, far, value).reshape(points_m.shape[:-1]))

    def may_hold(
        self, points_m: Float[np.ndarray, "num_points 3"], margin_m: float
    ) -> Bool[np.ndarray, " num_points"]:
        """Whether points may be so near to the solid; those farther from a closed grid are not."""
        if not self.closed:
            return np.ones(len(points_m), dtype=bool)
        end_m = self.origin_m + (np.array(self.values_m.shape) - 1.0) * self.voxel_m
        beyond_m = np.maximum(self.origin_m - points_m, points_m - end_m)
        return np.asarray(beyond_m.max(axis=1, initial=-np.inf) < margin_m)

    def save(self, path: Path) -> None:
        """Write an npz file."""
        write_npz(path, self.arrays())

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that ``load`` needs, by name."""
        return {name: np.asarray(getattr(self, name)) for name in _NAMES}

    @staticmethod
    def load(path: Path) -> "SdfGrid":
        """Read what ``save`` wrote."""
        found = read_npz(path, _NAMES, MAX_VOXELS * 4 + 4096)
        values, origin, voxel, closed = (found[name] for name in _NAMES)
        shapes = (values.ndim, origin.shape, voxel.shape, closed.shape) == (3, (3,), (), ())
        kinds = values.dtype == np.float32 and origin.dtype == voxel.dtype == np.float64
        if not shapes or not kinds or min(values.shape) < 2:
            found_ = f"values of shape {values.shape} and type {values.dtype} are no grid"
            raise UnreadableArraysError(path=path, found=found_)
        if not (np.isfinite(values).all() and np.isfinite(origin).all() and voxel > 0):
            raise UnreadableArraysError(path=path, found="a distance or a position is not finite")
        return SdfGrid(values_m=values, origin_m=origin, voxel_m=float(voxel), closed=bool(closed))


def distances_of_solid(
    solid: Bool[np.ndarray, "num_x num_y num_z"], voxel_m: float
) -> Float32[np.ndarray, "num_x num_y num_z"]:
    """Signed distance of voxel centres to the faces between solid and free voxels [m].

    Exact Euclidean distance transform (Maurer, Qi and Raghavan 2003, in SciPy) from both sides;
    the surface lies half a voxel from the centres on either side. Far from a curved surface the
    nearest voxel of the other kind is one that reaches out, so magnitudes come out up to half a
    voxel too small: the safe side outside.

    Args:
        solid: True inside; with at least one voxel of each kind the result is finite.
    """
    outside = ndimage.distance_transform_edt(~solid) - 0.5
    inside = ndimage.distance_transform_edt(solid) - 0.5
    return np.asarray(np.where(solid, -inside, outside) * voxel_m, dtype=np.float32)


def smoothed(
    distances_m: Float32[np.ndarray, "num_x num_y num_z"],
    voxel_m: float,
    sigma_voxels: float,
) -> Float32[np.ndarray, "num_x num_y num_z"]:
    """Take the stairs off a solid's surface without changing how much it holds.

    A mean over distances keeps them 1-Lipschitz but eats thin walls (a wall of two voxels loses
    a fifth); the level that holds as much as before becomes zero again. A voxel that the surface
    runs through counts by the share that its distance leaves inside.
    """
    mean = ndimage.gaussian_filter(distances_m, sigma_voxels, mode="nearest")
    wanted = _volume_voxels(distances_m.ravel() / voxel_m)
    near = mean.ravel()[np.abs(mean.ravel()) < 2 * voxel_m] / voxel_m
    wanted -= float((mean < -2 * voxel_m).sum())
    low, high = -0.5, 0.5
    for _ in range(LEVEL_STEPS):
        level = (low + high) / 2
        if _volume_voxels(near - level) < wanted:
            low = level
        else:
            high = level
    return np.asarray(mean - np.float32((low + high) / 2 * voxel_m), dtype=np.float32)


def _volume_voxels(distances: np.ndarray) -> float:
    """How many voxels are inside, by distances in voxels."""
    return float(np.clip(0.5 - distances, 0.0, 1.0).sum(dtype=np.float64))
