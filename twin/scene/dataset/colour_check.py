"""Colour against depth and poses, before a fit: edges and brightness of a moving camera, once.

Where depth jumps an image has an edge. How edges of both lie to each other says whether colour is
shifted, late or upside down; points carried from image to image by depth and poses say which images
are brighter, which poses are off, and which images were sent twice.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from bridge.episode.reader import RawMessage
from bridge.geometry import se3
from twin.scene.dataset.geometry_search import PoseAt
from twin.scene.frames.downscaled import pixels_of
from twin.scene.frames.rgbd import Target, TrainingView
from twin.scene.frames.selection import spread

MAX_VIEWS, EDGE_VIEWS, FEWEST = 60, 24, 8
LEAST_WIDTH_PX = 100
"""Narrower images have no edges to judge."""
TURNED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "upside down": lambda image: image[::-1, ::-1],
    "mirrored": lambda image: image[:, ::-1],
}
REACH_PX = 14
"""Edges are looked for this far from where depth has them, at half size."""
GRID_PX = np.mgrid[-REACH_PX : REACH_PX + 1, -REACH_PX : REACH_PX + 1][::-1].reshape(2, -1).T
MOST_EDGES = 3000
JUMP = 0.06
"""Depths of neighbours that differ by more than this share are of two surfaces."""
GAP_PX = 7
"""Gaps in depth so wide, at half size, are the shadow of what is near, on what is behind."""
LEAST_GAIN = 1.08
"""So many times as strong an agreement of edges says that something else is true."""
SURE = 3.0
"""A delay must gain so many times what the views' differences leave open."""
SAME_PEAK_PX = 2
"""Halves of the views that say the same differ by no more, at half size."""
SHIFT_PX, LATE_S = 2.0, 0.015
"""Less, at half size, is what cameras and their calibrations do."""
DELAYS_S = np.arange(-0.2, 0.2001, 0.005)
SCALES = np.arange(0.85, 1.1501, 0.01)
LEAST_SCALE, SAME_SCALE = 0.03, 0.015
STEP_NS = 20_000_000
BLURRED = 0.78
"""With more of its gradients left after a further blur an image has no sharp edge."""
SAME_SURFACE = 0.03
BRIGHTER = 0.14
"""Logarithm of the brightness of neighbours, from which exposure jumps."""
MOVED_M, BEHIND_STAMP = 0.002, 12
"""Images between which the camera moved or turned by this much differ, from this byte on."""
FITS_AT_ALL = 0.6
"""Where less of the depth agrees, brightness of the same points says nothing."""
LOST, FITS, MORE = 0.72, 0.75, 1.25
"""Of the usual agreement: a pose with less is off, if its neighbours fit, and more so, without."""


class _Step(NamedTuple):
    """What one image says of a later one."""

    brighter: float
    """Logarithm of the brightness of the same points; 0 without any."""
    agreement: float
    """Share of the depth that is the same."""


def check_colour(
    views: Sequence[TrainingView], pose_at: PoseAt, sent: Iterable[RawMessage] = ()
) -> list[str]:
    """What is wrong with the images of one moving camera, one remark each.

    Views are in the order of time, ``pose_at`` is of a camera near by; ``sent`` are all images.
    """
    chosen = [views[k] for k in spread(np.arange(len(views)), MAX_VIEWS)]
    if len(chosen) < FEWEST or chosen[0].half.camera.width < LEAST_WIDTH_PX:
        return []
    steps = (  # one after the other: images are large, and many
        pose_at(a.publish_time_ns) - pose_at(b.publish_time_ns)
        for a, b in pairwise(sent)
        if a.data[BEHIND_STAMP:] == b.data[BEHIND_STAMP:]
    )
    copies = sum(float(np.abs(step).max()) > MOVED_M for step in steps)
    return [*_edges(chosen, pose_at), *_blur(chosen), *_sequence(chosen, copies)]


def _grey(target: Target) -> Float[np.ndarray, "height width"]:
    return np.asarray(target.planes_u8.mean(axis=0, dtype=np.float32))


