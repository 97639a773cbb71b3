"""Gaussians for what was seen in colour and never measured: holes are closed, and marked.

Depth is missing on black and shiny things, beyond the camera's reach and in its shadow; a fit that
starts from depth leaves black holes there. Each pixel of a training view in which the fitted scene
shows nothing asks along its ray: which distance looks alike in the other views (a plane sweep,
Collins 1996), contradicts none of their measurements, and goes on where the surface beside it ends?
Where no other view helps, the surface beside it decides. No depth loss ever applies to these
Gaussians. They are marked as completed, so that renders can say what was seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage

from bridge.geometry import se3
from twin.scene.fit.initialise import flat_gaussians
from twin.scene.frames.rgbd import Target, TrainingView
from twin.scene.gaussians import GaussianCloud, concatenate
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.settings import InitialiseConfig

HOLE_ALPHA = 0.5
"""A pixel that lets more than this through shows nothing."""
LEAST_PX = 12
"""Smaller holes of a half-size image are left to their surroundings."""
NUM_DEPTHS = 64
BEYOND = 2.0
"""The farthest distance that is tried, times the farthest that was drawn."""
MOST_VIEWS = 24
"""Training views whose holes are closed, those with most of them first."""
MOST_REFERENCES = 6
BASELINE_M = 0.03
"""Views from nearer places say nothing of distance."""
AGREE_M, AGREE_FRACTION = 0.03, 0.03
"""Distances that differ by less than both together are the same."""
MOST_APART = 0.2
"""Colours that differ by more are simply different."""
BLOCK_PX = 5
"""Pixels of a hole that are this near have about the same distance."""
RETRIES, FARTHER = 8, 1.1
"""What stands before another view's measurement is moved away this often, by this factor."""
SMOOTH = 0.03
"""Weight of leaving the surface beside a hole, by the logarithm of the distance, beside colour."""
SPACING_PX = 1.6
"""Size of a new Gaussian in pixels of the half-size image."""


@dataclass(frozen=True, kw_only=True)
class _Hole:
    """Pixels of one view in which nothing is drawn."""

    view: TrainingView
    mask: Bool[np.ndarray, "height width"]
    beside_m: Float32[np.ndarray, "height width"]
    """Depth of the nearest pixel in which something is drawn."""

    @property
    def target(self) -> Target:
        return self.view.half


def complete_holes(
    cloud: GaussianCloud,
    views: Sequence[TrainingView],
    config: InitialiseConfig,
    raster: RasterConfig | None = None,
) -> GaussianCloud:
    """Gaussians that close the holes of the training views, marked; none without holes."""
    added = cloud.take(np.zeros(0, dtype=np.int64))
    most = round(config.completion * config.max_splats)
    rasteriser = Rasteriser(raster or RasterConfig())
    holes = [_hole(view, cloud, rasteriser) for view in views]
    order = np.argsort([-int(hole.mask.sum()) for hole in holes], kind="stable")
    for index in order[:MOST_VIEWS].tolist():
        if len(added) >= most or not holes[index].mask.any():
            break
        hole = _hole(views[index], concatenate([cloud, added]), rasteriser)
        if hole.mask.any():
            added = concatenate([added, _closed(hole, views, config, most - len(added))])
    return added.as_completed()


def _hole(view: TrainingView, cloud: GaussianCloud, rasteriser: Rasteriser) -> _Hole:
    target = view.half
    drawn = rasteriser.view(cloud, target.camera, view.T_base_color)
    empty = target.static_mask & (drawn.alpha < HOLE_ALPHA)
    is_known = drawn.depth_m > 0
    beside = np.zeros_like(drawn.depth_m)
    if is_known.any():
        rows, columns = ndimage.distance_transform_edt(
            ~is_known, return_distances=False, return_indices=True
        )
        beside = drawn.depth_m[rows, columns]
    mask = without_specks(empty, LEAST_PX) & (beside > 0)
    return _Hole(view=view, mask=mask, beside_m=beside)


def without_specks(
    mask: Bool[np.ndarray, "height width"], least_px: int
) -> Bool[np.ndarray, "height width"]:
    """The patches of a mask that have at least so many pixels."""
    labels, number = ndimage.label(mask)
    sizes = np.bincount(labels.ravel(), minlength=number + 1)
    sizes[0] = 0
    return np.asarray((sizes >= least_px)[labels])


def _closed(
    hole: _Hole, views: Sequence[TrainingView], config: InitialiseConfig, most: int
) -> GaussianCloud:
    """Gaussians for the pixels of one view, coarser where they would be too many."""
    depth_m = _depth_of(hole, views)
    step = 1
    while (depth_m[::step, ::step] > 0).sum() > most:
        step += 1
    chosen = np.zeros_like(hole.mask)
    chosen[::step, ::step] = depth_m[::step, ::step] > 0
    camera, T = hole.target.camera, hole.view.T_base_color
    p_camera = camera.unproject(depth_m.astype(np.float64))[chosen]
    colors = np.moveaxis(hole.target.image(), 0, -1)[chosen]
    allowed = np.ones(len(p_camera), dtype=bool)
    for _ in range(RETRIES):
        _, allowed = _disagreement(se3.apply(T, p_camera), colors, views)
        if allowed.all():
            break
        p_camera[~allowed] *= FARTHER
    p_camera, colors = p_camera[allowed], colors[allowed]
    towards = -p_camera / np.maximum(np.linalg.norm(p_camera, axis=1, keepdims=True), 1e-9)
    sizes = SPACING_PX * step * p_camera[:, 2] / camera.fx
    normals = towards @ T[:3, :3].T
    return flat_gaussians(se3.apply(T, p_camera), normals, colors, sizes, config)


