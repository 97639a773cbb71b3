"""Describe the shape of a thing on its support plane: height map, cavity, box and a word."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from twin.naming.things import UNKNOWN_SHAPE
from twin.scene.shape.known import rectangle_yaw_rad

CONTAINER_RATIO = 1.8
"""Convex hull over filled volume; more, with a cavity that opens upwards, is a container."""
CONTAINER = "open container"
NUM_LEVELS = 48
LEAST_DEPTH = 0.2
"""Of a cavity, in heights of the thing."""


@dataclass(frozen=True, kw_only=True)
class HeightMap:
    """The highest point over each cell of the plane."""

    top_m: Float[np.ndarray, "num_x num_y"]
    """Above the plane; 0 outside the footprint."""
    footprint: Bool[np.ndarray, "num_x num_y"]
    corner_m: tuple[float, float]
    cell_m: float

    def cells(self, xyh_m: Float[np.ndarray, "num_points 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Cell of each point; points beyond the map go to its edge, which is outside."""
        index = np.floor((xyh_m[:, :2] - self.corner_m) / self.cell_m).astype(np.int64)
        index = np.clip(index, 0, np.array(self.top_m.shape) - 1)
        return index[:, 0], index[:, 1]


@dataclass(frozen=True, kw_only=True)
class HeightMapCavity:
    """Where water would stand."""

    mask: Bool[np.ndarray, "num_x num_y"]
    """Cells of the height map."""
    rim_m: float
    """Height at which it would overflow."""
    floor_m: float


@dataclass(frozen=True, kw_only=True)
class ShapeDescriptors:
    """What a thing looks like, in numbers and in a word."""

    word: str
    """One of ``SHAPE_WORDS``."""
    centre_m: Float[np.ndarray, "3"]
    """Of the box around it: x, y, height above the plane."""
    size_m: tuple[float, float, float]
    """Longer side, shorter side, height."""
    yaw_rad: float
    """Direction of the longer side."""
    cavity: HeightMapCavity | None


def height_map(xyh_m: Float[np.ndarray, "num_points 3"], cell_m: float) -> HeightMap:
    """Highest point per cell; cells within the outline that show none take their neighbour's."""
    cells = np.floor(xyh_m[:, :2] / cell_m).astype(np.int64)
    low = cells.min(axis=0) - 3
    shape = cells.max(axis=0) - low + 4
    top = np.full(shape, -np.inf)
    np.maximum.at(top, tuple((cells - low).T), xyh_m[:, 2])
    known = np.isfinite(top)
    footprint = ndimage.binary_fill_holes(ndimage.binary_closing(known, iterations=2) | known)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    top = np.where(footprint, np.maximum(top[tuple(nearest)], 0.0), 0.0)
    return HeightMap(
        top_m=top,
        footprint=np.asarray(footprint),
        corner_m=(float(low[0] * cell_m), float(low[1] * cell_m)),
        cell_m=cell_m,
    )


def find_height_map_cavity(heights: HeightMap) -> HeightMapCavity | None:
    """Flood the height map; None when hardly any water would stand.

    Each level is closed by three cells first, so that a gap in a noisy rim does not drain it.
    The rim is the highest level that still holds half the area of the widest.
    """
    height = float(heights.top_m.max())
    levels = np.linspace(0.0, height, NUM_LEVELS + 1)[1:]
    pools = []
    for level in levels:
        dry = heights.top_m >= level
        dam = ndimage.binary_closing(dry, iterations=1) | dry
        pools.append(ndimage.binary_fill_holes(dam) & ~dam)
    areas = np.array([int(pool.sum()) for pool in pools])
    if not areas.any():
        return None
    last = int(np.flatnonzero(areas >= 0.5 * areas.max())[-1])
    rim = float(levels[last])
    # A handle or a gap may drain a part of it just below the rim: look from half its depth on.
    lowest = float(heights.top_m[pools[last]].min())
    pool = np.any([pools[k] for k in range(last + 1) if levels[k] >= (rim + lowest) / 2], axis=0)
    floor = float(np.quantile(heights.top_m[pool], 0.3))
    deep = rim - floor > max(LEAST_DEPTH * height, 0.006)
    wide = pool.sum() > 0.15 * heights.footprint.sum()
    if not (deep and wide):
        return None
    return HeightMapCavity(mask=pool, rim_m=rim, floor_m=floor)


