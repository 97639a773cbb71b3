"""Gaussians for what was seen in colour and never measured: holes are closed, and marked.

Depth is missing on black and shiny things, beyond the camera's reach and in its shadow; a fit that
starts from depth leaves black holes there. Each hole of a training view is closed by the smoothest
surface through what is drawn around it, moved away from the camera where it would stand before
what another view measured. No depth loss ever applies to these Gaussians. They are marked as
completed, so that renders can say what was seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage
from scipy.sparse import csc_array
from scipy.sparse.linalg import spsolve

from bridge.geometry import se3
from twin.scene.fit.initialise import flat_gaussians
from twin.scene.frames.downscaled import pixels_of
from twin.scene.frames.rgbd import Target, TrainingView
from twin.scene.gaussians import GaussianCloud, concatenate
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser

HOLE_ALPHA = 0.5
"""A pixel that lets more than this through shows nothing."""
LEAST_PX = 12
"""Smaller holes of a half-size image are left to their surroundings."""
MOST_VIEWS = 24
"""Training views whose holes are closed, those with most of them first."""
AGREE_M, AGREE_FRACTION = 0.03, 0.03
"""Distances that differ by less than both together are the same."""
RETRIES, FARTHER = 8, 1.1
"""What stands before another view's measurement is moved away this often, by this factor."""
LOOSE = 1e-4
"""Weight of the nearest depth beside a hole's pixel, beside 1 of each neighbour: decides where
nothing else does."""
SPACING_PX = 1.6
"""Size of a new Gaussian in pixels of the half-size image."""


@dataclass(frozen=True, kw_only=True)
class _Hole:
    """Pixels of one view in which nothing is drawn."""

    view: TrainingView
    mask: Bool[np.ndarray, "height width"]
    drawn_m: Float32[np.ndarray, "height width"]
    beside_m: Float32[np.ndarray, "height width"]
    """Depth of the nearest pixel in which something is drawn."""

    @property
    def target(self) -> Target:
        return self.view.half


def complete_holes(
    cloud: GaussianCloud,
    views: Sequence[TrainingView],
    most: int,
    raster: RasterConfig | None = None,
) -> GaussianCloud:
    """Gaussians that close the holes of the training views, marked; none without holes.

    Args:
        most: Gaussians.
    """
    added = cloud.take(np.zeros(0, dtype=np.int64))
    rasteriser = Rasteriser(raster or RasterConfig())
    holes = [_hole(view, cloud, rasteriser) for view in views]
    order = np.argsort([-int(hole.mask.sum()) for hole in holes], kind="stable")
    for index in order[:MOST_VIEWS].tolist():
        if len(added) >= most or not holes[index].mask.any():
            break
        hole = _hole(views[index], concatenate([cloud, added]), rasteriser)
        if hole.mask.any():
            added = concatenate([added, _closed(hole, views, most - len(added))])
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
    labels, number = ndimage.label(empty)
    sizes = np.bincount(labels.ravel(), minlength=number + 1)
    mask = empty & (sizes >= LEAST_PX)[labels] & (beside > 0)
    return _Hole(view=view, mask=mask, drawn_m=drawn.depth_m, beside_m=beside)


def _closed(hole: _Hole, views: Sequence[TrainingView], most: int) -> GaussianCloud:
    """Gaussians for the pixels of one view, coarser where they would be too many."""
    depth_m = _smoothest(hole.drawn_m, hole.mask, hole.beside_m)
    step = 1
    while (depth_m[::step, ::step] > 0).sum() > most:
        step += 1
    chosen = np.zeros_like(hole.mask)
    chosen[::step, ::step] = depth_m[::step, ::step] > 0
    camera, T = hole.target.camera, hole.view.T_base_color
    p_camera = camera.unproject(depth_m)[chosen]
    colors = np.moveaxis(hole.target.image(), 0, -1)[chosen]
    allowed = np.ones(len(p_camera), dtype=bool)
    for _ in range(RETRIES):
        allowed = _allowed(se3.apply(T, p_camera), views)
        if allowed.all():
            break
        p_camera[~allowed] *= FARTHER
    p_camera, colors = p_camera[allowed], colors[allowed]
    towards = -p_camera / np.maximum(np.linalg.norm(p_camera, axis=1, keepdims=True), 1e-9)
    sizes = SPACING_PX * step * p_camera[:, 2] / camera.fx
    normals = towards @ T[:3, :3].T
    return flat_gaussians(se3.apply(T, p_camera), normals, colors, sizes)


def _smoothest(
    depth_m: Float32[np.ndarray, "height width"],
    mask: Bool[np.ndarray, "height width"],
    beside_m: Float32[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Depth of a hole's pixels, 0 elsewhere: the smoothest surface through what is around.

    Inverse depth, of which planes are linear functions, is the mean of its four neighbours'.
    """
    number = np.full(mask.shape, -1)
    number[mask] = np.arange(mask.sum())
    known = np.where((depth_m > 0) & ~mask, 1 / np.maximum(depth_m, 1e-9), 0.0)
    rows, columns = np.nonzero(mask)
    own = np.arange(len(rows))
    weight, right = np.full(len(rows), LOOSE), LOOSE / beside_m[mask].astype(np.float64)
    links = []
    for down, aside in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        row, column = rows + down, columns + aside
        inside = (row >= 0) & (column >= 0) & (row < len(mask)) & (column < mask.shape[1])
        row, column = np.where(inside, row, rows), np.where(inside, column, columns)
        is_given, is_hole = known[row, column] > 0, inside & mask[row, column]
        weight += is_given | is_hole
        right += known[row, column]
        links.append(np.stack([own[is_hole], number[row, column][is_hole]]))
    pairs = np.concatenate([np.concatenate(links, axis=1), np.stack([own, own])], axis=1)
    values = np.concatenate([np.full(pairs.shape[1] - len(own), -1.0), weight])
    equations = csc_array((values, pairs), shape=(len(own), len(own)))
    found = np.zeros(mask.shape)
    found[mask] = 1 / np.atleast_1d(spsolve(equations, right))
    return found


def _allowed(
    p_base: Float[np.ndarray, "num_points 3"], views: Sequence[TrainingView]
) -> Bool[np.ndarray, " num_points"]:
    """Which points no view looks past, at something farther."""
    allowed = np.ones(len(p_base), dtype=bool)
    for view in views:
        target = view.half
        p = se3.apply(se3.invert(view.T_base_color), p_base)
        row, column, inside = pixels_of(target.camera, p)
        z = p[inside, 2]
        measured = target.depth_m[row[inside], column[inside]]
        allowed[inside] &= ~(measured > z + AGREE_M + AGREE_FRACTION * z)
    return allowed
