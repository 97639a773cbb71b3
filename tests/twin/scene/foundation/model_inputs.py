"""What the tests of the models show them."""

from pathlib import Path

import numpy as np

from twin.scene.foundation.models import Sam3Segmenter


def sam3(folder: Path, min_score: float = 0.0, min_pixels: int = 0) -> Sam3Segmenter:
    segmenter = Sam3Segmenter(folder, "cpu")
    segmenter.min_score, segmenter.min_pixels = min_score, min_pixels
    return segmenter


def picture(height: int = 60, width: int = 80, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, size=(6, 8, 3), dtype=np.uint8)
    return coarse[np.arange(height) * 6 // height][:, np.arange(width) * 8 // width]