def measure_shape(
    xyh_m: Float[np.ndarray, "num_points 3"], cell_m: float, *, rough: bool = False
) -> ShapeDescriptors:
    """Measure a thing from the points of its visible surface.

    Args:
        rough: They lie so far off it that flat and round look alike.
    """
    low, high = np.quantile(xyh_m, [0.005, 0.995], axis=0)
    extent = float((high - low).max())
    heights = height_map(xyh_m, max(cell_m, extent / 48))
    centre_xy, sides, yaw, fill = _rectangle(xyh_m[:, :2])
    top = float(high[2])
    solid = float(heights.top_m.sum()) * heights.cell_m**2
    ratio = _hull_volume(xyh_m) / max(solid, 1e-12)
    cavity = find_height_map_cavity(heights)
    size = (float(sides[0]), float(sides[1]), top)
    return ShapeDescriptors(
        word=_word(xyh_m, heights, size, fill, ratio, None if rough else cavity, rough),
        centre_m=np.array([*centre_xy, top / 2]),
        size_m=size,
        yaw_rad=float(yaw),
        cavity=cavity,
    )


def _hull_volume(points: np.ndarray) -> float:
    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):  # fewer than four points, or all in one plane
        return 0.0


def _rectangle(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Smallest rectangle around points: centre, sides (longer first), yaw, share that is hull."""
    yaw = rectangle_yaw_rad(xy, kept_percent=100.0)
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s], [s, c]])
    low, high = (xy @ R).min(axis=0), (xy @ R).max(axis=0)
    sides = np.maximum(high - low, 1e-6)
    fill = _hull_volume(xy) / float(np.prod(sides))
    if sides[1] > sides[0]:
        sides, yaw = sides[::-1], yaw + np.pi / 2
    return R @ (low + high) / 2, sides, float((yaw + np.pi / 2) % np.pi - np.pi / 2), fill


SLAB, BLOCK = 0.2, 0.4
"""Shortest over middle extent: less is a slab, more may be a block."""
BLOCK_FILL = 0.55
"""Of the box around it, that a block's hull fills."""
BLOCK_M = (0.1, 0.8)
"""Longest extent of what may be called so."""
SEAT = "seat"
SEAT_M, BACK_M, TALLEST_M = (0.36, 0.56), 0.65, 1.3
"""Heights of seats, and of the backs of chairs."""
SEAT_SHARE, BACK_SHARE = 0.25, 0.05
"""Of what is seen from above."""
LEAST_OF_A_BALL = 0.5
"""Shortest over longest side of what may be a ball, of which little more than half is seen."""


def _word(
    xyh_m: np.ndarray,
    heights: HeightMap,
    size_m: tuple[float, float, float],
    fill: float,
    ratio: float,
    cavity: HeightMapCavity | None,
    rough: bool,
) -> str:
    if cavity is not None and ratio > CONTAINER_RATIO:
        return CONTAINER
    long, short, height = size_m
    plateau = float((heights.top_m[heights.footprint] > 0.85 * height).mean())
    if plateau > 0.68 and not rough:
        if fill > 0.88 or long > 1.25 * short:
            if height < 0.35 * short:
                return "flat box"
            return "cube" if max(size_m) < 1.3 * min(size_m) else "box"
        return "cylinder"
    if not rough and min(size_m) > LEAST_OF_A_BALL * long and _is_ball(xyh_m, long):
        return "ball"
    return SEAT if _is_seat(heights) else _bulk(xyh_m)


def _is_seat(heights: HeightMap) -> bool:
    """Whether people may sit: level at the height of a knee, and a back over some of its edge."""
    top = heights.top_m[heights.footprint]
    level = ((top > SEAT_M[0]) & (top < SEAT_M[1])).mean()
    return bool(level > SEAT_SHARE and (top > BACK_M).mean() > BACK_SHARE and top.max() < TALLEST_M)


def _along_principal(p_m: np.ndarray) -> np.ndarray:
    away = p_m - p_m.mean(axis=0)
    return np.asarray(away @ np.linalg.eigh(away.T @ away)[1])


def sides_m(p_m: np.ndarray) -> np.ndarray:
    """Extents along the principal axes without the outermost 2 %, largest first."""
    low, high = np.quantile(_along_principal(p_m), [0.02, 0.98], axis=0)
    return np.asarray(np.sort(high - low)[::-1])


def _bulk(points: np.ndarray) -> str:
    """Of a shape that stands askew, or is half seen: thin, or filling its box, or neither."""
    along = _along_principal(points)
    low, high = np.quantile(along, [0.02, 0.98], axis=0)
    short, middle, long = np.sort(high - low)
    if short < SLAB * middle:
        return "slab"
    hull = _hull_volume(along[((along > low) & (along < high)).all(axis=1)])
    is_block = hull > BLOCK_FILL * short * middle * long and short > BLOCK * middle
    return "block" if is_block and BLOCK_M[0] < long < BLOCK_M[1] else UNKNOWN_SHAPE


def _is_ball(points: np.ndarray, diameter_m: float) -> bool:
    """Fit a sphere by linear least squares (|p|^2 = 2 c.p + k) and look at what is left."""
    p = points - points.mean(axis=0)
    system = np.concatenate([2 * p, np.ones((len(p), 1))], axis=1)
    solution, *_ = np.linalg.lstsq(system, np.square(p).sum(axis=1), rcond=None)
    squared = float(solution[3] + solution[:3] @ solution[:3])
    if squared <= 0:
        return False
    radius = float(np.sqrt(squared))
    left = np.linalg.norm(p - solution[:3], axis=1) - radius
    return bool(np.sqrt(np.mean(left**2)) < 0.08 * radius and 0.7 < 2 * radius / diameter_m < 1.4)


MAX_HANDLE = 0.45
MIN_HANDLE = 0.012
"""Share of the points; less is noise at a rim or a foot."""
MIN_SHARE = 0.005
"""A part has at least this share of the points."""
RIM, FLOOR, HANDLE = 0.1, 0.12, 0.08
"""Rim is what is this near to the rim's height, floor the lowest of the cavity's depth, handle what
stands this much above the rim; shares of the height, or of the depth."""


def find_parts(
    xyh_m: Float[np.ndarray, "num_points 3"], cell_m: float
) -> dict[str, Bool[np.ndarray, " num_points"]]:
    """Rim, floor, walls and handle of what may be a container; a part that is not there is none."""
    low, high = np.quantile(xyh_m, [0.01, 0.99], axis=0)
    heights = height_map(xyh_m, max(cell_m, float((high - low).max()) / 48))
    cavity = find_height_map_cavity(heights)
    if cavity is None:
        return {}
    parts = _container(xyh_m, heights, cavity, float(high[2]))
    least = max(MIN_SHARE * len(xyh_m), 1)
    return {name: mask for name, mask in parts.items() if mask.sum() >= least}


def _container(
    xyh_m: np.ndarray,
    heights: HeightMap,
    cavity: HeightMapCavity,
    top_m: float,
) -> dict[str, np.ndarray]:
    over = ndimage.binary_dilation(cavity.mask)[heights.cells(xyh_m)]
    height, depth = xyh_m[:, 2], cavity.rim_m - cavity.floor_m
    span = RIM * cavity.rim_m
    margin = max(HANDLE * cavity.rim_m, heights.cell_m)
    wall = heights.top_m[heights.footprint & ~cavity.mask]
    handle = _sticking_out(xyh_m, heights, cavity)
    is_rim = (wall > cavity.rim_m + margin).mean() > MAX_HANDLE  # that high, but for a low place
    if not is_rim and top_m > cavity.rim_m + 2 * margin:
        handle |= height > cavity.rim_m + margin
    if handle.sum() < MIN_HANDLE * len(xyh_m):
        handle = np.zeros_like(handle)  # a ragged rim
    thick = max(FLOOR * depth, 0.004)
    floor = ~handle & over & (height < cavity.floor_m + thick)
    rim = ~handle & ~floor & (height > cavity.rim_m - span)
    return {
        "rim": rim,
        "floor": floor,
        "handle": handle,
        "walls": ~(rim | floor | handle),
    }


def _sticking_out(
    xyh_m: np.ndarray, heights: HeightMap, cavity: HeightMapCavity
) -> Bool[np.ndarray, " num_points"]:
    """Points beside the outline that holds the cavity: an ear, the handle of a mug."""
    thickness = ndimage.distance_transform_edt(heights.footprint)
    radius = 0.35 * float(thickness.max())
    core = thickness > radius
    opened = ndimage.distance_transform_edt(~core) <= radius + 1.0
    around = ndimage.distance_transform_edt(~(opened | cavity.mask)) > 2.5
    return np.asarray((around & heights.footprint)[heights.cells(xyh_m)])
