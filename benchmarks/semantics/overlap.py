"""How well two masks agree."""

import numpy as np
from jaxtyping import Bool


def mask_iou(
    a: Bool[np.ndarray, "height width"], b: Bool[np.ndarray, "height width"]
) -> float | None:
    """Intersection over union; None when both are empty."""
    union = int((a | b).sum())
    return None if union == 0 else float((a & b).sum() / union)
