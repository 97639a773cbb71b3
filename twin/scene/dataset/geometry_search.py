"""Which one number of the geometry is wrong: depth scale, focal length, or when poses were taken.

Depth of one image is carried into others while one number is changed and the rest stays as
recorded. Where much more of it then falls on what the others measured, that number is off, and
the best value says by how much. Never more than one number is changed: two together explain
almost anything.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.geometry import se3
from twin.errors import TwinError
from twin.scene.dataset.scan_check import CameraCheck, ScanReport
from twin.scene.frames.downscaled import DownscaledDepth, pixels_of, thinned_camera
from twin.scene.frames.pairing import paired_stamps_ns
from twin.scene.frames.selection import FrameChoice, spread
from twin.scene.settings import FrameConfig

FACTORS = np.geomspace(0.4, 2.5, 25)
"""Depth scales and focal lengths that are tried first."""
UNITS = (0.001, 0.1, 0.2, 5.0, 10.0, 1000.0)
"""Depth scales of a wrong unit; also of positions in millimetres, and of TUM's 1/5000 m."""
SHIFT_MATTERS = 0.05
"""A unit under which cameras move less must fit better than cameras that only turn."""
MOST_LATE_FRAMES = 8
LEAST_LEFT = 1 / 3
"""Share of the pairs that have to lie within the recording when poses are moved in time."""
REFINEMENTS = 8
"""Halvings of the step around the best."""
GAPS = (1, 2, 4, 8, 16, 32)
"""Pairs are this many frames apart: far ones say most of scale, near ones of time."""
MAX_PAIRS = 48
MAX_COLUMNS = 48
SIGMA = 0.01
"""Depths that differ by this share of the distance count exp(-1/2)."""
LEAST_OVERLAP = 0.15
"""Of what one image measured, on measurements of the other; readings with less do not count."""
ENOUGH = 0.9
"""With this agreement nothing is looked for."""
LEAST_GAIN = 0.01
"""A number is wrong when this much more of the depth agrees with another."""
CLEARLY_BETTER = 0.2
"""It is refused when this much more agrees."""
LEAST_AGREEMENT = 0.35
"""With less agreement even at the best, one number does not explain it."""
SMALLEST = {"depth": 0.03, "focal": 0.03, "delay": 0.6}
"""Deviations below are within what cameras and clocks do; of the delay in frames."""
MENDED = {
    "depth": "Import it again with another --depth-unit-m or with positions in metres, or set the "
    "unit of the camera's driver",
    "focal": "Import it again with --depth-intrinsics, or correct what the driver sends",
    "delay": "Record images and poses by one clock",
}
"""What to do."""

PoseAt = Callable[[int], Float[np.ndarray, "4 4"]]
"""``T_base_depth`` of the camera at an instant."""


@dataclass(frozen=True, kw_only=True)
class Correction:
    """One number that makes depth agree."""

    kind: str
    """``depth``, ``focal`` or ``delay``."""
    value: float
    """True over recorded: of depth, of focal length; how late the poses are, in nanoseconds."""
    frames: float
    """Of the delay, in frames of the camera; else 0."""
    before: float
    """How much of the depth agrees as recorded, 0..1."""
    after: float

    def describe(self) -> str:
        """What is wrong, with the agreement before and after."""
        if self.kind == "depth":
            far = "far" if self.value < 1 else "near"
            text = f"its depth reads {1 / self.value:.3g} x the true one, too {far}"
        elif self.kind == "focal":
            text = f"its focal length is {1 / self.value:.3g} x the true one"
        else:
            late = f"{'late' if self.value > 0 else 'early'} ({abs(self.value) / 1e6:.0f} ms)"
            text = f"its poses are {abs(self.frames):.1f} frames {late}"
        return (
            f"{text}: of the depth {100 * self.before:.0f} % agrees to about {100 * SIGMA:.0f} % "
            f"as recorded, {100 * self.after:.0f} % without that"
        )


def search_geometry(
    images: Sequence[DownscaledDepth], pose_at: PoseAt | None = None, frame_ns: int = 0
) -> Correction | None:
    """The one number whose change makes depth agree clearly better, or None.

    Args:
        images: Small depth images of one moving camera in time order, with poses as recorded.
        pose_at: Where the camera was at other instants; None: no delay is looked for.
    """
    pairs = _pairs(images)
    if len(pairs) < 3:
        return None
    recorded = _agreement(pairs)
    if recorded >= ENOUGH:
        return None
    tried: dict[str, tuple[np.ndarray, Callable[[float], float]]] = {
        "depth": (np.log([*FACTORS, *UNITS]), lambda x: _agreement(pairs, depth=float(np.exp(x)))),
        "focal": (np.log(FACTORS), lambda x: _agreement(pairs, focal=float(np.exp(x)))),
    }
    if pose_at is not None and frame_ns > 0:
        late = partial(_agreement_late, pairs, pose_at, (images[0].stamp_ns, images[-1].stamp_ns))
        steps = np.arange(-MOST_LATE_FRAMES, MOST_LATE_FRAMES + 1.0)
        tried["delay"] = steps, lambda frames: late(frames * frame_ns)
    climbed = {kind: _climbed(*each) for kind, each in tried.items()}
    kind, (at, after) = max(climbed.items(), key=lambda item: item[1][1])
    is_clear = after >= recorded + LEAST_GAIN and after >= LEAST_AGREEMENT
    if kind == "depth" and at > np.log(FACTORS[-1]):
        is_clear &= after >= _agreement(pairs, depth=1e9) + SHIFT_MATTERS
    if not is_clear or abs(at) < SMALLEST[kind]:
        return None
    value, frames = (at * frame_ns, at) if kind == "delay" else (float(np.exp(at)), 0.0)
    return Correction(kind=kind, value=value, frames=frames, before=recorded, after=after)


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """Some points of one image and all depth of another."""

    first: DownscaledDepth
    second: DownscaledDepth

    def agreement(self, depth: float, focal: float) -> tuple[float, float]:
        """Share of the overlap that agrees, and the overlap."""
        T_second_first = se3.invert(self.second.T_base_depth) @ self.first.T_base_depth
        first, second = (
            replace(image.camera, fx=image.camera.fx * focal, fy=image.camera.fy * focal)
            for image in (self.first, self.second)
        )
        z = depth * self.first.depth_m.astype(np.float64)
        p = se3.apply(T_second_first, first.unproject(z)[z > 0])
        row, column, inside = pixels_of(second, p)
        measured = depth * self.second.depth_m[row[inside], column[inside]]
        met = measured > 0
        if not met.any():
            return 0.0, 0.0
        off = p[inside, 2][met] / measured[met] - 1.0
        return float(np.exp(-0.5 * (off / SIGMA) ** 2).mean()), float(met.sum() / len(p))


