"""Whether recorded poses and depth fit together, and if not, which reading of the poses would.

Points of one depth image are carried into another by the recorded poses. Where both cameras see
the same surface the depths must be equal; with a pose read in the wrong convention they are not.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.errors import TwinError
from twin.scene.frames.thumb import Thumb, meet

MAX_PAIRS = 10
GAPS = (1, 2, 4, 8, 16)
"""Pairs are this many training frames apart."""
STILL_AGREEMENT = 0.7
"""Where this much agrees without any motion, the camera hardly moved and poses say nothing."""
GOOD = 0.5
"""With this share of the overlap agreeing, poses and depth belong together."""
CLEARLY_BETTER = 0.2
SHIFT_MATTERS = 0.05
"""A unit under which cameras move less must fit better than cameras that only turn."""
MIN_OVERLAP = 0.05
"""With less, depth says nothing about the poses."""
SOLID_OVERLAP = 0.2
"""Frames near in time overlap at least by this much if their poses are read rightly."""

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
BODY_AXES = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""``T_body_optical`` of ROS: body x forward, y left, z up; optical z forward, x right, y down."""
ORDERS = {
    "": (0, 1, 2, 3),
    "quaternions written as w x y z were read as x y z w": (1, 2, 3, 0),
    "quaternions written as x y z w were read as w x y z": (3, 0, 1, 2),
}
"""Where the true w, x, y, z are found in the w, x, y, z that were read."""
AXES = {
    "": np.eye(4),
    "the camera looks along -z with y up (OpenGL axes)": FLIP_YZ,
    "the camera frame is a body frame (x forward, y left, z up)": BODY_AXES,
}
SCALES = (1.0, 0.1, 10.0, 0.2, 5.0, 0.001, 1000.0)
"""Depth times this; also positions in millimetres, and TUM's depth of 1/5000 m."""


class PoseConventionError(TwinError):
    """Poses fit the depth only when they are read in another way."""


class MovedCameraError(TwinError):
    """A camera moved while its poses say that it stood still."""


@dataclass(frozen=True, kw_only=True)
class Convention:
    """One way of reading poses and depth."""

    order: str = ""
    inverse: bool = False
    axes: str = ""
    depth_scale: float = 1.0

    def describe(self) -> str:
        """Say what differs from our own reading."""
        parts = [self.order, self.axes]
        if self.inverse:
            parts.append("they are world-to-camera, not camera-to-world")
        if self.depth_scale != 1.0:
            parts.append(
                f"depth is to be multiplied by {self.depth_scale:g} "
                f"(or positions by {1 / self.depth_scale:g})"
            )
        return " and ".join(part for part in parts if part) or "as recorded"

    def read(self, T_as_read: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Turn a pose as we read it into ``T_base_camera`` as this convention means it."""
        q, p = se3.split(T_as_read)
        T = se3.transform_from(q[list(ORDERS[self.order])], p)
        return np.asarray((se3.invert(T) if self.inverse else T) @ AXES[self.axes])


@dataclass(frozen=True, kw_only=True)
class PoseReport:
    """What the depth says about the poses of one camera."""

    num_pairs: int
    """Pairs of frames between which the camera visibly moved; 0: nothing could be checked."""
    agreement: float | None
    """Share of the overlapping depth that agrees under the recorded poses."""
    overlap: float
    """Share of a frame's measurements that another frame sees too; mean over pairs."""
    better: Convention | None = None
    better_agreement: float | None = None
    """A convention under which they clearly fit, where the recorded one does not."""

    @property
    def fits(self) -> bool:
        """Whether the recorded poses can be believed as far as the depth tells."""
        return self.agreement is None or self.agreement >= GOOD

    @property
    def is_sure(self) -> bool:
        """Whether depth was there to judge them by, and they fit."""
        return self.agreement is not None and self.fits

    def remark(self) -> str:
        """One sentence about what is wrong; empty when nothing is."""
        if self.better is not None and self.better_agreement is not None:
            return (
                f"only {100 * (self.agreement or 0.0):.0f} % of the depth agrees between views, "
                f"but {100 * self.better_agreement:.0f} % would under another reading: "
                f"{self.better.describe()}"
            )
        if self.agreement is not None and not self.fits:
            return (
                f"only {100 * self.agreement:.0f} % of the depth agrees between views, and no "
                "known convention makes it better: wrong poses, clocks that differ, or a scene "
                "that moved"
            )
        if self.num_pairs and self.overlap < MIN_OVERLAP:
            return "its views hardly overlap: poses cannot be checked, and edges will not meet"
        return ""


def check_poses(thumbs: Sequence[Thumb]) -> PoseReport:
    """Carry depth between frames of one camera under every convention.

    Args:
        thumbs: Small depth images in time order, with poses as recorded.
    """
    pairs = list(_informative(thumbs))
    if not pairs:
        return PoseReport(num_pairs=0, agreement=None, overlap=0.0)
    recorded, overlap = _score(pairs, Convention())
    plain = PoseReport(
        num_pairs=len(pairs),
        agreement=recorded if overlap >= MIN_OVERLAP else None,
        overlap=overlap,
    )
    best, score = _best(pairs)
    if score < GOOD or score < (recorded if overlap >= MIN_OVERLAP else 0.0) + CLEARLY_BETTER:
        return plain
    if best.depth_scale > 1.0:
        turned_only, _ = _score(pairs, replace(best, depth_scale=1e9))
        if score < turned_only + SHIFT_MATTERS:
            return plain
    return PoseReport(
        num_pairs=len(pairs),
        agreement=recorded,
        overlap=overlap,
        better=best,
        better_agreement=score,
    )


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
    readings = [
        Convention(order=order, inverse=inverse, axes=axes)
        for order, inverse, axes in product(ORDERS, (False, True), AXES)
    ]
    units = [Convention(depth_scale=scale) for scale in SCALES[1:]]
    best = _best_of(pairs, readings[1:] + units)
    if best[1] >= GOOD:
        return best
    both = [
        Convention(order=r.order, inverse=r.inverse, axes=r.axes, depth_scale=scale)
        for r, scale in product(readings[1:], SCALES[1:])
    ]
    return max(best, _best_of(pairs[:: max(1, len(pairs) // 4)], both), key=lambda item: item[1])


def _best_of(
    pairs: list[tuple[Thumb, Thumb]], conventions: Sequence[Convention]
) -> tuple[Convention, float]:
    scored = []
    for convention in conventions:
        agreement, overlap = _score(pairs, convention)
        scored.append((convention, agreement if overlap >= SOLID_OVERLAP else 0.0))
    return max(scored, key=lambda item: item[1])


def _score(pairs: list[tuple[Thumb, Thumb]], convention: Convention) -> tuple[float, float]:
    """Agreement and overlap of all pairs; pairs count by their overlap."""
    agreed, overlaps = 0.0, []
    for first, second in pairs:
        T_second_first = se3.invert(convention.read(second.T_base_depth)) @ convention.read(
            first.T_base_depth
        )
        if convention.depth_scale != 1.0:  # the same as moving by the inverse, up to the tolerance
            T_second_first[:3, 3] /= convention.depth_scale
        met = meet(first, second, T_second_first)
        agreed += met.agreement * met.overlap
        overlaps.append(met.overlap)
    total = sum(overlaps)
    return (agreed / total if total > 0 else 0.0), total / len(pairs)


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
