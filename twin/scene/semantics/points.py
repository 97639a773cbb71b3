"""Coloured, oriented points of surfaces: what the default segmenter looks at."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.scene.gaussians import GaussianCloud


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
