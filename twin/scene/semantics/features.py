"""Features of images on Gaussians: fewer dimensions first, then lifted, then stored."""

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from bridge.whole_file import write_whole
from twin.naming.things import FeatureMap, SemanticsError
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.semantics.lift import Viewpoint, lift_features

FEATURES_FILE = "features.npz"
FORMAT_VERSION = 1
MAX_SAMPLES = 200_000
"""Cells the basis is computed from."""


@dataclass(frozen=True, kw_only=True)
class FeatureBasis:
    """Principal components of a model's features."""

    mean: Float32[np.ndarray, " num_channels"]
    components: Float32[np.ndarray, "num_kept num_channels"]
    """Orthonormal rows, most variance first."""
    explained_fraction: float
    """Share of the variance they keep."""

    def reduce(self, feature_map: FeatureMap) -> FeatureMap:
        """Express a feature map in the basis."""
        channels, height, width = feature_map.values.shape
        if channels != len(self.mean):
            message = f"a feature map has {channels} channels, the basis {len(self.mean)}."
            raise SemanticsError(message)
        flat = feature_map.values.reshape(channels, -1) - self.mean[:, None]
        reduced = (self.components @ flat).reshape(len(self.components), height, width)
        return replace(feature_map, values=as_float32(reduced))


@dataclass(frozen=True, kw_only=True)
class SceneFeatures:
    """Features of Gaussians and of instances, with the basis they are written in."""

    basis: FeatureBasis
    features: Float32[np.ndarray, "num_splats num_kept"]
    """Zero where no frame shows the Gaussian."""
    weight: Float32[np.ndarray, " num_splats"]
    """Feature cells' worth that each Gaussian was seen with."""
    instance_ids: Int32[np.ndarray, " num_instances"]
    instance_embeddings: Float32[np.ndarray, "num_instances num_dims"]
    """One vector for each instance in the space of texts; no columns when there is no model."""
    source: str
    """Which models made them."""


def fit_basis(maps: Sequence[FeatureMap], num_kept: int) -> FeatureBasis:
    """Principal component analysis over cells of all maps, evenly thinned."""
    if not maps or num_kept < 1:
        message = "a basis needs at least one feature map and one component."
        raise SemanticsError(message)
    cells = [item.values.reshape(len(item.values), -1).T for item in maps]
    step = max(1, sum(len(rows) for rows in cells) // MAX_SAMPLES)
    rows = np.concatenate([item[::step] for item in cells]).astype(np.float64)
    if not np.isfinite(rows).all():
        message = "a feature map holds values that are not finite."
        raise SemanticsError(message)
    mean = rows.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov(rows, rowvar=False, bias=True).reshape(2 * mean.shape))
    order = np.argsort(-variances)[: min(num_kept, len(rows))]
    components = axes[:, order].T
    # The sign of an eigenvector is arbitrary: its largest entry is made positive.
    largest = np.take_along_axis(components, np.abs(components).argmax(axis=1)[:, None], axis=1)
    total = float(np.maximum(variances, 0.0).sum())
    return FeatureBasis(
        mean=as_float32(mean),
        components=as_float32(components * np.where(largest < 0, -1.0, 1.0)),
        explained_fraction=float(variances[order].sum() / total) if total > 0 else 1.0,
    )


def lift_reduced(
    rasteriser: Rasteriser,
    cloud: GaussianCloud,
    frames: Iterable[tuple[Viewpoint, FeatureMap]],
    basis: FeatureBasis,
    *,
    source: str,
) -> SceneFeatures:
    """Reduce the maps of all frames and put them on the Gaussians; instances get no embedding yet.

    A Gaussian gets the mean of what the maps say about it.
    """
    reduced = [(viewpoint, basis.reduce(item)) for viewpoint, item in frames]
    mean, weight = lift_features(rasteriser, cloud, reduced)
    return SceneFeatures(
        basis=basis,
        features=mean,
        weight=weight,
        instance_ids=np.zeros(0, dtype=np.int32),
        instance_embeddings=np.zeros((0, 0), dtype=np.float32),
        source=source,
    )


def save_features(folder: Path, features: SceneFeatures) -> Path:
    """Write ``features.npz`` whole or not at all; features as 16-bit floats."""
    buffer = io.BytesIO()
    np.savez(
        buffer,
        version=np.array(FORMAT_VERSION),
        mean=features.basis.mean,
        components=features.basis.components,
        explained_fraction=np.array(features.basis.explained_fraction),
        features=features.features.astype(np.float16),
        weight=features.weight,
        instance_ids=features.instance_ids,
        instance_embeddings=features.instance_embeddings,
        source=np.frombuffer(features.source.encode(), dtype=np.uint8),
    )
    path = folder / FEATURES_FILE
    write_whole(path, buffer.getvalue())
    return path
