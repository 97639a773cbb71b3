"""What things stand on, and which way is up.

The support plane is nearly level, found by RANSAC and refined by least squares. In a robot cell z
points up. The frame of a foreign scan may be that of its first camera: there up is the direction
that most surfaces face which the cameras saw from above.

Depth cameras bend planes: they read farther or nearer towards the edges of their images, and poses
are wrong by millimetres. A table of a metre comes out as a bowl of 10 to 20 mm, more than what
stands out of it may be high. A surface of second degree follows that, and no thing that stands on
the plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from bridge.geometry import se3
from twin.naming.things import SemanticsError
from twin.scene.semantics.points import SurfacePoints

UP = np.array([0.0, 0.0, 1.0])
"""Against gravity in the root frame of a robot cell."""
MAX_TILT_RAD = 0.14
"""From level: poses may be wrong by a few degrees, a ramp is no table."""
TOLERANCE_M = 0.006
"""Points this near belong to the plane."""
NUM_TRIALS, MAX_POINTS = 500, 6000
"""Triples of points to try, and points that vote; more are thinned out evenly."""
MIN_POINTS, MIN_AREA_M2 = 100, 0.06
"""A plane with fewer points carries nothing, and neither does a smaller one: it is the top of a
thing."""
NUM_CANDIDATES = 3
"""Planes among which the one that carries most is chosen (table and floor)."""
SEPARATION_M = 0.04
"""Level planes nearer than this are one surface that is not quite flat."""
CELL_M = 0.02
"""Size of the cells that say where the plane extends."""


class NoSupportError(SemanticsError):
    """No level plane was found."""


@dataclass(frozen=True, kw_only=True)
class Bend:
    """Heights of the measured plane over the true one."""

    center_m: Float[np.ndarray, "2"]
    reach_m: float
    """Half the side of the square around the centre in which it was measured."""
    coefficients_m: Float[np.ndarray, "6"]
    """Of 1, x, y, x^2, xy, y^2, with x and y in units of ``reach_m``."""

    def height_m(self, p_m: Float[np.ndarray, "num_points _"]) -> Float[np.ndarray, " num_points"]:
        """Over the plane at these x and y; beyond where it was measured as at the border."""
        xy = np.clip((p_m[:, :2] - self.center_m) / self.reach_m, -1.0, 1.0)
        return np.asarray(_terms(xy) @ self.coefficients_m)


@dataclass(frozen=True, kw_only=True)
class SupportPlane:
    """Points p of the plane fulfil ``normal . p = offset_m``."""

    normal: Float[np.ndarray, "3"]
    """Unit vector, upwards."""
    offset_m: float
    num_points: int
    """Points that voted for it."""
    footprint: Bool[np.ndarray, "num_x num_y"]
    """Where it extends, seen along z: cells with support and the holes between them."""
    corner_m: tuple[float, float]
    """Lower x and y of the first cell."""
    bend: Bend | None = None
    """As measured, where that is far from flat."""

    @property
    def area_m2(self) -> float:
        """Of the footprint, seen along z."""
        return float(self.footprint.sum()) * CELL_M**2

    def height_m(self, p_m: Float[np.ndarray, "num_points 3"]) -> Float[np.ndarray, " num_points"]:
        """Distance above the plane as it was measured; negative below [m]."""
        height_m = p_m @ self.normal - self.offset_m
        return np.asarray(height_m if self.bend is None else height_m - self.bend.height_m(p_m))

    def under(self, p_m: Float[np.ndarray, "num_points 3"]) -> Bool[np.ndarray, " num_points"]:
        """Say which points lie above or below where the plane extends."""
        cells = np.floor((p_m[:, :2] - self.corner_m) / CELL_M).astype(np.int64)
        inside = np.all((cells >= 0) & (cells < self.footprint.shape), axis=1)
        cells[~inside] = 0
        return np.asarray(inside & self.footprint[cells[:, 0], cells[:, 1]])

    def behind_things(self, reach_m: float) -> "SupportPlane":
        """The plane with what things up to twice as wide hide of it: gaps in its outline."""
        reach = reach_m / CELL_M
        grid = np.pad(self.footprint, round(reach) + 1)
        near = ndimage.distance_transform_edt(~grid) <= reach
        whole = grid | (ndimage.distance_transform_edt(near) > reach)
        x_m, y_m = (low_m - (round(reach) + 1) * CELL_M for low_m in self.corner_m)
        return replace(self, footprint=whole, corner_m=(x_m, y_m))


def find_support(points: SurfacePoints) -> SupportPlane:
    """Find the level plane that carries most of what is near it.

    Fischler and Bolles 1981 on the points that face upwards, with the tilt bounded. Of the
    largest few planes the one with most points on it and just above it wins: a floor may be
    larger than the table, but less stands on the part of it that is seen.
    """
    left = points.p_m[_faces_up(points)]
    planes: list[tuple[int, SupportPlane]] = []
    for _ in range(NUM_CANDIDATES):
        plane = _largest_plane(left)
        if plane is None:
            break
        left = left[np.abs(plane.height_m(left)) > SEPARATION_M]
        if plane.area_m2 < MIN_AREA_M2:
            continue
        height = plane.height_m(points.p_m)
        carried = (height > 2 * TOLERANCE_M) & (height < 0.3)
        carried[carried] = plane.under(points.p_m[carried])
        planes.append((plane.num_points + int(carried.sum()), plane))
    if not planes:
        raise NoSupportError(no_support(points))
    return max(planes, key=lambda item: item[0])[1]


BEND_ROUNDS = 10
"""Of least squares with weights."""
CUT_TOLERANCES = 3.0
"""Points farther off than so many tolerances have no weight (Tukey's biweight)."""
BEND_CELL_M = 0.05
"""Every cell of this size counts the same, however many points lie in it."""
BENT_M = 0.02
"""Points that face up and are this near to a plane say how it is bent."""
WORTH = 0.75
"""A bend counts where it leaves less than this share of the roughness."""


def as_measured(plane: SupportPlane, points: SurfacePoints) -> SupportPlane:
    """The plane with the bend that the cameras gave it; the same where it is flat."""
    near = (np.abs(plane.height_m(points.p_m)) < BENT_M) & _faces_up(points)
    if int(near.sum()) < MIN_POINTS:
        return plane
    p = points.p_m[near]
    bent = replace(plane, bend=_fit_bend(p, plane.height_m(p)))
    inside = np.abs(bent.height_m(p)) < TOLERANCE_M
    if int(inside.sum()) < MIN_POINTS:
        return plane
    footprint, corner_m = _footprint(p[inside])
    bent = replace(bent, footprint=footprint, corner_m=corner_m)
    before, after = (roughness_m(points, item) for item in (plane, bent))
    return bent if after < WORTH * before else plane


def _fit_bend(
    p_m: Float[np.ndarray, "num_points 3"], height_m: Float[np.ndarray, " num_points"]
) -> Bend:
    """Fit it to points near the plane, robustly: what stands on the plane is among them."""
    center_m = p_m[:, :2].mean(axis=0)
    reach_m = float(np.abs(p_m[:, :2] - center_m).max())
    A = _terms((p_m[:, :2] - center_m) / reach_m)
    cells = np.floor(p_m[:, :2] / BEND_CELL_M).astype(np.int64)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    share = 1.0 / count[cell.reshape(-1)]
    x = np.zeros(A.shape[1])
    for _ in range(BEND_ROUNDS):
        off = (height_m - A @ x) / (CUT_TOLERANCES * TOLERANCE_M)
        root = np.sqrt(share) * np.clip(1.0 - off**2, 0.0, None)
        x = np.linalg.lstsq(A * root[:, None], height_m * root, rcond=None)[0]
    return Bend(center_m=center_m, reach_m=reach_m, coefficients_m=x)


def _terms(xy: Float[np.ndarray, "num_points 2"]) -> Float[np.ndarray, "num_points 6"]:
    x, y = xy.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def no_support(points: SurfacePoints) -> str:
    """What to tell somebody whose scene has no level plane, nor anything that stands out."""
    return (
        f"no level plane among {len(points)} points, {int(_faces_up(points).sum())} of them facing "
        "up, and nothing that stands out. The default segmenter needs a table in view, or things "
        "before a wall."
    )


def _faces_up(points: SurfacePoints) -> Bool[np.ndarray, " num_points"]:
    return np.asarray(points.normals @ UP > np.cos(3 * MAX_TILT_RAD))


def _largest_plane(p_m: np.ndarray) -> SupportPlane | None:
    if len(p_m) < MIN_POINTS:
        return None
    rng = np.random.default_rng(0)
    some = p_m[:: max(1, len(p_m) // MAX_POINTS)]
    triples = some[rng.integers(0, len(some), (NUM_TRIALS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(length, 1e-12)[:, None]
    normals *= np.sign(normals[:, 2:] + 1e-12)
    level = (length > 1e-9) & (normals @ UP > np.cos(MAX_TILT_RAD))
    # The exactly level plane through one point is always among the trials.
    normals[~level] = UP
    offsets = (normals * triples[:, 0]).sum(axis=1)
    votes = (np.abs(normals @ some.T - offsets[:, None]) < TOLERANCE_M).sum(axis=1)
    best = int(np.argmax(votes))
    normal, offset = normals[best], float(offsets[best])
    inside = np.abs(p_m @ normal - offset) < TOLERANCE_M
    for _ in range(3):
        if inside.sum() < MIN_POINTS:
            return None
        normal, offset = _refined(p_m[inside])
        inside = np.abs(p_m @ normal - offset) < TOLERANCE_M
    if inside.sum() < MIN_POINTS:
        return None
    footprint, corner = _footprint(p_m[inside])
    return SupportPlane(
        normal=normal,
        offset_m=offset,
        num_points=int(inside.sum()),
        footprint=footprint,
        corner_m=corner,
    )


def _refined(p_m: np.ndarray) -> tuple[np.ndarray, float]:
    """Least squares for z over x and y, the tilt bounded."""
    centre = p_m.mean(axis=0)
    away = p_m - centre
    scatter = away[:, :2].T @ away[:, :2] + 1e-9 * len(p_m) * np.eye(2)
    slope = np.linalg.solve(scatter, away[:, :2].T @ away[:, 2])
    steepness = float(np.linalg.norm(slope))
    slope *= min(1.0, np.tan(MAX_TILT_RAD) / max(steepness, 1e-12))
    normal = np.array([-slope[0], -slope[1], 1.0])
    normal /= np.linalg.norm(normal)
    return normal, float(normal @ centre)


def _footprint(p_m: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """Cells with points, small gaps closed, and the holes where things stand."""
    cells = np.floor(p_m[:, :2] / CELL_M).astype(np.int64)
    low = cells.min(axis=0) - 3
    grid = np.zeros(cells.max(axis=0) - low + 4, dtype=bool)
    grid[tuple((cells - low).T)] = True
    closed = ndimage.binary_closing(grid, iterations=3)
    filled = np.asarray(ndimage.binary_fill_holes(closed | grid))
    return filled, (float(low[0] * CELL_M), float(low[1] * CELL_M))


MIN_SHARE_OF_BEST = 0.3
"""z is up where at least this share of the points that face the best direction face z."""
FACING_RAD = 0.14
"""Surfaces face a direction within this angle."""
UPWARDS = 0.5
"""Cosine between up and the mean of the cameras' upper edges: nobody scans upside down."""
MAX_NORMALS, MAX_DIRECTIONS = 8000, 400
REFINEMENTS = 2


def level_frame(
    points: SurfacePoints, Ts_base_camera: Sequence[Float[np.ndarray, "4 4"]]
) -> Float[np.ndarray, "4 4"]:
    """Turn the scene so that z points up: ``T_level_base``, exactly the identity where it does.

    A direction counts by the points that face it. Up must lie within 60 degrees of what the
    cameras on average have as their image's upper edge, which leaves walls out. Then the support
    plane found along it says exactly where up is.

    Args:
        Ts_base_camera: Where the cameras stood; none: z is up.
    """
    if not len(Ts_base_camera) or len(points) < MIN_POINTS:
        return np.eye(4)
    camera_up = -np.mean([T[:3, 1] for T in Ts_base_camera], axis=0)
    camera_up /= max(float(np.linalg.norm(camera_up)), 1e-9)
    some = points.normals[:: max(1, len(points) // MAX_NORMALS)]
    directions = some[some @ camera_up > UPWARDS]
    directions = directions[:: max(1, len(directions) // MAX_DIRECTIONS)]
    if not len(directions):
        return np.eye(4)
    limit = np.cos(FACING_RAD)
    facing = (directions @ some.T > limit).sum(axis=1)
    if int((some @ UP > limit).sum()) >= MIN_SHARE_OF_BEST * int(facing.max()):
        return np.eye(4)
    up = directions[int(facing.argmax())]
    up = _normalised(some[some @ up > limit].mean(axis=0))
    for _ in range(REFINEMENTS):
        T = _turned_up(up)
        p_m, normals = (rows @ T[:3, :3].T for rows in (points.p_m, points.normals))
        try:
            plane = find_support(replace(points, p_m=p_m, normals=normals))
        except NoSupportError:
            break
        up = T[:3, :3].T @ plane.normal
    return _turned_up(up)


def _normalised(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / max(float(np.linalg.norm(v)), 1e-12))


def _turned_up(up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """A rotation that carries ``up`` to z; x stays as near to the old x (or y) as it can."""
    other = np.eye(3)[int(np.abs(up[0]) > np.abs(up[1]))]
    x = _normalised(other - up * (other @ up))
    return se3.from_rotation(np.stack([x, np.cross(up, x), up]), np.zeros(3))


def roughness_m(points: SurfacePoints, plane: SupportPlane) -> float:
    """Standard deviation of what belongs to the plane across it, by the median: noise and warp.

    Upright points within five tolerances count as the plane.
    """
    height = plane.height_m(points.p_m)
    near = (np.abs(height) < 5 * TOLERANCE_M) & (points.normals @ UP > np.cos(FACING_RAD))
    near[near] = plane.under(points.p_m[near])
    return 1.4826 * float(np.median(np.abs(height[near]))) if near.any() else 0.0
