"""Depth of posed colour images from each other: plane sweep, semi-global smoothing, agreement.

Planes parallel to an image are tried at many distances (Collins 1996); at the right one the other
images look alike there. Differences of brightness and of its slopes are averaged over the views
that agree better, smoothed along four directions (Hirschmueller 2008), and a distance is kept only
where the depths of other images confirm it. What is flat in colour and confirmed by nobody stays
unknown.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy import ndimage

from bridge.geometry import se3
from bridge.geometry.camera import Camera

WORK_WIDTH_PX = 320
"""Images are swept at this width or below."""
NUM_DEPTHS = 96
NUM_REFERENCES = 4
BEST_RATIO = 0.12
"""Baseline divided by distance that measures best: more is hidden by perspective, less measures
nothing."""
RATIOS = (0.02, 0.8)
SAME_WAY = 0.5
"""Cosine between the axes of views that can be compared."""
MOST_APART = 0.15
"""Brightness that differs by more is simply different."""
WINDOW_PX = 5
SMALL_STEP, LARGE_STEP = 0.01, 0.06
"""Cost of a neighbour one distance farther, and of any other."""
EDGE = 0.08
"""Brightness between neighbours at which a large step costs half."""
AGREE_FRACTION, AGREE_STEPS = 0.02, 0.75
"""Depths agree within this share, or this part of the step between two planes."""
CONFIRMED_BY = 2
SPECKLE_PX = 40
"""Confirmed patches smaller than this are left out."""


@dataclass(frozen=True, kw_only=True)
class PosedView:
    """One colour image, where it was taken, at the size that is swept."""

    camera: Camera
    T_world_camera: Float[np.ndarray, "4 4"]
    features: Float32[np.ndarray, "3 height width"]
    """Brightness and its two slopes."""


def posed_view(
    image_u8: UInt8[np.ndarray, "height width 3"],
    camera: Camera,
    T_world_camera: Float[np.ndarray, "4 4"],
) -> PosedView:
    """Prepare an image: smaller, grey, with slopes."""
    factor = max(1, -(-camera.width // WORK_WIDTH_PX))
    height, width = (side // factor for side in image_u8.shape[:2])
    part = image_u8[: height * factor, : width * factor].astype(np.float32).mean(axis=2) / 255.0
    grey = part.reshape(height, factor, width, factor).mean(axis=(1, 3))
    smooth = ndimage.gaussian_filter(grey, 0.6)
    slopes = [0.5 * ndimage.convolve1d(smooth, [1, 0, -1], axis=axis) for axis in (1, 0)]
    work = Camera(
        width=width, height=height, fx=camera.fx / factor, fy=camera.fy / factor,
        cx=camera.cx / factor, cy=camera.cy / factor,
    )  # fmt: skip
    features = np.stack([smooth, *slopes]).astype(np.float32)
    return PosedView(camera=work, T_world_camera=T_world_camera, features=features)


def sweep(
    views: Sequence[PosedView],
    near: float,
    far: float,
    advance: Callable[[int], None] = lambda done: None,
) -> list[Float32[np.ndarray, "height width"]]:
    """Depth along the axis of each view, 0 where it is not known."""
    inverse = np.linspace(1.0 / far, 1.0 / near, NUM_DEPTHS)
    references = [choose_references(index, views, near, far) for index in range(len(views))]
    found = []
    for view, chosen in zip(views, references, strict=True):
        found.append(_swept(view, [views[k] for k in chosen], inverse))
        advance(len(found))
    step = AGREE_STEPS * float(inverse[1] - inverse[0])
    return [
        _confirmed(index, chosen, views, found, step) for index, chosen in enumerate(references)
    ]


def choose_references(index: int, views: Sequence[PosedView], near: float, far: float) -> list[int]:
    """Views that look the same way from the best distance, best first."""
    own = views[index].T_world_camera
    typical = np.sqrt(near * far)
    Ts = np.stack([view.T_world_camera for view in views])
    ratio = np.linalg.norm(Ts[:, :3, 3] - own[:3, 3], axis=1) / typical
    usable = (ratio > RATIOS[0]) & (ratio < RATIOS[1]) & (Ts[:, :3, 2] @ own[:3, 2] > SAME_WAY)
    usable[index] = False
    worth = np.abs(np.log(np.maximum(ratio, 1e-9) / BEST_RATIO))
    candidates = np.flatnonzero(usable)
    return [int(k) for k in candidates[np.argsort(worth[candidates], kind="stable")]][
        :NUM_REFERENCES
    ]


def _swept(
    view: PosedView, references: Sequence[PosedView], inverse: Float[np.ndarray, " num_depths"]
) -> Float32[np.ndarray, "height width"]:
    height, width = view.features.shape[1:]
    if not references:
        return np.zeros((height, width), dtype=np.float32)
    cost = np.empty((len(inverse), height, width), dtype=np.float32)
    rays = np.ascontiguousarray(view.camera.rays().reshape(-1, 3).T.astype(np.float32))
    for index, value in enumerate(inverse):
        each = np.stack([_difference(view, other, rays, 1.0 / value) for other in references])
        better = np.sort(each, axis=0)[: -(-len(references) // 2)].mean(axis=0)
        cost[index] = ndimage.uniform_filter(better, size=WINDOW_PX)
    total = _smoothed(cost, view.features[0])
    return _least(total, inverse)


def _difference(
    view: PosedView,
    other: PosedView,
    rays: Float32[np.ndarray, "3 num_pixels"],
    depth: float,
) -> Float32[np.ndarray, "height width"]:
    """How much a view differs from another where a plane at one depth appears in it."""
    T = (se3.invert(other.T_world_camera) @ view.T_world_camera).astype(np.float32)
    height, width = other.features.shape[1:]
    x, y, z = (T[:3, :3] * np.float32(depth)) @ rays + T[:3, 3:]
    inverse = 1.0 / np.maximum(z, np.float32(1e-6))
    u = np.float32(other.camera.fx) * x * inverse + np.float32(other.camera.cx - 0.5)
    v = np.float32(other.camera.fy) * y * inverse + np.float32(other.camera.cy - 0.5)
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    u *= inside
    v *= inside
    flat = u.astype(np.int32)
    a = u - flat
    b = v - np.floor(v)
    flat += v.astype(np.int32) * np.int32(width)
    total = np.zeros(len(z), dtype=np.float32)
    for own, plane in zip(view.features, other.features, strict=True):
        seen = plane.ravel()
        top, bottom = seen.take(flat), seen.take(flat + width)
        top += a * (seen.take(flat + 1) - top)
        bottom += a * (seen.take(flat + (width + 1)) - bottom)
        bottom -= top
        bottom *= b
        bottom += top
        bottom -= own.ravel()
        total += np.abs(bottom)
    total = np.where(inside, np.minimum(total, MOST_APART), np.float32(MOST_APART))
    return np.asarray(total.reshape(view.features.shape[1:]))


def _smoothed(
    cost: Float32[np.ndarray, "num_depths height width"], grey: Float32[np.ndarray, "height width"]
) -> Float32[np.ndarray, "num_depths height width"]:
    """Semi-global: the least cost of a way through the image that ends here, from four sides."""
    total = np.zeros_like(cost)
    for axis in (1, 2):
        for backwards in (False, True):
            turned = np.moveaxis(cost, axis, 0)
            shade = np.moveaxis(grey, axis - 1, 0)
            out = np.moveaxis(total, axis, 0)
            order = range(len(turned) - 1, -1, -1) if backwards else range(len(turned))
            before: np.ndarray | None = None
            last = 0
            for line in order:
                own = turned[line]
                if before is not None:
                    step = LARGE_STEP / (1.0 + np.abs(shade[line] - shade[last]) / EDGE)
                    own = own + _from_neighbour(before, step.astype(np.float32))
                out[line] += own
                before, last = own, line
    return total


def _from_neighbour(
    before: Float32[np.ndarray, "num_depths width"], large: Float32[np.ndarray, " width"]
) -> Float32[np.ndarray, "num_depths width"]:
    least = before.min(axis=0)
    best = np.minimum(before, least + np.maximum(large, SMALL_STEP))
    np.minimum(best[1:], before[:-1] + np.float32(SMALL_STEP), out=best[1:])
    np.minimum(best[:-1], before[1:] + np.float32(SMALL_STEP), out=best[:-1])
    return np.asarray(best - least)


def _least(
    cost: Float32[np.ndarray, "num_depths height width"],
    inverse: Float[np.ndarray, " num_depths"],
) -> Float32[np.ndarray, "height width"]:
    """Depth of least cost, between two planes by a parabola; 0 at both ends of the range."""
    best: Int[np.ndarray, "height width"] = cost.argmin(axis=0)
    inner = np.clip(best, 1, len(inverse) - 2)
    below, middle, above = (
        np.take_along_axis(cost, (inner + step)[None], axis=0)[0] for step in (-1, 0, 1)
    )
    bend = np.maximum(below - 2 * middle + above, 1e-9)
    shift = np.clip(0.5 * (below - above) / bend, -0.5, 0.5)
    value = inverse[inner] + shift * (inverse[1] - inverse[0])
    is_inner = (best > 0) & (best < len(inverse) - 1)
    return np.where(is_inner, 1.0 / value, 0.0).astype(np.float32)


def _confirmed(
    index: int,
    references: Sequence[int],
    views: Sequence[PosedView],
    depths: Sequence[Float32[np.ndarray, "height width"]],
    step: float,
) -> Float32[np.ndarray, "height width"]:
    """The depth of one view where others, carried over, say the same."""
    view, depth = views[index], depths[index]
    p_world = se3.apply(view.T_world_camera, view.camera.unproject(depth.astype(np.float64)))
    count = np.zeros(depth.shape, dtype=np.int32)
    for k in references:
        other = views[k]
        p = se3.apply(se3.invert(other.T_world_camera), p_world)
        front = (p[..., 2] > 0) & (depth > 0)
        uv, z = other.camera.project(np.where(front[..., None], p, 1.0))
        u, v = np.floor(uv[..., 0]).astype(np.int64), np.floor(uv[..., 1]).astype(np.int64)
        height, width = depths[k].shape
        inside = front & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        there = np.zeros(depth.shape, dtype=np.float64)
        there[inside] = depths[k][v[inside], u[inside]]
        count += (there > 0) & (np.abs(there - z) < np.maximum(AGREE_FRACTION, step * z) * z)
    kept = (depth > 0) & (count >= min(CONFIRMED_BY, max(len(references), 1)))
    return np.where(without_specks(kept, SPECKLE_PX), depth, np.float32(0.0))


def without_specks(
    mask: Bool[np.ndarray, "height width"], least_px: int
) -> Bool[np.ndarray, "height width"]:
    """The patches of a mask that have at least so many pixels."""
    labels, number = ndimage.label(mask)
    sizes = np.bincount(labels.ravel(), minlength=number + 1)
    sizes[0] = 0
    return np.asarray((sizes >= least_px)[labels])
