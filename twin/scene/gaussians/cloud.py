"""A cloud of Gaussians: what is stored, what is fitted, what is drawn."""

from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Float, Float32

from twin.errors import TwinError

SH_DC = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi)); PLY files store (c - 0.5) / SH_DC."""

SH_FIRST = 0.4886025119029199
"""Factor of the three real spherical harmonics of degree 1, sqrt(3 / (4 pi))."""

NUM_FIRST = 3
"""Spherical harmonics of degree 1."""


def _no_harmonics() -> np.ndarray:
    return np.zeros((0, 0, 3), dtype=np.float32)


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
    harmonics: Float32[np.ndarray, "num_splats num_harmonics 3"] = field(
        default_factory=_no_harmonics
    )
    """How colour changes with the direction it is seen along: coefficients of the real spherical
    harmonics of degree 1, none or three of them (``harmonic_basis``) for each colour."""

    def __post_init__(self) -> None:
        """A cloud made without harmonics has rows of none.

        Raises:
            TwinError: When there are neither none nor all three of degree 1.
        """
        if self.harmonics.shape[1] not in (0, NUM_FIRST):
            message = (
                f"a cloud with {self.harmonics.shape[1]} harmonics per colour: give none or the "
                f"{NUM_FIRST} of degree 1."
            )
            raise TwinError(message)
        if len(self.harmonics) == 0 and len(self.means_m) > 0:
            none = np.zeros((len(self.means_m), 0, 3), dtype=np.float32)
            object.__setattr__(self, "harmonics", none)

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.means_m)

    @property
    def num_harmonics(self) -> int:
        """Coefficients of each colour beside the constant: 0 or 3."""
        return int(self.harmonics.shape[1])

    def take(self, index: np.ndarray) -> "GaussianCloud":
        """Select and order Gaussians by a mask or a list of ids."""
        return GaussianCloud(**{name: as_float32(rows[index]) for name, rows in arrays(self)})

    def opacities(self) -> Float32[np.ndarray, " num_splats"]:
        """Opacity of each Gaussian at its centre, 0..1."""
        return as_float32(1.0 / (1.0 + np.exp(-self.opacities_logit)))


def arrays(cloud: GaussianCloud) -> list[tuple[str, np.ndarray]]:
    """Return the arrays of a cloud with their names, in the order of the fields.

    ``harmonics`` is left out where there are none.
    """
    named = [(item.name, getattr(cloud, item.name)) for item in fields(cloud)]
    return named if cloud.num_harmonics else named[:-1]


def as_float32(values: np.ndarray) -> np.ndarray:
    """Return contiguous float32, copying only where needed."""
    return np.ascontiguousarray(values, dtype=np.float32)


def concatenate(clouds: list[GaussianCloud]) -> GaussianCloud:
    """Put clouds one after another; those without harmonics get zeros where others have some."""
    most = max(cloud.num_harmonics for cloud in clouds)
    padded = [with_harmonics(cloud, most) for cloud in clouds]
    names = [item.name for item in fields(GaussianCloud)]
    return GaussianCloud(
        **{name: as_float32(np.concatenate([getattr(c, name) for c in padded])) for name in names}
    )


def with_harmonics(cloud: GaussianCloud, num_harmonics: int = NUM_FIRST) -> GaussianCloud:
    """The same Gaussians with this many harmonics: zeros added, or those beyond cut off."""
    kept = min(num_harmonics, cloud.num_harmonics)
    harmonics = np.zeros((len(cloud), num_harmonics, 3), dtype=np.float32)
    harmonics[:, :kept] = cloud.harmonics[:, :kept]
    return GaussianCloud(**(dict(arrays(cloud)) | {"harmonics": harmonics}))


def harmonic_basis(
    directions: Float[np.ndarray, "*shape 3"],
) -> Float[np.ndarray, "*shape 3"]:
    """Values of the three real spherical harmonics of degree 1 along unit directions.

    In the order and with the signs of 3D Gaussian splatting files: sqrt(3 / (4 pi)) (-y, z, -x).
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.asarray(np.stack([-y, z, -x], axis=-1) * directions.dtype.type(SH_FIRST))


def effective_colors(
    cloud: GaussianCloud, camera_centre_m: Float[np.ndarray, "3"]
) -> Float32[np.ndarray, "num_splats 3"]:
    """Colour of each Gaussian as seen from a point of the cloud's frame, not clipped."""
    if cloud.num_harmonics == 0:
        return cloud.colors
    basis = harmonic_basis(view_directions(cloud.means_m, camera_centre_m))
    return as_float32(cloud.colors + np.einsum("nk,nkc->nc", basis, cloud.harmonics))


def view_directions(
    means_m: Float32[np.ndarray, "num_splats 3"], camera_centre_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "num_splats 3"]:
    """Unit vectors from the camera centre to each mean."""
    ray = means_m.astype(np.float64) - camera_centre_m
    return np.asarray(ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12))


def turned_harmonics(
    harmonics: Float32[np.ndarray, "num_splats num_harmonics 3"],
    R_new_old: Float[np.ndarray, "*splats 3 3"],
) -> Float32[np.ndarray, "num_splats num_harmonics 3"]:
    """The harmonics of Gaussians that were turned with all that shines on them.

    One rotation for all of them, or one for each. Degree 1 is a vector for each colour,
    sqrt(3 / (4 pi)) v . d with v = (-h_2, -h_0, h_1), and turns like one.
    """
    if harmonics.shape[1] == 0:
        return harmonics
    v = np.stack([-harmonics[:, 2], -harmonics[:, 0], harmonics[:, 1]], axis=1)
    x, y, z = np.moveaxis(R_new_old @ v, 1, 0)
    return as_float32(np.stack([-y, z, -x], axis=1))


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
