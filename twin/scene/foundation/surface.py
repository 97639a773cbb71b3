"""Points on a surface, and which of them a camera sees."""

import numpy as np
from jaxtyping import Bool, Float, Int

from twin.errors import TwinError


class MetricFitError(TwinError):
    """The shape does not lie on the measured points, whatever its size and place."""


def sample_surface(
    vertices: Float[np.ndarray, "num_vertices 3"],
    faces: Int[np.ndarray, "num_faces 3"],
    num_samples: int,
    seed: int,
) -> tuple[Float[np.ndarray, "num_samples 3"], Float[np.ndarray, "num_samples 3"]]:
    """Points spread evenly over triangles, and the unit normals there.

    Raises:
        MetricFitError: When the triangles have no area.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    if not len(faces) or not area.sum() > 0.0 or not np.isfinite(area).all():
        message = f"the shape's {len(faces)} triangles have no area; generate it again."
        raise MetricFitError(message)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(faces), size=num_samples, p=area / area.sum())
    u, v = rng.uniform(size=(2, num_samples))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = np.moveaxis(corners[chosen], 1, 0)
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return points, normals[chosen] / area[chosen][:, None]


def visible_mask(
    points_m: Float[np.ndarray, "num_samples 3"],
    normals: Float[np.ndarray, "num_samples 3"],
    camera_centres_m: Float[np.ndarray, "num_views 3"],
    cell_m: float,
) -> Bool[np.ndarray, " num_samples"]:
    """Which samples of a surface some camera sees: the nearest in their direction, within a cell.

    Directions are sorted into cells as wide as ``cell_m`` at the object's distance.
    """
    seen = np.zeros(len(points_m), dtype=bool)
    for centre in camera_centres_m:
        ray = points_m - centre
        distance = np.linalg.norm(ray, axis=1)
        forward = ray.mean(axis=0) / np.linalg.norm(ray.mean(axis=0))
        helper = np.eye(3)[np.argmin(np.abs(forward))]
        right = np.cross(forward, helper)
        right /= np.linalg.norm(right)
        plane = ray @ np.stack([right, np.cross(forward, right)], axis=1)
        along = np.maximum(ray @ forward, 1e-9)
        cells = np.floor(plane / along[:, None] * (distance.mean() / cell_m)).astype(np.int64)
        cells -= cells.min(axis=0)
        key = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
        _, key = np.unique(key, return_inverse=True)
        nearest = np.full(key.max() + 1, np.inf)
        np.minimum.at(nearest, key, distance)
        # A slanted surface is deeper across one cell than a frontal one.
        slant = np.abs((ray * normals).sum(axis=1)) / distance
        allowed = 1.5 * cell_m / np.maximum(slant, 0.3)
        seen |= distance <= nearest[key] + allowed
    return seen


def surface_area(
    vertices: Float[np.ndarray, "num_vertices 3"], faces: Int[np.ndarray, "num_faces 3"]
) -> float:
    """Of all triangles, in squared units of the vertices."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)
