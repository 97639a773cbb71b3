"""Adam on the arrays of a cloud, in place."""

from dataclasses import dataclass

import numpy as np

from twin.scene.gaussians import GaussianCloud, arrays, as_float32
from twin.scene.raster import CloudGradient, load_native

RATES = {
    "means_m": 0.18,  # in units of the median Gaussian's size
    "quats_wxyz": 1.2e-2,
    "scales_log": 4.5e-2,
    "opacities_logit": 0.12,
    "colors": 2.4e-2,
    "harmonics": 3e-3,
}
"""Step sizes at the start of a fit."""

Moments = dict[str, tuple[np.ndarray, np.ndarray]]
"""Running mean of the gradient and of its square, per array."""


@dataclass(frozen=True, kw_only=True)
class Rates:
    """How far one step goes, for a cloud of Gaussians of a certain size."""

    size_m: float
    """Median of the larger standard deviation in the plane; positions move in units of it."""

    @staticmethod
    def for_cloud(cloud: GaussianCloud) -> "Rates":
        """Measure the Gaussians a fit begins with."""
        return Rates(size_m=float(np.median(np.exp(cloud.scales_log.max(axis=1)))))

    def of(self, name: str) -> float:
        """Step size of one array at the start."""
        return RATES[name] * (self.size_m if name == "means_m" else 1.0)


def own_copy(cloud: GaussianCloud) -> GaussianCloud:
    """A cloud whose arrays may be changed in place."""
    return GaussianCloud(**{name: rows.copy() for name, rows in arrays(cloud)})


def no_moments(cloud: GaussianCloud) -> Moments:
    """What Adam knows before the first gradient."""
    return {name: (np.zeros_like(rows), np.zeros_like(rows)) for name, rows in arrays(cloud)}


def taken_moments(moments: Moments, parents: np.ndarray) -> Moments:
    """Moments of a rearranged cloud: each Gaussian goes on with those of its parent."""
    return {
        name: (as_float32(first[parents]), as_float32(second[parents]))
        for name, (first, second) in moments.items()
    }


def adam_step(
    cloud: GaussianCloud,
    gradient: CloudGradient,
    moments: Moments,
    *,
    step: int,
    rates: Rates,
    decay: float,
    threads: int,
) -> None:
    """One step of Adam (Kingma and Ba 2015) on each array of the cloud, in place.

    Args:
        cloud: Changed.
        gradient: Of the loss.
        moments: Changed.
        step: Counted from 1.
        rates: Step sizes at the start.
        decay: What is left of them now.
        threads: 0: all.
    """
    native = load_native().adam_step
    for name, rows in arrays(cloud):
        first, second = moments[name]
        native(
            rows,
            getattr(gradient, name),
            first,
            second,
            step,
            rates.of(name) * decay,
            threads=threads,
        )
