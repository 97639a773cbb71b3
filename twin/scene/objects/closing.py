"""Objects that are closed: Gaussians on all of the reconstructed surface, undersides included.

What a fit leaves of an object is a ragged shell: open where nobody looked, mixed with table where
object and table touch. Here Gaussians are set evenly on the closed mesh. Each takes the colour it
shows in the training views, away from the object's outline and from edges, where a camera that
stands a few millimetres wrong sees something else. What no view shows takes the colour of the
surface next to it that was surely seen, in the light that falls on it, and is marked as completed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.fit.lighting import EVEN, Lighting
from twin.scene.fit.on_mesh import (
    colors_around,
    even_points,
    surface_area_m2,
    thin_gaussians,
    within_edges,
)
from twin.scene.frames.downscaled import pixels_of
from twin.scene.frames.rgbd import TrainingView
from twin.scene.gaussians import GaussianCloud
from twin.scene.shape.from_training import image_window
from twin.scene.shape.mesh import Mesh, first_hit

FOOTPRINTS = 1.6
"""Spacing of the Gaussians in pixels of the views that come nearest."""
NEAREST_SHARE = 0.25
"""Of the views, for that spacing."""
LEAST_SPACING_M, MOST_SPLATS = 0.001, 20_000
FACING = 0.25
"""Cosine from which on a surface is seen; flatter, it is all edge."""
SAME_M, SAME_FRACTION = 0.008, 0.01
"""Depth measured this near to the surface measured the surface."""
EDGE_PX = 1
"""Pixels this near to an outline or an edge may show what is beside it."""
EDGE_M, EDGE_COSINE = 0.006, 0.8
"""Pixels two apart whose depths, or normals, differ by more have an edge between them."""
NEAR_BEND, NEAR_OUTLINE = 1e-3, 1e-6
"""Weights of such pixels: they count where there are no others. Near an edge all colours are still
the object's own, near its outline they may be the table's."""
SURE = 0.1
"""Weight of a colour that others may take: flat or near an outline, the table is mixed into it."""
NEIGHBOURS = 24
SIDEWAYS = 0.2
"""Share that a surface facing elsewhere has in the colour of a side that nobody saw."""


def closed_object(
    mesh: Mesh,
    views: Sequence[TrainingView],
    T_base_object: Float[np.ndarray, "4 4"],
    lighting: Lighting = EVEN,
) -> GaussianCloud | None:
    """Gaussians on a closed mesh in the object's frame; None where no view shows it."""
    looks = [_Look.of(view, mesh, T_base_object) for view in views]
    looks = [look for look in looks if look.shown.any()]
    if not looks:
        return None
    near_m = [float(np.median(look.expected_m[look.shown])) / look.camera.fx for look in looks]
    finest_m = max(FOOTPRINTS * float(np.quantile(near_m, NEAREST_SHARE)), LEAST_SPACING_M)
    spacing_m = max(finest_m, float(np.sqrt(surface_area_m2([mesh]) / MOST_SPLATS)))
    p, normals = even_points([mesh], spacing_m)
    p = within_edges(p, normals, [mesh], spacing_m)
    colors, weights = (
        np.stack(rows) for rows in zip(*(look.at(p, normals) for look in looks), strict=True)
    )
    most = weights.max(axis=0)
    if not most.any():
        return None
    known, sure = (most > (bound if most.max() > bound else 0) for bound in (NEAR_OUTLINE, SURE))
    color = weighted_median(colors, weights)
    light = lighting.brightness(normals @ T_base_object[:3, :3].T)[:, None]
    seen = p[sure], normals[sure], (color / light)[sure]
    paint, _ = colors_around(p[~known], normals[~known], seen, NEIGHBOURS, sideways=SIDEWAYS)
    color[~known] = paint * light[~known]
    cloud = thin_gaussians(p, normals, color, spacing_m)
    return replace(cloud, completed=most == 0)