def _agreement(pairs: Sequence[_Pair], depth: float = 1.0, focal: float = 1.0) -> float:
    """Agreement over pairs by their overlap; 0 where views hardly meet."""
    shares, overlaps = np.array([pair.agreement(depth, focal) for pair in pairs]).T
    if overlaps.mean() < LEAST_OVERLAP:
        return 0.0
    return float(np.average(shares, weights=overlaps))


def _agreement_late(
    pairs: Sequence[_Pair], pose_at: PoseAt, ends_ns: tuple[int, int], late_ns: float
) -> float:
    """The same with poses that were stated this much too late.

    Beyond the ends of a recording its camera stands still, which agrees with anything: pairs that
    would come to lie there do not count.
    """

    def moved(image: DownscaledDepth) -> DownscaledDepth:
        return replace(image, T_base_depth=pose_at(image.stamp_ns + round(late_ns)))

    kept = [
        _Pair(first=moved(pair.first), second=moved(pair.second))
        for pair in pairs
        if all(
            ends_ns[0] <= image.stamp_ns + late_ns <= ends_ns[1]
            for image in (pair.first, pair.second)
        )
    ]
    return _agreement(kept) if len(kept) >= LEAST_LEFT * len(pairs) else 0.0


def _climbed(
    grid: Float[np.ndarray, " num_steps"], score: Callable[[float], float]
) -> tuple[float, float]:
    """The best place: on a grid first, then with ever smaller steps around the best."""
    scores = [score(float(x)) for x in grid]
    at, best = float(grid[int(np.argmax(scores))]), max(scores)
    for step in (float(grid[1] - grid[0]) / 2**k for k in range(1, REFINEMENTS + 1)):
        for x in (at - step, at + step):
            found = score(x)
            if found > best:
                at, best = x, found
    return at, best


def _pairs(images: Sequence[DownscaledDepth]) -> list[_Pair]:
    """Pairs near in time and farther apart, so that small and large motions count."""
    pairs = [
        _Pair(first=_thinned(images[start]), second=images[start + gap])
        for gap in GAPS
        for start in range(len(images) - gap)
        if images[start].depth_m.any() and images[start + gap].depth_m.any()
    ]
    return [pairs[index] for index in spread(np.arange(len(pairs)), MAX_PAIRS)]


def _thinned(image: DownscaledDepth) -> DownscaledDepth:
    step = max(1, round(image.camera.width / MAX_COLUMNS))
    return replace(
        image, camera=thinned_camera(image.camera, step), depth_m=image.depth_m[::step, ::step]
    )


class WrongGeometryError(TwinError):
    """One number of a camera's geometry is off."""


def check_geometry(
    cameras: Sequence[CameraCheck], report: ScanReport, config: FrameConfig
) -> ScanReport:
    """Look for a wrong number in each moving camera; WrongGeometryError, or a remark."""
    remarks = []
    for camera in cameras:
        choice, poses = camera.choice, report.poses.get(camera.name)
        if choice.stationary or poses is None or poses.better is not None:
            continue
        images = sorted(camera.images, key=lambda image: image.stamp_ns)
        stamps = sorted(paired_stamps_ns(choice.episode, choice.camera_id))
        frame_ns = int(np.median(np.diff(stamps))) if len(stamps) > 1 else 0
        found = search_geometry(images, camera_pose_at(choice), frame_ns)
        if found is None:
            continue
        message = f"{camera.name}: {found.describe()}. {MENDED[found.kind]}"
        if config.check_poses and found.after >= found.before + CLEARLY_BETTER:
            raise WrongGeometryError(f"{message}, or insist with --no-check-poses.")
        remarks.append(message)
    return replace(report, found=(*report.found, *remarks))


def camera_pose_at(choice: FrameChoice) -> PoseAt:
    """Where a choice's poses put its depth camera at any instant."""
    frame_id = streams.camera_info(choice.episode, choice.camera_id, "depth").frame_id
    return lambda stamp_ns: choice.poses.tree.T_root_frame(frame_id, stamp_ns)
