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
        value, _, beyond = self._interpolate(points_m.reshape(-1, 3))
        e = np.linalg.norm(beyond, axis=1)
        far = np.hypot(np.maximum(value, 0.0), e) if self.closed else value - e
        return np.where(e > 0, far, value).reshape(points_m.shape[:-1])

    def gradient(self, points_m: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Derivative of ``distance`` by the point; about a unit vector away from the surface."""
        value, slope, beyond = self._interpolate(points_m.reshape(-1, 3))
        e = np.linalg.norm(beyond, axis=1, keepdims=True)
        slope = np.where(beyond == 0.0, slope, 0.0)
        if self.closed:
            ahead = np.maximum(value, 0.0)[:, None]
            far = (ahead * slope + beyond) / np.maximum(np.hypot(ahead, e), 1e-12)
        else:
            far = slope - beyond / np.maximum(e, 1e-12)
        return np.where(e > 0, far, slope).reshape(points_m.shape)

    def save(self, path: Path) -> None:
        """Write an npz file."""
        write_npz(path, self.arrays())

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that ``load`` needs, by name."""
        return {
            "values_m": self.values_m,
            "origin_m": self.origin_m,
            "voxel_m": np.array(self.voxel_m),
            "closed": np.array(self.closed),
        }

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

    def _interpolate(
        self, points: Float[np.ndarray, "num_points 3"]
    ) -> tuple[
        Float[np.ndarray, " num_points"],
        Float[np.ndarray, "num_points 3"],
        Float[np.ndarray, "num_points 3"],
    ]:
        """Value and derivative at the nearest point of the grid, and the way from it [m]."""
        counts = np.array(self.values_m.shape)
        last = (counts - 1).astype(np.float64)
        place = (points - self.origin_m) / self.voxel_m
        held = np.clip(place, 0.0, last)
        first = np.minimum(held.astype(np.int64), counts - 2)
        t = held - first
        flat = (first[:, 0] * counts[1] + first[:, 1]) * counts[2] + first[:, 2]
        step = (counts[1] * counts[2], counts[2], 1)
        rows = self.values_m.ravel()
        c = [
            rows[flat + i * step[0] + j * step[1] + k * step[2]].astype(np.float64)
            for i in (0, 1)
            for j in (0, 1)
            for k in (0, 1)
        ]
        tx, ty, tz = t.T
        along_z = [c[n] + (c[n + 1] - c[n]) * tz for n in (0, 2, 4, 6)]
        low, high = (along_z[n] + (along_z[n + 1] - along_z[n]) * ty for n in (0, 2))
        value = low + (high - low) * tx
        slope_y = (along_z[1] - along_z[0]) * (1 - tx) + (along_z[3] - along_z[2]) * tx
        lean = [c[n + 1] - c[n] for n in (0, 2, 4, 6)]
        lean_low, lean_high = (lean[n] + (lean[n + 1] - lean[n]) * ty for n in (0, 2))
        slope_z = lean_low + (lean_high - lean_low) * tx
        slope = np.stack([high - low, slope_y, slope_z], axis=1) / self.voxel_m
        return value, slope, (place - held) * self.voxel_m


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
