"""Features reduced to few numbers, against a singular value decomposition."""

import numpy as np
import pytest

from twin.naming.things import FeatureMap
from twin.scene.semantics.features import fit_basis


def maps_of(values: np.ndarray, num_maps: int = 3) -> list[FeatureMap]:
    """Cut columns of features into maps of four rows."""
    pieces = np.split(values, num_maps, axis=1)
    return [
        FeatureMap(values=piece.reshape(len(values), 4, -1).astype(np.float32), stride=16)
        for piece in pieces
    ]


def some_features(seed: int = 0, rank: int = 20, offset: float = 5.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    strengths = np.geomspace(4.0, 0.2, rank)
    mixing = np.linalg.qr(rng.normal(size=(48, rank)))[0] * strengths
    return mixing @ rng.normal(size=(rank, 240)) + offset


def test_the_basis_is_that_of_a_singular_value_decomposition() -> None:
    values = some_features().astype(np.float32).astype(np.float64)
    basis = fit_basis(maps_of(values), 16)
    centred = values - values.mean(axis=1, keepdims=True)
    left, singular, _ = np.linalg.svd(centred, full_matrices=False)
    alike = np.abs((basis.components * left[:, :16].T).sum(axis=1))
    np.testing.assert_allclose(alike, 1.0, atol=1e-4)
    np.testing.assert_allclose(basis.components @ basis.components.T, np.eye(16), atol=1e-5)
    wanted = (singular[:16] ** 2).sum() / (singular**2).sum()
    assert basis.explained_fraction == pytest.approx(wanted, abs=1e-4)


def test_the_order_of_the_views_does_not_matter() -> None:
    maps = maps_of(some_features())
    one, other = fit_basis(maps, 8), fit_basis(maps[::-1], 8)
    np.testing.assert_allclose(one.components, other.components, atol=1e-5)
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-5)


def test_a_large_common_offset_does_not_drown_the_differences() -> None:
    plain = fit_basis(maps_of(some_features(offset=0.0)), 4)
    shifted = fit_basis(maps_of(some_features(offset=3000.0)), 4)
    alike = np.abs((plain.components * shifted.components).sum(axis=1))
    assert alike.min() > 0.999  # float32 features keep about four digits of such a sum
