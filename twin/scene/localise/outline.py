"""Outlines of boxes in images, by colour.

Seen from outside, the outline of a box, open or not, is the convex hull of its eight projected
corners. Outlines do not depend on the depth scale, and cover the edges that depth blurs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from bridge.task.task_file import ObjectModel
from twin.scene.frames.downscaled import pixels_of
from twin.scene.localise.points import CameraView, likeness

EDGE_LIKENESS = 0.5
"""Half object, half background."""
OCCLUDER_M = 0.012
"""Something this much nearer than the edge hides the object's true outline."""
BESIDE_PX = 3.0
OUTLINE_SIGMA_PX = 0.7
"""Standard error of one edge point."""


@dataclass(frozen=True, kw_only=True)
class Outline:
    """Edge points of an object's colour in one view."""

    view_id: int
    view: CameraView
    edge_px: Float[np.ndarray, "num_edges 2"]
    sigma_m: float
    """Standard error of one edge point, at the object's distance."""
    px_m: float
    """Size of a pixel at the object's distance."""
    corners_m: Float[np.ndarray, "8 3"]
    """Of the object, in its frame."""


def corners(model: ObjectModel) -> Float[np.ndarray, "8 3"]:
    """Outer corners in the object frame [m]."""
    size = np.array(model.size_m)
    lift_m = 0.0 if model.origin_at_centre else size[2] / 2
    return np.asarray(box_corners(size) + np.array([0.0, 0.0, lift_m]))


def find_outlines(
    views: Sequence[CameraView],
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
    window_m: float,
) -> list[Outline]:
    """Collect the edge points near the nominal pose of the object.

    Points at the image border and points beside something nearer are left out: there the object
    goes on.
    """
    outlines, corners_m = [], corners(model)
    for view_id, view in enumerate(views):
        p_camera = se3.apply(se3.invert(view.T_base_color) @ T_base_object, corners_m)
        if np.any(p_camera[:, 2] < 0.05):
            continue
        uv, z = view.color_camera.project(p_camera)
        px_m = float(z.mean()) / view.color_camera.fx
        margin_px, (height, width) = window_m / px_m, view.image_linear.shape[:2]
        low = np.maximum(np.floor(uv.min(axis=0) - margin_px).astype(int), 0)
        high = np.minimum(np.ceil(uv.max(axis=0) + margin_px).astype(int), (width, height))
        if np.any(high - low < 3):
            continue
        rows, columns = slice(low[1], high[1]), slice(low[0], high[0])
        score = likeness(view.image_linear[rows, columns], model.color_srgb)
        edge, outward = _crossings(np.minimum(score, 1.0))
        edge = edge + np.array([columns.start, rows.start])
        free = ~_occluded(view, edge + BESIDE_PX * outward, float(z.min()))
        if free.any():
            outlines.append(
                Outline(
                    view_id=view_id,
                    view=view,
                    edge_px=edge[free],
                    sigma_m=OUTLINE_SIGMA_PX * px_m,
                    px_m=px_m,
                    corners_m=corners_m,
                )
            )
    return outlines


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
    view: CameraView, beside_px: Float[np.ndarray, "num_edges 2"], nearest_m: float
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
    p_depth = se3.apply(T_depth_color, ray * nearest_m)
    row, column, inside = pixels_of(view.depth_camera, p_depth)
    inside &= np.all((beside_px >= 0) & (beside_px < (camera.width, camera.height)), axis=1)
    depth = view.depth_m[np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.asarray(~inside | ((depth > 0) & (depth < nearest_m - OCCLUDER_M)))


def outline_distances(
    outline: Outline, T_base_object: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " num_edges"]:
    """Signed distance of each edge point to the predicted outline, positive outside [m]."""
    T_camera_object = se3.invert(outline.view.T_base_color) @ T_base_object
    uv, _ = outline.view.color_camera.project(se3.apply(T_camera_object, outline.corners_m))
    hull = ConvexHull(uv)
    normals, offsets = hull.equations[:, :2], hull.equations[:, 2]
    beyond = outline.edge_px @ normals.T + offsets
    # Outside, beyond a corner, the largest half-plane distance is a lower bound; close enough.
    return np.asarray(beyond.max(axis=1)) * outline.px_m
