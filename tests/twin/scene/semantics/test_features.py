from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from twin.naming.things import FeatureMap, SemanticsError
from twin.scene.semantics.features import (
    FeatureBasis,
    SceneFeatures,
    fit_basis,
    save_features,
)


def low_rank_maps(channels: int = 12, rank: int = 3, seed: int = 0) -> list[FeatureMap]:
    rng = np.random.default_rng(seed)
    mixing, offset = rng.normal(size=(channels, rank)), rng.normal(size=(channels, 1))
    return [
        FeatureMap(
            values=(mixing @ rng.normal(size=(rank, 80)) + offset)
            .reshape(channels, 8, 10)
            .astype(np.float32),
            stride=4,
        )
        for _ in range(4)
    ]


def some_features(num_splats: int = 30) -> SceneFeatures:
    rng = np.random.default_rng(1)
    return SceneFeatures(
        basis=fit_basis(low_rank_maps(), 3),
        features=rng.normal(size=(num_splats, 3)).astype(np.float32),
        weight=rng.uniform(size=num_splats).astype(np.float32),
        instance_ids=np.array([1, 2], dtype=np.int32),
        instance_embeddings=rng.normal(size=(2, 5)).astype(np.float32),
        source="made model",
    )


def test_a_basis_of_the_true_rank_loses_nothing() -> None:
    maps = low_rank_maps()
    basis = fit_basis(maps, 3)
    assert basis.explained_fraction == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(basis.components @ basis.components.T, np.eye(3), atol=1e-5)
    reduced = basis.reduce(maps[0]).values.reshape(3, -1)
    back = basis.components.T @ reduced + basis.mean[:, None]
    np.testing.assert_allclose(back, maps[0].values.reshape(12, -1), atol=1e-4)


def test_the_file_holds_what_was_saved(tmp_path: Path) -> None:
    features = some_features()
    with np.load(save_features(tmp_path, features), allow_pickle=False) as stored:
        written = dict(stored)
    np.testing.assert_array_equal(written["features"], features.features.astype(np.float16))
    np.testing.assert_array_equal(written["components"], features.basis.components)
    np.testing.assert_array_equal(written["instance_embeddings"], features.instance_embeddings)
    assert written["source"].tobytes() == b"made model"


def test_the_same_features_are_the_same_bytes(tmp_path: Path) -> None:
    path = save_features(tmp_path, some_features())
    first = path.read_bytes()
    assert save_features(tmp_path, some_features()).read_bytes() == first


def test_a_map_of_another_model_is_refused() -> None:
    basis: FeatureBasis = fit_basis(low_rank_maps(), 3)
    other = replace(low_rank_maps(channels=7)[0])
    with pytest.raises(SemanticsError, match="7 channels, the basis 12"):
        basis.reduce(other)
    with pytest.raises(SemanticsError, match="at least one"):
        fit_basis([], 3)
