"""Gaussians stay near the surface that depth fused.

Images alone let a Gaussian slide along its rays as long as the training views agree; the depth term
sees only the mean depth of a pixel, so Gaussians before and behind the surface cancel in it. From
other viewpoints they come apart as a haze of millimetres. The fused surface is where many depth
images agree, so each Gaussian is held within a slab around the piece of it that it began on.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from bridge.geometry import se3
from twin.scene.gaussians.cloud import GaussianCloud, as_float32


@dataclass(frozen=True, kw_only=True)
class SurfacePrior:
    """The plane each Gaussian began on."""

    normals: Float32[np.ndarray, "num_splats 3"]
    heights_m: Float32[np.ndarray, " num_splats"]
    """Of the plane along its normal: normal . p for each of its points."""
    sizes_m: Float32[np.ndarray, " num_splats"]
    """Standard deviation in the plane at the start."""

    @classmethod
    def of(cls, cloud: GaussianCloud) -> "SurfacePrior":
        """Planes through the Gaussians' centres across their thinnest axis."""
        row = np.arange(len(cloud))
        R = se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))
        normals = R[row, :, cloud.scales_log.argmin(axis=1)].reshape(-1, 3)
        return cls(
            normals=as_float32(normals),
            heights_m=as_float32(np.einsum("ni,ni->n", normals, cloud.means_m)),
            sizes_m=np.exp(cloud.scales_log.max(axis=1, initial=-np.inf)).astype(np.float32),
        )

    def take(self, parents: Int64[np.ndarray, " num_rows"]) -> "SurfacePrior":
        """The planes of Gaussians that come from some of these."""
        return SurfacePrior(
            normals=self.normals[parents],
            heights_m=self.heights_m[parents],
            sizes_m=self.sizes_m[parents],
        )

    def hold(self, cloud: GaussianCloud, slab: float) -> None:
        """Move centres that left the slab back to its border, in place.

        Args:
            cloud: As many Gaussians as there are planes.
            slab: Half its thickness, in the Gaussian's size at the start.
        """
        off_m = np.einsum("ni,ni->n", self.normals, cloud.means_m) - self.heights_m
        limit_m = np.float32(slab) * self.sizes_m
        beyond_m = off_m - np.clip(off_m, -limit_m, limit_m)
        cloud.means_m[:] -= beyond_m[:, None] * self.normals
