"""A cloud of Gaussians: what is stored, what is fitted, what is drawn."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32

SH_DC = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi)); PLY files store (c - 0.5) / SH_DC."""


@dataclass(frozen=True, kw_only=True)
class GaussianCloud:
    """Anisotropic Gaussians with one colour each, in the run's root frame.

    The paper's Eq. 1 as resolved by the errata: covariance = R S S^T R^T with S = exp(scales_log)
    and R from the quaternion. Arrays are contiguous float32.
    """

    means_m: Float32[np.ndarray, "num_splats 3"]
    quats_wxyz: Float32[np.ndarray, "num_splats 4"]
    """Orientation; any length but zero, normalised where it is used."""
    scales_log: Float32[np.ndarray, "num_splats 3"]
    """Natural logarithm of the standard deviations in metres."""
    opacities_logit: Float32[np.ndarray, " num_splats"]
    colors: Float32[np.ndarray, "num_splats 3"]
    """sRGB, nominally 0..1; may leave that range, the drawn image is clipped."""

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.means_m)

    def take(self, index: np.ndarray) -> "GaussianCloud":
        """Select and order Gaussians by a mask or a list of ids."""
        return GaussianCloud(**{name: as_float32(rows[index]) for name, rows in arrays(self)})

    def opacities(self) -> Float32[np.ndarray, " num_splats"]:
        """Opacity of each Gaussian at its centre, 0..1."""
        return as_float32(1.0 / (1.0 + np.exp(-self.opacities_logit)))


def arrays(cloud: GaussianCloud) -> list[tuple[str, np.ndarray]]:
    """Return the arrays of a cloud with their names, in the order of the fields."""
    return [(field.name, getattr(cloud, field.name)) for field in fields(cloud)]


def as_float32(values: np.ndarray) -> np.ndarray:
    """Return contiguous float32, copying only where needed."""
    return np.ascontiguousarray(values, dtype=np.float32)


def concatenate(clouds: list[GaussianCloud]) -> GaussianCloud:
    """Put clouds one after another."""
    names = [field.name for field in fields(GaussianCloud)]
    return GaussianCloud(
        **{name: as_float32(np.concatenate([getattr(c, name) for c in clouds])) for name in names}
    )


def morton_order(
    means_m: Float32[np.ndarray, "num_splats 3"],
) -> np.ndarray:
    """Order that keeps neighbours in space near each other in memory (Morton 1966), ids.

    Drawing walks Gaussians by depth and tile; neighbours in memory are then neighbours in cache.
    """
    low = means_m.min(axis=0)
    extent = float((means_m.max(axis=0) - low).max())
    cells = ((means_m - low) / max(extent, 1e-9) * 1023.0).astype(np.uint64)
    code = np.zeros(len(means_m), dtype=np.uint64)
    for axis in range(3):
        code |= _spread_bits(cells[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _spread_bits(values: np.ndarray) -> np.ndarray:
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values
