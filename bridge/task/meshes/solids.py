"""Solids as signed distances in metres: negative inside, blended where they meet.

The formulas are the usual ones of constructive solid geometry by distance functions; ellipsoids use
a first-order estimate, which is enough for surfaces that are found where the value is zero.
"""

from collections.abc import Callable
from functools import reduce

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.errors import BridgeError

Points = Float[np.ndarray, "num_points 3"]
Distances = Float[np.ndarray, " num_points"]
Three = tuple[float, float, float]
Solid = Callable[[Points], Distances]
"""Signed distance of points to a surface [m]; an estimate away from it."""


def ellipsoid(
    p: Points,
    centre: Three,
    radii: Three,
) -> Distances:
    """Distance to an ellipsoid with its axes along x, y and z, to first order."""
    q = p - np.array(centre)
    scaled = np.linalg.norm(q / np.array(radii), axis=1)
    slope = np.linalg.norm(q / np.array(radii) ** 2, axis=1)
    return np.asarray(
        np.where(slope > 1e-9, scaled * (scaled - 1.0) / np.maximum(slope, 1e-9), -min(radii))
    )


def capsule(
    p: Points,
    start: Three,
    end: Three,
    radius_start: float,
    radius_end: float,
) -> Distances:
    """Distance to a rod with round ends whose radius changes along it."""
    a, b = np.array(start), np.array(end)
    along = np.clip((p - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
    nearest = a + along[:, None] * (b - a)
    return np.asarray(
        np.linalg.norm(p - nearest, axis=1) - (radius_start + along * (radius_end - radius_start))
    )


def cylinder(p: Points, radius: float, low: float, high: float) -> Distances:
    """Distance to an upright cylinder around the z axis between two heights."""
    side = np.hypot(p[:, 0], p[:, 1]) - radius
    ends = np.abs(p[:, 2] - (low + high) / 2) - (high - low) / 2
    return _corner(side, ends)


def rounded_column(
    p: Points,
    half_x: float,
    half_y: float,
    corner: float,
    low: float,
    high: float,
) -> Distances:
    """Distance to an upright column over a rectangle with round corners."""
    ends = np.abs(p[:, 2] - (low + high) / 2) - (high - low) / 2
    return _corner(outline(p, half_x, half_y, corner), ends)


def outline(p: Points, half_x: float, half_y: float, corner: float) -> Distances:
    """Distance in the horizontal plane to a rectangle with round corners."""
    x = np.abs(p[:, 0]) - (half_x - corner)
    y = np.abs(p[:, 1]) - (half_y - corner)
    return np.asarray(_corner(x, y) - corner)


def ring(
    p: Points,
    centre: Three,
    axis: int,
    radius: float,
    thickness: float,
) -> Distances:
    """Distance to a torus: ``radius`` to the middle of the bead, ``thickness`` its own radius."""
    q = p - np.array(centre)
    others = [k for k in range(3) if k != axis]
    flat = np.hypot(q[:, others[0]], q[:, others[1]]) - radius
    return np.asarray(np.hypot(flat, q[:, axis]) - thickness)


def blend(first: Distances, second: Distances, width: float) -> Distances:
    """Smallest of two distances with a fillet about ``width`` wide: a polynomial smooth minimum."""
    overlap = np.maximum(width - np.abs(first - second), 0.0) / width
    return np.asarray(np.minimum(first, second) - overlap**2 * width / 4)


def blend_all(distances: list[Distances], width: float) -> Distances:
    """Join several solids with fillets."""
    return reduce(lambda first, second: blend(first, second, width), distances)


def cut(solid: Distances, tool: Distances, width: float) -> Distances:
    """Take ``tool`` out of ``solid``, with an edge about ``width`` round."""
    return np.asarray(-blend(-solid, tool, width))


def _corner(first: Distances, second: Distances) -> Distances:
    """Distance to the intersection of two half planes that meet at a right angle."""
    outside = np.hypot(np.maximum(first, 0.0), np.maximum(second, 0.0))
    return np.asarray(outside + np.minimum(np.maximum(first, second), 0.0))


# Source: Gibson, "Constrained elastic surface nets" (1998), without the relaxation: one vertex in
# each grid cell that the surface crosses, one quadrangle around each grid edge that it crosses.
# Every inner edge has four cells around it, so a surface that stays inside the grid is closed.

GRADIENT_STEP_M = 1e-5
PROJECTIONS = 4
SHIFTS = (0.0, 0.37, 0.61, 0.23, 0.83, 0.11, 0.47, 0.71, 0.93, 0.53)
"""Of the grid, in cells, tried in this order."""
STEP_FRACTION = 0.4
"""Largest step of one projection, in grid spacings: past a crease it would leap."""


class OpenSurfaceError(BridgeError):
    """A solid reaches the border of the grid it is sampled on."""

    def __init__(self, *, low_m: tuple[float, ...], high_m: tuple[float, ...]) -> None:
        """Remember the grid."""
        self.low_m, self.high_m = low_m, high_m
        super().__init__(
            f"no closed surface on the grid from {low_m} to {high_m} m: the solid leaves it or is "
            "finer than its cells. Give it a larger or a finer one."
        )


def mesh_of(
    solid: Solid,
    low_m: Three,
    high_m: Three,
    spacing_m: float,
) -> tuple[Float[np.ndarray, "num_vertices 3"], Int[np.ndarray, "num_triangles 3"]]:
    """Triangulate the surface of a solid, triangles counter-clockwise seen from outside.

    Where the surface passes a cell twice, as it can where it touches a plane of the grid, the net
    is not a surface: then the grid is shifted by part of a cell. Its corners lie two cells outside.
    """
    for shift in SHIFTS:
        low = np.array(low_m) - shift * spacing_m
        vertices, triangles = _net(solid, low, np.array(high_m), spacing_m)
        if is_closed(triangles):
            return vertices, triangles
    raise OpenSurfaceError(low_m=low_m, high_m=high_m)


def is_closed(triangles: Int[np.ndarray, "num_triangles 3"]) -> bool:
    """Say whether each edge belongs to two triangles, which run along it in opposite directions."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    base = int(triangles.max(initial=0)) + 1
    there, back = edges[:, 0] * base + edges[:, 1], edges[:, 1] * base + edges[:, 0]
    once = 0 < len(np.unique(there)) == len(there)
    return bool(once and np.array_equal(np.sort(there), np.sort(back)))


def _net(
    solid: Solid,
    low_m: Float[np.ndarray, "3"],
    high_m: Float[np.ndarray, "3"],
    spacing_m: float,
) -> tuple[Float[np.ndarray, "num_vertices 3"], Int[np.ndarray, "num_triangles 3"]]:
    axes = [
        np.arange(low, high + spacing_m, spacing_m) for low, high in zip(low_m, high_m, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = solid(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    inside = values < 0.0
    if inside[1:-1, 1:-1, 1:-1].sum() != inside.sum():
        raise OpenSurfaceError(low_m=tuple(low_m.tolist()), high_m=tuple(high_m.tolist()))
    cells = [length - 1 for length in grid.shape[:3]]
    total = np.zeros((*cells, 3))
    count = np.zeros(total.shape[:3], dtype=np.int64)
    for axis in range(3):
        _add_crossings(values, inside, axis, total, count)
    active = count > 0
    ids = np.full(active.shape, -1, dtype=np.int64)
    ids[active] = np.arange(int(active.sum()))
    vertices = low_m + spacing_m * (total[active] / count[active][:, None])
    quads = np.concatenate([_quads(inside, ids, axis) for axis in range(3)])
    vertices = project(solid, vertices, STEP_FRACTION * spacing_m)
    return vertices, _triangles(vertices, quads)


def project(solid: Solid, points: Points, largest_step_m: float) -> Points:
    """Move points onto the surface along the gradient of the distance, in ``PROJECTIONS`` steps."""
    for _ in range(PROJECTIONS):
        value = solid(points)
        gradient = gradient_of(solid, points)
        squared = np.maximum(np.sum(gradient**2, axis=1), 0.05)
        step = -gradient * (value / squared)[:, None]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        points = points + step * np.minimum(1.0, largest_step_m / np.maximum(length, 1e-12))
    return points


def gradient_of(solid: Solid, points: Points) -> Points:
    """Central differences of a signed distance."""
    columns = []
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = GRADIENT_STEP_M
        columns.append((solid(points + shift) - solid(points - shift)) / (2 * GRADIENT_STEP_M))
    return np.stack(columns, axis=1)


def _along(axis: int, *parts: slice) -> tuple[slice, ...]:
    """Slices for the three axes, given for ``axis`` and the two that follow it cyclically."""
    chosen = [slice(None)] * 3
    for offset, part in enumerate(parts):
        chosen[(axis + offset) % 3] = part
    return tuple(chosen)


def _add_crossings(
    values: Float[np.ndarray, "nx ny nz"],
    inside: Bool[np.ndarray, "nx ny nz"],
    axis: int,
    total: Float[np.ndarray, "cx cy cz 3"],
    count: Int[np.ndarray, "cx cy cz"],
) -> None:
    """Add where the grid edges along one axis are crossed to the cells around each edge."""
    first, second = _along(axis, slice(None, -1)), _along(axis, slice(1, None))
    low, high = values[first], values[second]
    crossed = inside[first] != inside[second]
    fraction = np.where(crossed, low / np.where(crossed, low - high, 1.0), 0.0)
    where = np.moveaxis(np.indices(low.shape), 0, -1).astype(np.float64)
    where[..., axis] += fraction
    cells = total.shape
    for shift_b in (0, 1):
        for shift_c in (0, 1):
            span_b = slice(shift_b, cells[(axis + 1) % 3] + shift_b)
            span_c = slice(shift_c, cells[(axis + 2) % 3] + shift_c)
            chosen = _along(axis, slice(None), span_b, span_c)
            total += np.where(crossed[chosen][..., None], where[chosen], 0.0)
            count += crossed[chosen]


def _quads(
    inside: Bool[np.ndarray, "nx ny nz"], ids: Int[np.ndarray, "cx cy cz"], axis: int
) -> Int[np.ndarray, "num_quads 4"]:
    """Quadrangles around the crossed grid edges along one axis."""
    starts = inside[_along(axis, slice(None, -1))]
    crossed = starts != inside[_along(axis, slice(1, None))]
    edges = np.argwhere(crossed)
    corners = []
    for back_b, back_c in ((1, 1), (0, 1), (0, 0), (1, 0)):
        cell = edges.copy()
        cell[:, (axis + 1) % 3] -= back_b
        cell[:, (axis + 2) % 3] -= back_c
        corners.append(ids[cell[:, 0], cell[:, 1], cell[:, 2]])
    quads = np.stack(corners, axis=1)
    leaving = starts[edges[:, 0], edges[:, 1], edges[:, 2]]
    return np.asarray(np.where(leaving[:, None], quads, quads[:, ::-1]))


def _triangles(
    vertices: Float[np.ndarray, "num_vertices 3"], quads: Int[np.ndarray, "num_quads 4"]
) -> Int[np.ndarray, "num_triangles 3"]:
    """Cut each quadrangle along its shorter diagonal."""
    a, b, c, d = (vertices[quads[:, k]] for k in range(4))
    first = np.sum((a - c) ** 2, axis=1) <= np.sum((b - d) ** 2, axis=1)
    one = np.where(first[:, None], quads[:, [0, 1, 2]], quads[:, [1, 2, 3]])
    two = np.where(first[:, None], quads[:, [0, 2, 3]], quads[:, [1, 3, 0]])
    return np.concatenate([one, two])