@dataclass(frozen=True, kw_only=True)
class _Look:
    """The part of a view in which an object shows."""

    camera: Camera
    T_camera_object: Float[np.ndarray, "4 4"]
    corner: tuple[int, int]
    """First row and column of the part."""
    colors: Float[np.ndarray, "height width 3"]
    expected_m: Float[np.ndarray, "height width"]
    """Depth of the surface; infinite beside it."""
    shown: Bool[np.ndarray, "height width"]
    """Pixels in which the surface was measured."""
    trust: Float[np.ndarray, "height width"]
    """How surely a pixel shows this place: 1 away from outlines and edges."""

    @staticmethod
    def of(view: TrainingView, mesh: Mesh, T_base_object: Float[np.ndarray, "4 4"]) -> "_Look":
        target = view.full
        T_camera_object = se3.invert(view.T_base_color) @ T_base_object
        reach_m = float(np.linalg.norm(mesh[0], axis=1).max())
        rows, columns = image_window(target.camera, T_camera_object[:, 3], reach_m)
        rays = target.camera.rays()[rows, columns]
        expected, normals = first_hit(rays, view.T_base_color, {"": mesh}, {"": T_base_object})
        measured = target.depth_m[rows, columns]
        slack = SAME_M + SAME_FRACTION * measured
        shown = np.isfinite(expected) & target.static_mask[rows, columns] & (measured > 0)
        shown &= np.abs(measured - np.where(np.isfinite(expected), expected, 0.0)) < slack
        return _Look(
            camera=target.camera,
            T_camera_object=T_camera_object,
            corner=(rows.start, columns.start),
            colors=np.moveaxis(target.planes_u8[:, rows, columns], 0, -1) / 255.0,
            expected_m=expected,
            shown=shown,
            trust=_trust(expected, normals),
        )

    def at(
        self, p: Float[np.ndarray, "num_points 3"], normals: Float[np.ndarray, "num_points 3"]
    ) -> tuple[Float[np.ndarray, "num_points 3"], Float[np.ndarray, " num_points"]]:
        """Colours of points of the surface, and how much they count; 0 where they are hidden."""
        seen_m = se3.apply(self.T_camera_object, p)
        towards = -seen_m / np.linalg.norm(seen_m, axis=1, keepdims=True)
        cosine = np.einsum("ij,ij->i", normals @ self.T_camera_object[:3, :3].T, towards)
        row, column, inside = pixels_of(self.camera, seen_m)
        row, column = row - self.corner[0], column - self.corner[1]
        height, width = self.shown.shape
        inside &= (cosine > FACING) & (row >= 0) & (column >= 0) & (row < height) & (column < width)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        inside &= self.shown[row, column] & (seen_m[:, 2] < self.expected_m[row, column] + SAME_M)
        weight = self.trust[row, column] * cosine**2
        between = self.camera.project(seen_m)[0][:, ::-1].T - 0.5 - np.reshape(self.corner, (2, 1))
        colors = [
            ndimage.map_coordinates(plane, between, order=1, mode="nearest")
            for plane in np.moveaxis(self.colors, -1, 0)
        ]
        return np.stack(colors, axis=1), np.where(inside, weight, 0.0)


def _trust(
    depth_m: Float[np.ndarray, "height width"], normals: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width"]:
    """How surely pixels show what is expected there: less near bends, steps and the outline."""
    beside = ~np.isfinite(depth_m)
    level = np.where(beside, 0.0, depth_m)
    smooth = ndimage.uniform_filter(normals, size=(3, 3, 1))
    smooth /= np.maximum(np.linalg.norm(smooth, axis=-1, keepdims=True), 1e-9)
    bends = np.zeros(depth_m.shape, dtype=bool)
    for axis in (0, 1):
        middle, first, second = (
            tuple(part if k == axis else slice(None) for k in (0, 1))
            for part in (slice(1, -1), slice(None, -2), slice(2, None))
        )
        bends[middle] |= np.einsum("ijk,ijk->ij", smooth[first], smooth[second]) < EDGE_COSINE
        step = EDGE_M + SAME_FRACTION * level[first]
        bends[middle] |= np.abs(level[first] - level[second]) > step
    around = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), dtype=bool)
    trust = np.where(ndimage.binary_dilation(bends, around), NEAR_BEND, 1.0)
    return np.where(ndimage.binary_dilation(beside, around), NEAR_OUTLINE, trust)


def weighted_median(
    values: Float[np.ndarray, "num_views num_points num_channels"],
    weights: Float[np.ndarray, "num_views num_points"],
) -> Float[np.ndarray, "num_points num_channels"]:
    """Median over views of each channel; 0 where nothing has weight."""
    order = np.argsort(values, axis=0)
    ranked = np.take_along_axis(values, order, axis=0)
    heavy = np.take_along_axis(np.broadcast_to(weights[..., None], values.shape), order, axis=0)
    total = np.cumsum(heavy, axis=0)
    middle = (total >= total[-1] / 2).argmax(axis=0)
    found = np.take_along_axis(ranked, middle[None], axis=0)[0]
    return np.where(total[-1] > 0, found, 0.0)
