"""Things that do not depend on the size of voxels.

Where one thing ends and the next begins is decided by thresholds, and a grid that lies a little
differently decides otherwise. So the segmenter looks several times, with voxels of other sizes, and
what it finds again most times is a thing (as Matas et al. 2002 choose regions that stay when a
threshold moves).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from twin.scene.semantics.cluster import SurfacePoints
from twin.scene.semantics.segment import Look, Segmentation, SegmentConfig, ground_of

VOXEL_SCALES = (0.9, 1.0, 1.12, 1.25, 1.4, 1.6)
"""Of the voxels that the spacing of the points asks for."""
SAME_IOU = 0.6
"""Two things are one when they share this much of their union."""
MIN_SHARE = 0.5
"""Of the other looks that have to find a thing again."""
MAX_TAKEN = 0.3
"""Share of a thing that a stabler one may have."""


@dataclass(frozen=True, kw_only=True)
class _Found:
    """One thing of one look, and how well the other looks agree."""

    mask: Bool[np.ndarray, " num_points"]
    voxel_m: float
    share: float
    """Of the other looks that found it again."""
    agreement: float
    """Mean of the best IoU in each of them."""


def segment_stably(
    points: SurfacePoints,
    config: SegmentConfig,
) -> Segmentation:
    """Find the things that most sizes of voxels find, the largest first."""
    ground = ground_of(points, config)
    looks = [ground.look(scale) for scale in VOXEL_SCALES]
    stable = sorted(
        (item for item in _all_found(looks) if item.share >= MIN_SHARE),
        key=lambda item: -(item.share + item.agreement),
    )
    kept: list[tuple[np.ndarray, _Found]] = []
    taken = np.zeros(len(points), dtype=bool)
    for item in stable:
        if taken[item.mask].mean() <= MAX_TAKEN:
            kept.append((item.mask & ~taken, item))
            taken |= item.mask
    kept.sort(key=lambda pair: -int(pair[0].sum()))
    labels = np.zeros(len(points), dtype=np.int64)
    for number, (mask, _) in enumerate(kept, start=1):
        labels[mask] = number
    things = tuple(ground.thing(item.mask, item.voxel_m) for _, item in kept)
    remark = "" if things else _why_none(looks, ground.nothing)
    return Segmentation(labels=labels, things=things, plane=ground.plane, remark=remark)


def _why_none(looks: list[Look], nothing: str) -> str:
    if not looks[0].labels.any():
        return nothing
    return f"of what stands out, no two of {len(looks)} sizes of voxels find the same"


def _all_found(looks: list[Look]) -> Iterator[_Found]:
    sizes = [np.bincount(look.labels) for look in looks]
    for look, own in zip(looks, sizes, strict=True):
        others = [(o, size) for o, size in zip(looks, sizes, strict=True) if o is not look]
        for number in range(1, len(own)):
            mask = look.labels == number
            best = np.array([_best_iou(mask, other, size) for other, size in others])
            yield _Found(
                mask=mask,
                voxel_m=look.voxel_m,
                share=float((best >= SAME_IOU).mean()),
                agreement=float(best.mean()),
            )


def _best_iou(mask: np.ndarray, other: Look, sizes: np.ndarray) -> float:
    shared = np.bincount(other.labels[mask], minlength=len(sizes))
    iou = shared / (mask.sum() + sizes - shared)
    return float(iou[1:].max(initial=0.0))
