"""DINOv3 from folders that hold tiny networks with random weights."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from model_inputs import CPU, picture

from bridge.errors import UsageError
from twin.scene.foundation.models import DinoFeatures

pytest.importorskip("transformers", reason="the extra [foundation] is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("without_network")]


@pytest.mark.parametrize(("name", "cell"), [("dino_vit", 16)])
def test_dino_maps_cover_the_image_and_a_batch_is_as_good_as_one_by_one(
    saved: Callable[[str], Path], name: str, cell: int
) -> None:
    source = DinoFeatures.load(saved(name), CPU)
    images = [picture(96, 128, seed) for seed in range(3)]
    maps = source.features(images)
    for image, found in zip(images, maps, strict=True):
        assert found.values.shape == (32, 96 // cell, 128 // cell)
        assert found.stride == cell
        (alone,) = source.features([image])
        np.testing.assert_allclose(alone.values, found.values, atol=1e-5)
    (finer,) = source.features(images[:1], stride=8)
    assert finer.values.shape == (32, 12, 16)
    (ragged,) = source.features([picture(97, 128)])  # the last row of cells reaches over the edge
    assert ragged.values.shape == (32, 96 // cell + 1, 128 // cell)
    assert source.features([]) == []


@pytest.mark.parametrize("name", ["dino_vit"])
def test_dino_features_are_the_network_s_patch_tokens_without_class_and_registers(
    saved: Callable[[str], Path], name: str
) -> None:
    import torch
    import transformers

    image = picture(64, 96)
    (found,) = DinoFeatures.load(saved(name), CPU).features([image])
    network = transformers.AutoModel.from_pretrained(saved(name)).eval()
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    pixels = np.moveaxis((image / 255.0 - mean) / deviation, -1, 0)[None].astype(np.float32)
    with torch.no_grad():
        tokens = network(pixel_values=torch.from_numpy(pixels)).last_hidden_state[0].numpy()
    num_cells = found.values[0].size
    patches = tokens[len(tokens) - num_cells :]
    np.testing.assert_allclose(found.values.reshape(32, -1).T, patches, atol=1e-5)


def test_dino_refuses_maps_without_cells_or_with_too_many(saved: Callable[[str], Path]) -> None:
    source = DinoFeatures.load(saved("dino_vit"), CPU)
    for stride in (0, 1, 1000):
        with pytest.raises(UsageError, match="cells"):
            source.features([picture(480, 640)], stride=stride)
    with pytest.raises(UsageError, match="different sizes"):
        source.features([picture(60, 80), picture(80, 60)])
