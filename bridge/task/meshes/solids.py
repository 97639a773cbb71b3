"""Solids as signed distances: negative inside, blended where they meet.

The formulas are the usual ones of constructive solid geometry by distance functions; ellipsoids use
a first-order estimate, which is enough for surfaces that are found where the value is zero.
"""

from collections.abc import Callable
from functools import reduce

import numpy as np
from jaxtyping import Float

Solid = Callable[[Float[np.ndarray, "num_points 3"]], Float[np.ndarray, " num_points"]]
"""Signed distance of points to a surface [m]; an estimate away from it."""


def ellipsoid(
    p: Float[np.ndarray, "num_points 3"],
    centre: tuple[float, float, float],
    radii: tuple[float, float, float],
) -> Float[np.ndarray, " num_points"]:
    """Distance to an ellipsoid with its axes along x, y and z, to first order."""
    q = p - np.array(centre)
    scaled = np.linalg.norm(q / np.array(radii), axis=1)
    slope = np.linalg.norm(q / np.array(radii) ** 2, axis=1)
    return np.asarray(
        np.where(slope > 1e-9, scaled * (scaled - 1.0) / np.maximum(slope, 1e-9), -min(radii))
    )


def capsule(
    p: Float[np.ndarray, "num_points 3"],
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    radius_start: float,
    radius_end: float,
) -> Float[np.ndarray, " num_points"]:
    """Distance to a rod with round ends whose radius changes along it."""
    a, b = np.array(start), np.array(end)
    along = np.clip((p - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
    nearest = a + along[:, None] * (b - a)
    return np.asarray(
        np.linalg.norm(p - nearest, axis=1) - (radius_start + along * (radius_end - radius_start))
    )


def cylinder(
    p: Float[np.ndarray, "num_points 3"], radius: float, low: float, high: float
) -> Float[np.ndarray, " num_points"]:
    """Distance to an upright cylinder around the z axis between two heights."""
    side = np.hypot(p[:, 0], p[:, 1]) - radius
    ends = np.abs(p[:, 2] - (low + high) / 2) - (high - low) / 2
    return _corner(side, ends)


def rounded_column(
    p: Float[np.ndarray, "num_points 3"],
    half_x: float,
    half_y: float,
    corner: float,
    low: float,
    high: float,
) -> Float[np.ndarray, " num_points"]:
    """Distance to an upright column over a rectangle with round corners."""
    ends = np.abs(p[:, 2] - (low + high) / 2) - (high - low) / 2
    return _corner(outline(p, half_x, half_y, corner), ends)


def outline(
    p: Float[np.ndarray, "num_points 3"], half_x: float, half_y: float, corner: float
) -> Float[np.ndarray, " num_points"]:
    """Distance in the horizontal plane to a rectangle with round corners."""
    x = np.abs(p[:, 0]) - (half_x - corner)
    y = np.abs(p[:, 1]) - (half_y - corner)
    return np.asarray(_corner(x, y) - corner)


def ring(
    p: Float[np.ndarray, "num_points 3"],
    centre: tuple[float, float, float],
    axis: int,
    radius: float,
    thickness: float,
) -> Float[np.ndarray, " num_points"]:
    """Distance to a torus: ``radius`` to the middle of the bead, ``thickness`` its own radius."""
    q = p - np.array(centre)
    others = [k for k in range(3) if k != axis]
    flat = np.hypot(q[:, others[0]], q[:, others[1]]) - radius
    return np.asarray(np.hypot(flat, q[:, axis]) - thickness)


def blend(
    first: Float[np.ndarray, " num_points"], second: Float[np.ndarray, " num_points"], width: float
) -> Float[np.ndarray, " num_points"]:
    """Smallest of two distances with a fillet about ``width`` wide: a polynomial smooth minimum."""
    overlap = np.maximum(width - np.abs(first - second), 0.0) / width
    return np.asarray(np.minimum(first, second) - overlap**2 * width / 4)


def blend_all(
    distances: list[Float[np.ndarray, " num_points"]], width: float
) -> Float[np.ndarray, " num_points"]:
    """Join several solids with fillets."""
    return reduce(lambda first, second: blend(first, second, width), distances)


def cut(
    solid: Float[np.ndarray, " num_points"], tool: Float[np.ndarray, " num_points"], width: float
) -> Float[np.ndarray, " num_points"]:
    """Take ``tool`` out of ``solid``, with an edge about ``width`` round."""
    return np.asarray(-blend(-solid, tool, width))


def _corner(
    first: Float[np.ndarray, " num_points"], second: Float[np.ndarray, " num_points"]
) -> Float[np.ndarray, " num_points"]:
    """Distance to the intersection of two half planes that meet at a right angle."""
    outside = np.hypot(np.maximum(first, 0.0), np.maximum(second, 0.0))
    return np.asarray(outside + np.minimum(np.maximum(first, second), 0.0))
