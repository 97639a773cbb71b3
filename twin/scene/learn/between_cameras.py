"""Whether a camera that stands still sees things where cameras that move see them.

Its own images say nothing of its pose: they agree wherever it is believed to be. What a moving
camera measured is carried into them instead.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.scene.frames.thumb import Thumb, meet
from twin.scene.learn.pose_check import (
    AXES,
    CLEARLY_BETTER,
    GOOD,
    MIN_OVERLAP,
    ORDERS,
    SOLID_OVERLAP,
    Convention,
    PoseReport,
)

MAX_OTHERS = 12
"""Images of other cameras that are carried over."""
READINGS = tuple(
    Convention(order=order, inverse=inverse, axes=axes)
    for order, inverse, axes in product(ORDERS, (False, True), AXES)
)


def check_between(own: Sequence[Thumb], others: Sequence[Thumb]) -> PoseReport:
    """Carry the depth of moving cameras into one that stands still, however its pose is read.

    Args:
        own: Of the camera that stands still.
        others: Of moving cameras whose poses fit their own depth.

    Returns:
        No agreement when there is nothing to compare with, or when no reading of its pose lets the
        camera see what the others saw: it may look at another place.
    """
    first = next((thumb for thumb in own if thumb.depth_m.any()), None)
    places = np.unique(np.linspace(0, len(others) - 1, min(len(others), MAX_OTHERS)).round())
    chosen = [others[int(place)] for place in places]
    if first is None or not chosen:
        return PoseReport(num_pairs=0, agreement=None, overlap=0.0)
    recorded, overlap = _seen_alike(first, chosen, first.T_base_depth)
    meets = overlap >= MIN_OVERLAP
    plain = PoseReport(
        num_pairs=len(chosen), agreement=recorded if meets else None, overlap=overlap
    )
    if meets and recorded >= GOOD:
        return plain
    scored = []
    for reading in READINGS[1:]:
        agreement, share = _seen_alike(first, chosen, reading.read(first.T_base_depth))
        scored.append((agreement if share >= SOLID_OVERLAP else 0.0, reading))
    score, better = max(scored, key=lambda item: item[0])
    if score < GOOD or (meets and score < recorded + CLEARLY_BETTER):
        return plain
    return PoseReport(
        num_pairs=len(chosen),
        agreement=recorded,
        overlap=overlap,
        better=better,
        better_agreement=score,
    )


def _seen_alike(
    own: Thumb, others: Sequence[Thumb], T_base_own: Float[np.ndarray, "4 4"]
) -> tuple[float, float]:
    """Agreement and overlap of all others; they count by their overlap."""
    T_own_base = se3.invert(T_base_own)
    met = [meet(other, own, T_own_base @ other.T_base_depth) for other in others]
    total = sum(item.overlap for item in met)
    agreed = sum(item.agreement * item.overlap for item in met)
    return (agreed / total if total > 0 else 0.0), total / len(others)
