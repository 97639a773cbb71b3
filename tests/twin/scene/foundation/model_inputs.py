"""What the tests of the models show them."""

import numpy as np

from twin.scene.foundation.loading import Placement
from twin.scene.foundation.models import Sam3Config

ALL_QUERIES = Sam3Config(min_score=0.0, min_pixels=0)
CPU = Placement(device="cpu")


def picture(height: int = 60, width: int = 80, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, size=(6, 8, 3), dtype=np.uint8)
    return coarse[np.arange(height) * 6 // height][:, np.arange(width) * 8 // width]
