"""What the tests of the models show them."""

from pathlib import Path

import numpy as np

from twin.scene.foundation.models import Sam3Config, Sam3Segmenter

ALL_QUERIES = Sam3Config(min_score=0.0, min_pixels=0)


def sam3(folder: Path, config: Sam3Config = ALL_QUERIES) -> Sam3Segmenter:
    segmenter = Sam3Segmenter(folder, "cpu")
    segmenter.config = config
    return segmenter


def picture(height: int = 60, width: int = 80, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, size=(6, 8, 3), dtype=np.uint8)
    return coarse[np.arange(height) * 6 // height][:, np.arange(width) * 8 // width]
