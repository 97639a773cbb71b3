"""Depth of posed images from each other: a plane sweep.

Planes parallel to an image are tried at many distances (Collins 1996): at the right one its
neighbours look alike there, by the correlation of small windows, which exposure does not change.
What another image confirms is kept, and what lies between is filled in from there. This stands in
for depth, and measures nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.terminal import Advance
from twin.scene.frames.downscaled import pixels_of
from twin.scene.gaussians import as_float32

BEYOND, RANGE, FIRST_DEPTHS, NUM_DEPTHS = 4.0, 20.0, 80, 64
"""Distances tried, evenly in their inverse: from this many times the one that is given to a
fraction of it, at a third of the size; then those that were found."""
FIRST_IMAGES, FIRST_COST, NUM_NEIGHBOURS, WINDOW_PX = 8, 0.25, 4, 9
"""From how many images they are found, and from which of their pixels."""
BASELINE, BASELINES, SAME_WAY = 0.1, (0.015, 0.8), 0.6
"""Best, least and largest baseline of a neighbour over the distance, and least cosine between
viewing directions: farther ones see other sides, nearer ones measure nothing."""
TURN_COST, FLAT = 2.0, 1e-5
"""Of a radian between neighbours; variance of brightness in a window that has no texture."""
AGREE, MOST_COST = 0.02, 0.4
"""Depths that differ by less than this share, and cost no more, confirm each other."""
FILL_PX, FILL_WEIGHT = 3.0, 0.02
"""Standard deviation around a pixel that nobody confirms; its own weight there."""
Image = Float32[np.ndarray, "height width"]
Costs = Float32[np.ndarray, "num_depths height width"]
Inverse = Float[np.ndarray, " num_depths"]
"""Of the distances that are tried."""


@dataclass(frozen=True, kw_only=True)
class PosedImage:
    """Brightness, 0..1, and from where it was seen."""

    grey: Image
    camera: Camera
    T_base_camera: Float[np.ndarray, "4 4"]

    def shrunk(self, factor: int) -> "PosedImage":
        """Means of blocks of pixels; what is left over at the far ends is cut off."""
        height, width = (side // factor for side in self.grey.shape)
        whole = replace(self.camera, width=width * factor, height=height * factor)
        blocks = self.grey[: whole.height, : whole.width].reshape(height, factor, width, factor)
        return replace(self, grey=blocks.mean(axis=(1, 3)), camera=whole.scaled(1 / factor))


def sweep(
    images: Sequence[PosedImage], farthest_m: float, advance: Advance
) -> tuple[list[Image], float]:
    """Depth of each image along its axis, 0 where nothing is known, and the share confirmed."""
    inverse = _range([image.shrunk(3) for image in images], farthest_m)
    others = [_neighbours(index, images, inverse) for index in range(len(images))]
    raw, alike = [], []
    for image, chosen in zip(images, others, strict=True):
        depth_m, cost = _swept(image, [images[k] for k in chosen[:NUM_NEIGHBOURS]], inverse)
        raw.append(depth_m)
        alike.append(np.where(cost < MOST_COST, depth_m, np.float32(0.0)))
        advance(len(raw), "")
    sure = [_confirmed(index, chosen, images, alike) for index, chosen in enumerate(others)]
    return [_filled(*each) for each in zip(raw, sure, strict=True)], float(np.mean(sure))


def _range(images: Sequence[PosedImage], farthest_m: float) -> Inverse:
    """Those distances that a few small images have, and a little more."""
    inverse = np.linspace(1 / (BEYOND * farthest_m), RANGE / farthest_m, FIRST_DEPTHS)
    known = []
    for index in range(0, len(images), max(1, len(images) // FIRST_IMAGES)):
        chosen = _neighbours(index, images, inverse)[:NUM_NEIGHBOURS]
        depth_m, cost = _swept(images[index], [images[k] for k in chosen], inverse)
        known += [1 / depth_m[(depth_m > 0) & (cost < FIRST_COST)]]
    if not sum(map(len, known)):
        return inverse
    least, most = np.quantile(np.concatenate(known), (0.01, 0.99)) * (0.85, 1.2)
    return np.linspace(least, most, NUM_DEPTHS)


def _neighbours(index: int, images: Sequence[PosedImage], inverse: Inverse) -> list[int]:
    """Images that look the same way from the best distance, best first."""
    Ts = np.stack([image.T_base_camera for image in images])
    shift_m = np.linalg.norm(Ts[:, :3, 3] - Ts[index, :3, 3], axis=1)
    baseline = shift_m * np.sqrt(inverse[0] * inverse[-1])
    cosine = np.clip(Ts[:, :3, 2] @ Ts[index, :3, 2], -1.0, 1.0)
    usable = (baseline > BASELINES[0]) & (baseline < BASELINES[1]) & (cosine > SAME_WAY)
    cost = np.abs(np.log(np.maximum(baseline, 1e-9) / BASELINE)) + TURN_COST * np.arccos(cosine)
    order = np.argsort(np.where(usable, cost, np.inf), kind="stable")
    return [int(k) for k in order[: min(2 * NUM_NEIGHBOURS, int(usable.sum()))]]


def _swept(
    image: PosedImage, others: Sequence[PosedImage], inverse: Inverse
) -> tuple[Image, Image]:
    """Depth of least cost, 0 where there is none; and the cost."""
    if not others:
        return np.zeros_like(image.grey), np.ones_like(image.grey)
    costs = _costs(image, others, inverse)
    best = costs.argmin(axis=0)
    inner = np.clip(best, 1, len(inverse) - 2)
    steps = np.array([-1, 0, 1])[:, None, None]
    below, middle, above = np.take_along_axis(costs, inner + steps, axis=0)
    bend = np.maximum(below - 2 * middle + above, 1e-9)
    shift = np.clip(0.5 * (below - above) / bend, -0.5, 0.5)
    value = inverse[inner] + shift * (inverse[1] - inverse[0])
    depth_m = np.where(best == inner, 1 / value, 0.0).astype(np.float32)
    return depth_m, costs.min(axis=0)


def _costs(image: PosedImage, others: Sequence[PosedImage], inverse: Inverse) -> Costs:
    """One minus the correlation with the better half of the others, at each distance.

    Those that look at something else there are hidden by it.
    """
    rays = image.camera.rays()
    motions = [se3.invert(other.T_base_camera) @ image.T_base_camera for other in others]
    turned = [(rays @ T[:3, :3].T).astype(np.float32) for T in motions]
    own, own_square = _means([image.grey, image.grey**2])
    costs = np.empty((len(inverse), *image.grey.shape), dtype=np.float32)
    for index, value in enumerate(inverse):
        each = []
        for other, T, ray in zip(others, motions, turned, strict=True):
            seen, inside = _looked_up(other, ray + (value * T[:3, 3]).astype(np.float32))
            mean, square, product = _means([seen, seen**2, seen * image.grey])
            spreads = np.maximum([own_square - own**2, square - mean**2], 0.0) + np.float32(FLAT)
            alike = (product - own * mean) / np.sqrt(spreads[0] * spreads[1])
            each.append(np.where(inside, np.clip(1 - alike, 0.0, 1.0), np.float32(1.0)))
        costs[index] = np.sort(each, axis=0)[: -(-len(others) // 2)].mean(axis=0)
    return costs


def _means(planes: Sequence[Image]) -> list[Image]:
    """Over the window around each pixel."""
    return [ndimage.uniform_filter(plane, size=WINDOW_PX) for plane in planes]


def _looked_up(
    other: PosedImage, p_other: Float32[np.ndarray, "height width 3"]
) -> tuple[Image, Bool[np.ndarray, "height width"]]:
    """Brightness of another image where points appear in it, between its pixels; and where."""
    height, width = other.grey.shape
    with np.errstate(divide="ignore", invalid="ignore"):  # of points at the camera's height
        u, v = np.moveaxis(other.camera.project(p_other)[0], -1, 0)
    inside = (
        (p_other[..., 2] > 0) & (u >= 0.5) & (v >= 0.5) & (u <= width - 0.5) & (v <= height - 0.5)
    )
    place = np.where(inside, [v, u], 0.5) - 0.5
    seen = ndimage.map_coordinates(other.grey, place, order=1, output=np.float32)
    return seen, inside


def _confirmed(
    index: int, chosen: Sequence[int], images: Sequence[PosedImage], depths_m: Sequence[Image]
) -> Bool[np.ndarray, "height width"]:
    """Where one of the chosen images has the same depth."""
    image, depth_m = images[index], depths_m[index]
    p_base = se3.apply(image.T_base_camera, image.camera.unproject(depth_m.astype(np.float64)))
    found = np.zeros(depth_m.shape, dtype=bool)
    for k in chosen:
        p = se3.apply(se3.invert(images[k].T_base_camera), p_base)
        row, column, inside = pixels_of(images[k].camera, p)
        there_m = np.where(inside, depths_m[k][row * inside, column * inside], 0.0)
        found |= (depth_m > 0) & (np.abs(there_m - p[..., 2]) < AGREE * p[..., 2])
    return found


def _filled(depth_m: Image, is_sure: Bool[np.ndarray, "height width"]) -> Image:
    """What is confirmed, and between it the mean inverse depth around a pixel."""
    known = depth_m > 0
    weight = np.where(is_sure, 1.0, FILL_WEIGHT * known)
    inverse = np.where(known, 1 / np.where(known, depth_m, 1.0), 0.0)
    total, count = (ndimage.gaussian_filter(each, FILL_PX) for each in (weight * inverse, weight))
    filled = np.where(count > 1e-4, count / np.maximum(total, 1e-9), 0.0)
    return as_float32(ndimage.median_filter(np.where(is_sure, depth_m, filled), 3))
