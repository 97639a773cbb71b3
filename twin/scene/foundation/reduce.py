"""Few numbers instead of many: principal components of features, one basis for all views."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from twin.errors import TwinError
from twin.scene.semantics.result import FeatureMap


class FeatureReductionError(TwinError):
    """Features cannot be reduced, or do not fit the basis."""


@dataclass(frozen=True, kw_only=True)
class FeatureBasis:
    """Main directions of features (Pearson 1901); kept with what was projected on them."""

    mean: Float32[np.ndarray, " num_channels"]
    components: Float32[np.ndarray, "num_kept num_channels"]
    """Orthonormal rows, the direction of most variance first; the largest entry of each is
    positive, so that the same features always give the same numbers."""
    explained_fraction: float
    """Share of the variance that the kept directions hold, 0..1."""

    def project(self, features: FeatureMap) -> FeatureMap:
        """Reduce one map; its cells and stride stay.

        Raises:
            FeatureReductionError: When it has another number of channels.
        """
        return FeatureMap(values=self.reduce(features.values), stride=features.stride)

    def reduce(self, values: Float32[np.ndarray, "num_channels *cells"]) -> np.ndarray:
        """Reduce features whose channels stand first, ``num_kept *cells``."""
        if values.shape[0] != len(self.mean):
            message = (
                f"features have {values.shape[0]} channels, the basis was made of "
                f"{len(self.mean)}. Use the model that the basis was made with."
            )
            raise FeatureReductionError(message)
        flat = values.reshape(values.shape[0], -1)
        reduced = self.components @ (flat - self.mean[:, None])
        return np.asarray(reduced.reshape(-1, *values.shape[1:]), dtype=np.float32)

    def restore(self, reduced: Float32[np.ndarray, "num_kept *cells"]) -> np.ndarray:
        """The nearest features of full length, ``num_channels *cells``."""
        flat = self.components.T @ reduced.reshape(reduced.shape[0], -1) + self.mean[:, None]
        return np.asarray(flat.reshape(-1, *reduced.shape[1:]), dtype=np.float32)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What ``features.npz`` keeps of it."""
        return {
            "basis_mean": self.mean,
            "basis_components": self.components,
            "basis_explained_fraction": np.array(self.explained_fraction, dtype=np.float32),
        }

    @staticmethod
    def from_arrays(arrays: Mapping[str, np.ndarray]) -> "FeatureBasis":
        """Read what ``to_arrays`` gave.

        Raises:
            FeatureReductionError: When an array is missing or does not fit.
        """
        names = ("basis_mean", "basis_components", "basis_explained_fraction")
        missing = [name for name in names if name not in arrays]
        if missing:
            message = f"no feature basis: {missing[0]} is missing. Rebuild the scene's features."
            raise FeatureReductionError(message)
        mean, components = arrays[names[0]], arrays[names[1]]
        if mean.ndim != 1 or components.ndim != 2 or components.shape[1] != len(mean):
            message = f"a feature basis of shapes {mean.shape} and {components.shape} is broken."
            raise FeatureReductionError(message)
        return FeatureBasis(
            mean=mean.astype(np.float32),
            components=components.astype(np.float32),
            explained_fraction=float(arrays[names[2]]),
        )


def fit_basis(maps: Sequence[FeatureMap], num_kept: int = 16) -> FeatureBasis:
    """Find the main directions over all cells of all maps, by their covariance.

    Args:
        maps: Of one model; memory does not grow with their number.
        num_kept: Directions to keep; fewer where the features span fewer.

    Raises:
        FeatureReductionError: When there are no cells, channels differ, a value is not finite, or
            all cells are alike.
    """
    if not maps or num_kept < 1:
        message = f"no features to reduce: {len(maps)} maps to {num_kept} numbers."
        raise FeatureReductionError(message)
    num_channels = maps[0].values.shape[0]
    count, total = 0, np.zeros(num_channels)
    moment = np.zeros((num_channels, num_channels))
    # Differences from one cell instead of from zero: features share a large offset.
    origin = maps[0].values.reshape(num_channels, -1)[:, :1].astype(np.float64)
    for item in maps:
        if item.values.shape[0] != num_channels:
            message = f"feature maps of {num_channels} and {item.values.shape[0]} channels differ."
            raise FeatureReductionError(message)
        flat = item.values.reshape(num_channels, -1).astype(np.float64) - origin
        if not np.isfinite(flat).all():
            message = "a feature map holds values that are not finite; try the type float32."
            raise FeatureReductionError(message)
        count += flat.shape[1]
        total += flat.sum(axis=1)
        moment += flat @ flat.T
    mean = total / max(count, 1)
    variance, vectors = np.linalg.eigh(moment / max(count, 1) - np.outer(mean, mean))
    order = np.argsort(variance)[::-1]
    variance, vectors = np.maximum(variance[order], 0.0), vectors[:, order].T
    if not variance[0] > 1e-12:
        message = f"all {count} cells have the same features; there is nothing to tell apart."
        raise FeatureReductionError(message)
    rank = int((variance > 1e-9 * variance[0]).sum())
    kept = vectors[: min(num_kept, rank)]
    largest = np.take_along_axis(kept, np.abs(kept).argmax(axis=1)[:, None], axis=1)
    return FeatureBasis(
        mean=(mean + origin[:, 0]).astype(np.float32),
        components=(kept * np.sign(largest)).astype(np.float32),
        explained_fraction=float(variance[: len(kept)].sum() / variance.sum()),
    )
