"""Whether a camera that stands still sees things where cameras that move see them.

Its own images say nothing of its pose: they agree wherever it is believed to be. What a moving
camera measured is carried into them instead.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.scene.frames.thumb import Thumb, meet
from twin.scene.learn.convention import OTHER_POSES
from twin.scene.learn.pose_report import (
    PoseReport,
    Score,
    best_of,
    is_clearly_better,
    plain_report,
    score_of,
)

MAX_OTHERS = 12
"""Images of other cameras that are carried over."""


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
    T_base_first = first.T_base_depth
    recorded = _seen_alike(first, chosen, T_base_first)
    plain = plain_report(len(chosen), recorded)
    if plain.is_sure:
        return plain
    better, score = best_of(
        OTHER_POSES, lambda reading: _seen_alike(first, chosen, reading.read(T_base_first))
    )
    if not is_clearly_better(score, plain):
        return plain
    return replace(plain, agreement=recorded.agreement, better=better, better_agreement=score)


def _seen_alike(own: Thumb, others: Sequence[Thumb], T_base_own: Float[np.ndarray, "4 4"]) -> Score:
    T_own_base = se3.invert(T_base_own)
    return score_of([meet(other, own, T_own_base @ other.T_base_depth) for other in others])
