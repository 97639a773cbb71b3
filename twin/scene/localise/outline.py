"""The outline of an object in an image: where its colour ends, and where its shape would end.

Seen from outside, the outline of a box, open or not, is the convex hull of its eight projected
corners. Outlines do not depend on the depth scale, and cover the edges that depth blurs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from twin.scene.localise.colour import ColourConfig, likeness
from twin.scene.localise.points import View

EDGE_LIKENESS = 0.5
"""Half object, half background."""
OCCLUDER_M = 0.012
"""Something this much nearer than the edge hides the object's true outline."""
BESIDE_PX = 3.0


@dataclass(frozen=True, kw_only=True)
class Outline:
    """Edge points of an object's colour in one view."""

    view_id: int
    view: View
    edge_px: Float[np.ndarray, "num_edges 2"]
    sigma_m: float
    """Standard error of one edge point, at the object's distance."""
    px_m: float
    """Size of a pixel at the object's distance."""


def corners(model: ObjectModel) -> Float[np.ndarray, "8 3"]:
    """Outer corners in the object frame [m]."""
    half = np.array(model.size_m) / 2
    centre = np.array([0.0, 0.0, 0.0 if model.origin_at_centre else half[2]])
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return centre + signs * half


def find_outlines(
    views: Sequence[View],
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
    colour: ColourConfig,
    *,
    window_m: float,
    sigma_px: float,
) -> list[Outline]:
    """Collect the edge points near where the object is believed to be.

    Points at the image border and points beside something nearer are left out: there the object
    goes on.
    """
    outlines = []
    for view_id, view in enumerate(views):
        p_camera = se3.apply(se3.invert(view.T_base_color) @ T_base_object, corners(model))
        if np.any(p_camera[:, 2] < 0.05):
            continue
        uv, z = view.color_camera.project(p_camera)
        px_m = float(z.mean()) / view.color_camera.fx
        window = _window(uv, view.image_linear.shape, window_m / px_m)
        if window is None:
            continue
        rows, columns = window
        score = likeness(view.image_linear[rows, columns], model.color_srgb, colour)
        edge, outward = _crossings(np.minimum(score, 1.0))
        edge = edge + np.array([columns.start, rows.start])
        free = ~_occluded(view, edge + BESIDE_PX * outward, float(z.min()))
        if free.any():
            outlines.append(
                Outline(
                    view_id=view_id,
                    view=view,
                    edge_px=edge[free],
                    sigma_m=sigma_px * px_m,
                    px_m=px_m,
                )
            )
    return outlines


def _window(
    uv: Float[np.ndarray, "8 2"], shape: tuple[int, ...], margin_px: float
) -> tuple[slice, slice] | None:
    low = np.maximum(np.floor(uv.min(axis=0) - margin_px).astype(int), 0)
    high = np.minimum(np.ceil(uv.max(axis=0) + margin_px).astype(int), (shape[1], shape[0]))
    if np.any(high - low < 3):
        return None
    return slice(low[1], high[1]), slice(low[0], high[0])


def _crossings(
    score: Float[np.ndarray, "height width"],
) -> tuple[Float[np.ndarray, "num_edges 2"], Float[np.ndarray, "num_edges 2"]]:
    """Sub-pixel places (x, y) where neighbouring pixels pass the edge level, and the way out."""
    edges, outwards = [], []
    for axis in (0, 1):
        first = score[:-1] if axis == 0 else score[:, :-1]
        second = score[1:] if axis == 0 else score[:, 1:]
        row, column = np.nonzero((first >= EDGE_LIKENESS) != (second >= EDGE_LIKENESS))
        a, b = first[row, column], second[row, column]
        fraction = (EDGE_LIKENESS - a) / (b - a)
        step = np.array([0.0, 1.0]) if axis == 0 else np.array([1.0, 0.0])
        centre = np.stack([column, row], axis=1) + 0.5
        edges.append(centre + fraction[:, None] * step)
        outwards.append(np.where((a > b)[:, None], step, -step))
    return np.concatenate(edges), np.concatenate(outwards)


def _occluded(
    view: View, beside_px: Float[np.ndarray, "num_edges 2"], nearest_m: float
) -> Bool[np.ndarray, " num_edges"]:
    """Whether what lies just outside an edge is nearer than the object; True off the image."""
    camera = view.color_camera
    ray = np.column_stack(
        [
            (beside_px[:, 0] - camera.cx) / camera.fx,
            (beside_px[:, 1] - camera.cy) / camera.fy,
            np.ones(len(beside_px)),
        ]
    )
    T_depth_color = se3.invert(view.T_base_depth) @ view.T_base_color
    uv, _ = view.depth_camera.project(se3.apply(T_depth_color, ray * nearest_m))
    height, width = view.depth_m.shape
    inside = np.all((uv >= 0) & (uv < (width, height)), axis=1)
    inside &= np.all((beside_px >= 0) & (beside_px < (camera.width, camera.height)), axis=1)
    column_row = np.where(inside[:, None], uv, 0.0).astype(np.int64)
    depth = view.depth_m[column_row[:, 1], column_row[:, 0]]
    return np.asarray(~inside | ((depth > 0) & (depth < nearest_m - OCCLUDER_M)))


def outline_distances(
    outline: Outline, model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " num_edges"]:
    """Signed distance of each edge point to the predicted outline, positive outside [m]."""
    T_camera_object = se3.invert(outline.view.T_base_color) @ T_base_object
    uv, _ = outline.view.color_camera.project(se3.apply(T_camera_object, corners(model)))
    hull = ConvexHull(uv)
    normals, offsets = hull.equations[:, :2], hull.equations[:, 2]
    beyond = outline.edge_px @ normals.T + offsets
    # Outside, beyond a corner, the largest half-plane distance is a lower bound; close enough.
    return np.asarray(beyond.max(axis=1)) * outline.px_m
