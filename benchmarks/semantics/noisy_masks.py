"""Masks as a 2D segmenter may deliver them: bled, shrunk, shifted, missing, wrongly named."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from twin.scene.semantics.result import Mask, MaskSet

GROW_PX = 5
SHIFT_PX = 2
DROPPED_FRACTION = 0.15
WRONG_FRACTION = 0.05


def spoil(masks: MaskSet, names: Sequence[str], rng: np.random.Generator) -> MaskSet:
    """Grow or shrink each mask by 5 px, shift it by up to 2, drop 15 %, misname 5 %."""
    kept = []
    for mask in masks.masks:
        if rng.random() < DROPPED_FRACTION:
            continue
        image = mask.image
        steps = GROW_PX if rng.random() < 0.5 else -GROW_PX
        if steps > 0:
            image = ndimage.binary_dilation(image, iterations=steps)
        else:
            image = ndimage.binary_erosion(image, iterations=-steps)
        shift = rng.integers(-SHIFT_PX, SHIFT_PX + 1, 2)
        image = np.roll(image, tuple(shift), axis=(0, 1))
        label = mask.label
        if rng.random() < WRONG_FRACTION:
            label = str(rng.choice([name for name in names if name != label]))
        if image.any():
            kept.append(Mask(image=np.asarray(image), label=label, score=float(mask.score)))
    order = rng.permutation(len(kept))
    return MaskSet(
        camera_id=masks.camera_id,
        stamp_ns=masks.stamp_ns,
        masks=tuple(kept[k] for k in order),
        source="spoilt truth",
    )
