"""More Gaussians where the images are still wrong, none where they show nothing; within a budget.

The error of every pixel is lifted onto the Gaussians that made it (A^T |error|), as in
error-based densification (Rota Bulo et al. 2024, Revising Densification in Gaussian Splatting):
a sum over views that needs no extra passes while fitting, and leaves nothing to chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int64

from bridge.geometry import se3
from twin.scene.fit.appearance import UNLIMITED, Allowance, ImageObservation
from twin.scene.gaussians import GaussianCloud, as_float32, concatenate, morton_order
from twin.scene.raster.rasteriser import Rasteriser

MAX_SCORED_VIEWS = 20
"""Views that errors are gathered from; more only cost time."""
TRANSPARENT = 0.03
"""Gaussians with less opacity go."""
UNSEEN_PIXELS = 0.05
"""Gaussians that make up less than this many pixels of all views together go."""
HUGE_FRACTION = 0.15
"""Gaussians whose deviation exceeds this share of an image's width go: fog before the camera."""
FINEST_PX = 0.4
"""Gaussians smaller than this in every view are not split: pixels cannot tell the halves."""
SPLIT_SHRINK = 0.62
"""Standard deviation of a half along the split, in that of the whole."""
SPLIT_SHIFT = 0.78
"""Distance of a half from the middle; with the shrink, s^2 + d^2 = 1: the variance stays."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """What the views say about each Gaussian."""

    error: Float32[np.ndarray, " num_splats"]
    """Sum over views and pixels of weight times colour error."""
    pixels: Float32[np.ndarray, " num_splats"]
    """Sum of weights: how many pixels it makes up in all views."""
    size_fraction: Float32[np.ndarray, " num_splats"]
    """Largest standard deviation in any image, in image widths."""
    size_px: Float32[np.ndarray, " num_splats"]
    """The same in pixels."""
    complete: bool = True
    """Whether all views that were chosen could be asked in time; else not seen says nothing."""


def score(
    cloud: GaussianCloud,
    observations: Sequence[ImageObservation],
    rasteriser: Rasteriser,
    allowance: Allowance = UNLIMITED,
) -> Scores:
    """Draw the views, evenly chosen where there are many, and lift their errors.

    Views that there is no time for are left out.
    """
    step = -(-len(observations) // MAX_SCORED_VIEWS)
    error, pixels, size_px, fraction = (np.zeros(len(cloud), np.float32) for _ in range(4))
    largest_m = np.exp(cloud.scales_log.max(axis=1))
    complete = True
    for item in observations[::step]:
        if allowance.is_over():
            complete = False
            break
        camera, mask = item.target.camera, item.target.static_mask
        planes = rasteriser.draw_planes(cloud, camera, item.T_base_camera)
        wrong = np.abs(item.exposed(planes[:3]) - item.target.image()).mean(axis=0) * mask
        lifted = rasteriser.lift(np.stack([wrong, mask.astype(np.float32)]))
        error += lifted[:, 0]
        pixels += lifted[:, 1]
        seen = rasteriser.visible_mask() & (lifted[:, 1] > 0)
        depth_m = (cloud.means_m - item.T_base_camera[:3, 3]) @ item.T_base_camera[:3, 2]
        px = np.where(seen, largest_m * camera.fx / np.maximum(depth_m, 0.05), 0.0)
        np.maximum(size_px, px.astype(np.float32), out=size_px)
        np.maximum(fraction, (px / camera.width).astype(np.float32), out=fraction)
    return Scores(
        error=error, pixels=pixels, size_px=size_px, size_fraction=fraction, complete=complete
    )


def densify(
    cloud: GaussianCloud, scores: Scores, *, max_splats: int, most: int
) -> tuple[GaussianCloud, Int64[np.ndarray, " num_splats"]]:
    """Drop what shows nothing or hides everything, and split where the error is large.

    Returns:
        The rearranged cloud, and which Gaussian of the one before each comes from.
    """
    kept: Bool[np.ndarray, " num_splats"] = cloud.opacities() > TRANSPARENT
    if scores.complete:
        kept &= scores.pixels > UNSEEN_PIXELS
    kept &= scores.size_fraction < HUGE_FRACTION
    if not kept.any():  # nothing is seen at all: images that are masked everywhere
        kept[:] = True
    free = max(min(max_splats - int(kept.sum()), most), 0)
    wanting = np.flatnonzero(kept & (scores.size_px > FINEST_PX) & (scores.error > 0))
    worst = wanting[np.argsort(-scores.error[wanting], kind="stable")[:free]]
    whole = kept.copy()
    whole[worst] = False
    ids = np.concatenate([np.flatnonzero(whole), worst, worst])
    halves = _halves(cloud.take(worst))
    everything = concatenate([cloud.take(whole), *halves])
    order = morton_order(everything.means_m)
    return everything.take(order), ids[order]


def _halves(cloud: GaussianCloud) -> list[GaussianCloud]:
    """Each Gaussian as two beside one another along its longest axis."""
    axis = cloud.scales_log.argmax(axis=1)
    row = np.arange(len(cloud))
    R = se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))
    length_m = np.exp(cloud.scales_log[row, axis]).astype(np.float64)
    shift_m = SPLIT_SHIFT * length_m[:, None] * R[row, :, axis]
    scales_log = cloud.scales_log.copy()
    scales_log[row, axis] += np.float32(np.log(SPLIT_SHRINK))
    return [
        replace(
            cloud,
            means_m=as_float32(cloud.means_m + sign * shift_m),
            scales_log=scales_log.copy(),
        )
        for sign in (-1.0, 1.0)
    ]