def _edges(views: Sequence[TrainingView], pose_at: PoseAt) -> list[str]:
    """Shift, delay, size or turn of colour against depth, whichever makes edges meet.

    Said only where two halves of the views say the same.
    """
    some = spread(np.arange(len(views)), EDGE_VIEWS)
    slopes = [ndimage.gaussian_gradient_magnitude(_grey(view.half), 1.0) for view in views]
    edges = [np.minimum(each / max(np.quantile(each, 0.9), 1e-6), 1.0) for each in slopes]
    jumps = [_jumps_of(view.half.depth_m) for view in views]
    each = np.stack([_meeting(edges[k], jumps[k], GRID_PX) for k in some])
    maps = each.mean(axis=0)
    for word, turn in TURNED.items():
        turned = np.stack([_meeting(turn(edges[k]), jumps[k], GRID_PX) for k in some])
        if _is_sure(turned) and turned.mean(axis=0).max() > LEAST_GAIN**2 * maps.max():
            return [f"its colour images are {word} to its depth"]
    flows = np.array([_flow_px_s(view, pose_at) for view in views])
    late = np.stack([*map(_meeting, edges, jumps, flows[:, None] * DELAYS_S[:, None])])
    best, delay_s, differ_s = _best_of(late, DELAYS_S)
    gain = late[:, best] - late[:, len(DELAYS_S) // 2]
    sure = abs(delay_s) >= LATE_S and differ_s * np.median(np.hypot(*flows.T)) <= SAME_PEAK_PX
    sure &= gain.mean() > SURE * gain.std() / np.sqrt(len(gain))
    if sure and late[some, best].mean() > maps.max():
        word = "later" if delay_s > 0 else "earlier"
        return [f"its colour was taken {1e3 * abs(delay_s):.0f} ms {word} than its depth"]
    here = LEAST_GAIN * float(maps[np.abs(GRID_PX).max(axis=1) <= 1].max())
    sized = np.stack([_sized(edges[k], jumps[k]) for k in some])
    best, scale, differ = _best_of(sized, SCALES)
    larger = scale - 1.0
    if abs(larger) >= LEAST_SCALE and differ <= SAME_SCALE and sized[:, best].mean() > here:
        word = f"{100 * abs(larger):.0f} % {'larger' if larger > 0 else 'smaller'}"
        return [f"its colour is {word} than its depth has it: a wrong focal length"]
    x, y = 2 * _peak(each)
    if _is_sure(each) and maps.max() > here and np.hypot(x, y) >= 2 * SHIFT_PX:
        return [
            f"its colour lies ({x:+.0f}, {y:+.0f}) pixels beside its depth: principal point, or "
            "how the two were registered"
        ]
    return []


def _best_of(each: np.ndarray, values: np.ndarray) -> tuple[int, float, float]:
    """Where the mean of views' curves is highest, the value there, and how far halves differ."""
    best, *parts = (int(part.mean(axis=0).argmax()) for part in (each, each[::2], each[1::2]))
    return best, float(values[best]), abs(float(np.diff(values[parts])[0]))


def _is_sure(each: np.ndarray) -> bool:
    """Whether both halves of the views have their peak at one place."""
    return bool(np.abs(_peak(each[::2]) - _peak(each[1::2])).max() <= SAME_PEAK_PX)


def _peak(each: np.ndarray) -> Float[np.ndarray, "2"]:
    """Where the mean of views' maps is highest, right and down of its middle."""
    return np.asarray(GRID_PX[int(each.mean(axis=0).argmax())], dtype=np.float64)


def _flow_px_s(view: TrainingView, pose_at: PoseAt) -> Float[np.ndarray, "2"]:
    """How fast what a camera sees runs through its half-size image [px/s]."""
    target = view.half
    p = target.camera.unproject(target.depth_m)[target.depth_m > 0][::50]
    if not len(p):
        return np.zeros(2)
    before, after = (pose_at(view.stamp_ns + sign * STEP_NS) for sign in (-1, 1))
    later = se3.apply(se3.invert(after) @ before, p)
    front = later[:, 2] > 0.05
    moved = target.camera.project(later[front])[0] - target.camera.project(p[front])[0]
    return np.median(moved, axis=0) / (2e-9 * STEP_NS) if front.any() else np.zeros(2)


def _jumps_of(depth_m: Float[np.ndarray, "height width"]) -> Int[np.ndarray, "2 num_jumps"]:
    """Rows and columns of some pixels at which depth jumps."""
    filled_m = np.where(depth_m > 0, depth_m, ndimage.maximum_filter(depth_m, GAP_PX))
    near = ndimage.minimum_filter(filled_m, footprint=[[1, 1], [1, 0]], origin=-1)
    far = ndimage.maximum_filter(filled_m, footprint=[[1, 1], [1, 0]], origin=-1)
    jumps = np.array(np.nonzero((near > 0) & (far - near > JUMP * near)))
    return jumps[:, :: max(1, jumps.shape[1] // MOST_EDGES)]


def _meeting(edges: np.ndarray, jumps: np.ndarray, shifts_px: np.ndarray) -> np.ndarray:
    """How strong edges are where depth jumps, for each shift."""
    (rows, columns), steps = jumps, np.rint(shifts_px).astype(int)
    margin = int(np.abs(steps).max())
    edges = np.pad(edges, margin, mode="reflect")
    found = [edges[rows + y + margin, columns + x + margin].sum() for x, y in steps]
    return np.asarray(np.array(found) / max(len(rows), 1))


def _sized(edges: np.ndarray, jumps: np.ndarray) -> np.ndarray:
    """How strong edges are where depth jumps, were it so many times as large."""
    middle = np.array(edges.shape)[:, None, None] / 2
    places = middle + SCALES[:, None] * (jumps[:, None] - middle)
    found = ndimage.map_coordinates(edges, places, order=0, mode="reflect")
    return np.asarray(found.sum(axis=1) / max(jumps.shape[1], 1))


def _blur(views: Sequence[TrainingView]) -> list[str]:
    left = []
    for view in views[:: max(1, len(views) // 12)]:
        once = ndimage.gaussian_filter(_grey(view.full), 1.0)
        twice = ndimage.gaussian_filter(once, 1.5)
        for axis in (0, 1):
            before, after = (np.abs(np.gradient(image, axis=axis)) for image in (once, twice))
            strong = before >= np.quantile(before, 0.98)
            left.append(float(after[strong].mean() / max(float(before[strong].mean()), 1e-6)))
    worst = np.median(np.reshape(left, (-1, 2)), axis=0).max()
    return ["its images are blurred: most of them have no sharp edge"] if worst > BLURRED else []


def _sequence(views: Sequence[TrainingView], copies: int) -> list[str]:
    """Images sent twice, jumps of exposure, and poses that neither neighbour confirms."""
    steps = [_step(a, b) for a, b in pairwise(views)]
    over = [_step(a, b).agreement for a, b in zip(views, views[2:], strict=False)]
    usual = float(np.median([each.agreement for each in steps]))
    sure = [each.brighter for each in steps if each.agreement > max(FITS * usual, FITS_AT_ALL)]
    jumps = int((np.abs(sure) > BRIGHTER).sum())
    off = [
        views[k]
        for k in range(1, len(views) - 1)
        if not copies
        and max(steps[k - 1].agreement, steps[k].agreement) < min(LOST * usual, over[k - 1] / MORE)
        and over[k - 1] > FITS * usual
    ]
    told = [f"{copies} of its images are copies of the one before"] if copies else []
    if jumps > 1:
        told.append(
            f"its exposure jumps between {jumps} of {len(steps)} neighbouring images; fix it while "
            "scanning"
        )
    if off:
        told.append(
            f"the poses of {len(off)} of {len(views)} images fit neither the image before nor the "
            f"one after, the first at {off[0].stamp_ns} ns"
        )
    return told


def _step(first: TrainingView, second: TrainingView) -> _Step:
    """Carry every few points of one image into another."""
    a, b = first.half, second.half
    part = (slice(None, None, 4), slice(None, None, 4))
    known = (a.depth_m > 0)[part]
    p = a.camera.unproject(a.depth_m)[part][known]
    moved = se3.apply(se3.invert(second.T_base_color) @ first.T_base_color, p)
    row, column, inside = pixels_of(b.camera, moved)
    z, measured = moved[inside, 2], b.depth_m[row[inside], column[inside]]
    met = measured > 0
    same = met & (np.abs(measured - z) < SAME_SURFACE * z)
    mine, theirs = _grey(a)[part][known][inside], _grey(b)[row[inside], column[inside]]
    lit = same & (mine > 10) & (theirs > 10) & (mine < 245) & (theirs < 245)
    return _Step(
        brighter=float(np.median(np.log(theirs[lit] / mine[lit]))) if lit.sum() > 50 else 0.0,
        agreement=float(same.sum() / max(met.sum(), 1)),
    )