def _references(view: TrainingView, views: Sequence[TrainingView]) -> list[TrainingView]:
    """Views that look the same way from somewhere else, nearest first."""
    baseline_m = np.array(
        [np.linalg.norm(v.T_base_color[:3, 3] - view.T_base_color[:3, 3]) for v in views]
    )
    along = np.array([v.T_base_color[:3, 2] @ view.T_base_color[:3, 2] for v in views])
    usable = np.flatnonzero((baseline_m > BASELINE_M) & (along > 0.5))
    return [views[i] for i in usable[np.argsort(baseline_m[usable])][:MOST_REFERENCES].tolist()]


def _depth_of(hole: _Hole, views: Sequence[TrainingView]) -> Float32[np.ndarray, "height width"]:
    """Depth of the hole's pixels, smoothed; 0 elsewhere, and where every distance contradicts."""
    found = np.zeros(hole.mask.shape, dtype=np.float32)
    found[hole.mask] = _swept(hole, views)
    around = np.where(found > 0, found, hole.beside_m)
    smooth = ndimage.median_filter(around, size=BLOCK_PX)
    return np.where(found > 0, smooth, np.float32(0.0))


def _swept(hole: _Hole, views: Sequence[TrainingView]) -> Float[np.ndarray, " num_points"]:
    """Distance of least cost of the hole's pixels; 0 where none is possible."""
    references = _references(hole.view, views)
    rows, columns = np.nonzero(hole.mask)
    rays = hole.target.camera.rays()[rows, columns] @ hole.view.T_base_color[:3, :3].T
    colors = np.moveaxis(hole.target.image(), 0, -1)[rows, columns]
    beside_m = hole.beside_m[rows, columns].astype(np.float64)
    depths = np.geomspace(0.7 * beside_m.min(), BEYOND * float(hole.beside_m.max()), NUM_DEPTHS)
    cost = np.empty((NUM_DEPTHS, len(rays)))
    for index, depth in enumerate(depths):
        p_base = hole.view.T_base_color[:3, 3] + depth * rays
        difference, is_possible = _disagreement(p_base, colors, references)
        cost[index] = _averaged(difference, hole.mask) + SMOOTH * np.abs(np.log(depth / beside_m))
        cost[index, ~is_possible] = np.inf
    return _least(cost, depths)


def _least(
    cost: Float[np.ndarray, "num_depths num_points"], depths: Float[np.ndarray, " num_depths"]
) -> Float[np.ndarray, " num_points"]:
    """Depth of least cost, refined by a parabola; 0 where no depth has a finite cost."""
    best = cost.argmin(axis=0)
    every = np.arange(cost.shape[1])
    below, middle, above = (
        cost[np.clip(best + step, 0, len(depths) - 1), every] for step in (-1, 0, 1)
    )
    possible = np.isfinite(middle)
    inner = possible & np.isfinite(below) & np.isfinite(above) & (best > 0)
    inner &= best < len(depths) - 1
    shift = np.zeros(len(best))
    bend = below[inner] - 2 * middle[inner] + above[inner]
    shift[inner] = np.where(
        bend > 1e-9, (below[inner] - above[inner]) / np.maximum(2 * bend, 1e-9), 0.0
    )
    factor = depths[1] / depths[0]
    return np.where(possible, depths[best] * factor ** np.clip(shift, -0.5, 0.5), 0.0)


def _disagreement(
    p_base: Float[np.ndarray, "num_points 3"],
    colors: Float32[np.ndarray, "num_points 3"],
    references: Sequence[TrainingView],
) -> tuple[Float[np.ndarray, " num_points"], Bool[np.ndarray, " num_points"]]:
    """Mean difference of colour in the views that can see points, and whether none passes them.

    Points that no view can see differ by half of the most.
    """
    total, count = np.zeros(len(p_base)), np.zeros(len(p_base))
    allowed = np.ones(len(p_base), dtype=bool)
    for view in references:
        target = view.half
        p = se3.apply(se3.invert(view.T_base_color), p_base)
        front = p[:, 2] > 0.05
        uv, z = target.camera.project(np.where(front[:, None], p, 1.0))
        u, v = np.floor(uv[:, 0]).astype(int), np.floor(uv[:, 1]).astype(int)
        inside = front & (u >= 0) & (v >= 0)
        inside &= (u < target.camera.width) & (v < target.camera.height)
        u, v, z = u[inside], v[inside], z[inside]
        measured = target.depth_m[v, u]
        slack = AGREE_M + AGREE_FRACTION * z
        ids = np.flatnonzero(inside)
        allowed[ids] &= ~(measured > z + slack)
        seen = target.static_mask[v, u] & ~((measured > 0) & (measured < z - slack))
        difference = np.abs(target.planes_u8[:, v, u].T / 255.0 - colors[ids]).mean(axis=1)
        total[ids[seen]] += np.minimum(difference[seen], MOST_APART)
        count[ids[seen]] += 1
    return np.where(count > 0, total / np.maximum(count, 1), MOST_APART / 2), allowed


def _averaged(
    values: Float[np.ndarray, " num_points"], mask: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, " num_points"]:
    """Mean over the pixels of the mask around each of them."""
    grid = np.zeros(mask.shape)
    grid[mask] = values
    weight = ndimage.uniform_filter(mask.astype(np.float64), size=BLOCK_PX)
    return np.asarray(
        ndimage.uniform_filter(grid, size=BLOCK_PX)[mask] / np.maximum(weight[mask], 1e-9)
    )
