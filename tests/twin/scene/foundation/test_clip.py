"""CLIP from a folder that holds a tiny network with random weights."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from model_inputs import picture

from twin.scene.foundation.models import ClipEmbedder, masked_crop

pytest.importorskip("transformers", reason="the extra [foundation] is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("without_network")]


def test_clip_gives_unit_vectors_and_a_batch_is_as_good_as_one_by_one(
    saved: Callable[[str], Path],
) -> None:
    embedder = ClipEmbedder(saved("clip"), "cpu")
    texts = embedder.encode(["red cube", "a yellow duck", "robot"])
    assert texts.shape == (3, embedder.num_channels) == (3, 16)
    np.testing.assert_allclose(np.linalg.norm(texts, axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(embedder.encode(["a yellow duck"])[0], texts[1], atol=1e-5)
    assert np.abs(texts[0] - texts[1]).max() > 1e-3
    masks = [np.zeros((60, 80), dtype=bool) for _ in range(2)]
    masks[0][10:30, 20:60] = True
    masks[1][5:50, 60:70] = True
    pieces = embedder.embed_masked([picture()] * 2, masks)
    np.testing.assert_allclose(np.linalg.norm(pieces, axis=1), 1.0, atol=1e-5)
    alone = embedder.embed_masked([picture()], masks[1:])
    np.testing.assert_allclose(alone[0], pieces[1], atol=1e-5)


def test_clip_sees_only_what_the_mask_shows(saved: Callable[[str], Path]) -> None:
    embedder = ClipEmbedder(saved("clip"), "cpu")
    mask = np.zeros((60, 80), dtype=bool)
    mask[20:40, 30:50] = True
    inside, outside = picture(seed=1), picture(seed=2)
    outside[mask] = inside[mask]
    one = embedder.embed_masked([inside, outside], [mask, mask])
    np.testing.assert_allclose(one[0], one[1], atol=1e-6)
    elsewhere = np.roll(mask, (10, -20), axis=(0, 1))
    moved = embedder.embed_masked([np.roll(inside, (10, -20), axis=(0, 1))], [elsewhere])
    np.testing.assert_allclose(moved[0], one[0], atol=1e-6)


def test_a_crop_is_square_with_its_mask_in_the_middle() -> None:
    image, mask = picture(), np.zeros((60, 80), dtype=bool)
    mask[3:13, 60:80] = True  # at the border, where no margin is left
    ground = np.array([9, 8, 7], dtype=np.uint8)
    crop = masked_crop(image, mask, ground)
    assert crop.shape == (24, 24, 3)
    np.testing.assert_array_equal(crop[7:17, 2:22], image[3:13, 60:80])
    assert (crop[:7] == ground).all()
