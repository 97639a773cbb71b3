"""Whether recorded poses and depth fit together, and if not, which reading of the poses would.

Points of one depth image are carried into another by the recorded poses. Where both cameras see
the same surface the depths must be equal; with a pose read in the wrong convention they are not.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from bridge.geometry import se3
from twin.errors import TwinError
from twin.scene.frames.thumb import Meeting, Thumb, meet
from twin.scene.learn.convention import OTHER_POSES, Convention
from twin.scene.learn.pose_report import (
    GOOD,
    MIN_OVERLAP,
    PoseReport,
    Score,
    best_of,
    is_clearly_better,
    plain_report,
    score_of,
)

MAX_PAIRS = 10
GAPS = (1, 2, 4, 8, 16)
"""Pairs are this many training frames apart."""
STILL_AGREEMENT = 0.7
"""Where this much agrees without any motion, the camera hardly moved and poses say nothing."""
SHIFT_MATTERS = 0.05
"""A unit under which cameras move less must fit better than cameras that only turn."""
OTHER_SCALES = (0.1, 10.0, 0.2, 5.0, 0.001, 1000.0)
"""Depth times this; also positions in millimetres, and TUM's depth of 1/5000 m."""


class PoseConventionError(TwinError):
    """Poses fit the depth only when they are read in another way."""


class MovedCameraError(TwinError):
    """A camera moved while its poses say that it stood still."""


def check_poses(thumbs: Sequence[Thumb]) -> PoseReport:
    """Carry depth between frames of one camera under every convention.

    Args:
        thumbs: Small depth images in time order, with poses as recorded.
    """
    pairs = list(_informative(thumbs))
    if not pairs:
        return PoseReport(num_pairs=0, agreement=None, overlap=0.0)
    recorded = _score(pairs, Convention())
    plain = plain_report(len(pairs), recorded)
    better, score = _best(pairs)
    if not is_clearly_better(score, plain):
        return plain
    if better.depth_scale > 1.0:
        turned_only = _score(pairs, replace(better, depth_scale=1e9)).agreement
        if score < turned_only + SHIFT_MATTERS:
            return plain
    return replace(plain, agreement=recorded.agreement, better=better, better_agreement=score)


def still_agreement(thumbs: Sequence[Thumb]) -> float | None:
    """Share of the depth that stays the same in the images of a camera said to stand still.

    The median over all pairs: a robot that passes by once does not count. None when no two images
    measured the same place.
    """
    found = []
    for first, second in combinations(thumbs, 2):
        met = meet(first, second, se3.invert(second.T_base_depth) @ first.T_base_depth)
        if met.overlap >= MIN_OVERLAP:
            found.append(met.agreement)
    return float(np.median(found)) if found else None


def _best(pairs: list[tuple[Thumb, Thumb]]) -> tuple[Convention, float]:
    """The best other convention: one thing wrong if that explains it, else a wrong unit too."""
    units = [Convention(depth_scale=scale) for scale in OTHER_SCALES]
    best = best_of([*OTHER_POSES, *units], lambda convention: _score(pairs, convention))
    if best[1] >= GOOD:
        return best
    both = [replace(r, depth_scale=scale) for r, scale in product(OTHER_POSES, OTHER_SCALES)]
    some = pairs[:: max(1, len(pairs) // 4)]
    also = best_of(both, lambda convention: _score(some, convention))
    return max(best, also, key=lambda item: item[1])


def _score(pairs: list[tuple[Thumb, Thumb]], convention: Convention) -> Score:
    return score_of([_met(first, second, convention) for first, second in pairs])


def _met(first: Thumb, second: Thumb, convention: Convention) -> Meeting:
    T_second_first = se3.invert(convention.read(second.T_base_depth)) @ convention.read(
        first.T_base_depth
    )
    if convention.depth_scale != 1.0:  # the same as moving by the inverse, up to the tolerance
        T_second_first[:3, 3] /= convention.depth_scale
    return meet(first, second, T_second_first)


def _informative(thumbs: Sequence[Thumb]) -> Iterator[tuple[Thumb, Thumb]]:
    """Pairs of frames whose images show that the camera moved; both directions of time alike."""
    found = 0
    for gap in GAPS:
        starts = range(0, len(thumbs) - gap, max(1, (len(thumbs) - gap) // MAX_PAIRS))
        for start in starts:
            first, second = thumbs[start], thumbs[start + gap]
            met = meet(first, second, np.eye(4))
            if not first.depth_m.any() or not second.depth_m.any():
                continue
            if met.agreement < STILL_AGREEMENT:
                yield first, second
                found += 1
        if found >= MAX_PAIRS:
            return
