"""Segment a thing into parts by its geometry: rim, wall and handle, or body, head and limbs.

The visible surface is filled to cells; thick places are body and head, what sticks out is a limb.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from twin.scene.semantics.language import kind_of
from twin.scene.semantics.shape_descriptors import (
    HeightMap,
    HeightMapCavity,
    find_height_map_cavity,
    height_map,
)

MAX_CELLS = 72
"""Along the longest side."""
MARGIN_CELLS = 4
GAP_SPACINGS = 0.9
"""Points are balls of this many spacings, so that light cannot pass between them."""
UNSEEN_FRACTION = 0.45
"""Lowest share of the height that cameras from above may not see: it is filled to the plane."""


@dataclass(frozen=True, kw_only=True)
class FilledCells:
    """Filled cells of a grid."""

    cells: Bool[np.ndarray, "num_x num_y num_z"]
    origin_m: Float[np.ndarray, "3"]
    """Lower corner of the first cell."""
    size_m: float

    def cells_of(
        self, p_m: Float[np.ndarray, "num_points 3"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cell of each point; points beyond the grid go to its edge."""
        index = np.floor((p_m - self.origin_m) / self.size_m).astype(np.int64)
        index = np.clip(index, 0, np.array(self.cells.shape) - 1)
        return index[:, 0], index[:, 1], index[:, 2]

    def centres_m(
        self, mask: Bool[np.ndarray, "num_x num_y num_z"]
    ) -> Float[np.ndarray, "num_marked 3"]:
        """Middles of the marked cells."""
        return np.asarray((np.argwhere(mask) + 0.5) * self.size_m + self.origin_m)


def fill_solid(xyh_m: Float[np.ndarray, "num_points 3"]) -> FilledCells:
    """Cells that a surface encloses: hidden from at least five of the six axis directions.

    From below everything is hidden by what the thing stands on, so an underside that nobody saw
    is closed by the plane. A sixth direction may be open: a side that nobody saw.

    Args:
        xyh_m: Points of the surface: x, y and height above the plane.
    """
    low, high = np.quantile(xyh_m, [0.002, 0.998], axis=0)
    radius_m = max(GAP_SPACINGS * _sparse_spacing(xyh_m), 1e-4)
    size_m = max(0.6 * radius_m, float((high - low).max()) / MAX_CELLS)
    radius = max(radius_m / size_m, 1.0)
    origin = np.array([*(low[:2] - MARGIN_CELLS * size_m), -MARGIN_CELLS * size_m])
    shape = np.ceil((high - origin) / size_m).astype(np.int64) + MARGIN_CELLS
    cells = np.floor((xyh_m - origin) / size_m).astype(np.int64)
    inside = np.all((cells >= 0) & (cells < shape), axis=1)
    surface = np.zeros(tuple(shape), dtype=bool)
    surface[tuple(cells[inside].T)] = True
    shell = ndimage.distance_transform_edt(~surface) <= radius
    hit = _hidden(shell).astype(np.float32)
    hit[:, :, :MARGIN_CELLS] = hit[:, :, MARGIN_CELLS : MARGIN_CELLS + 1]
    # Light through a single gap makes a thin shaft: the majority around each cell decides.
    solid = ndimage.gaussian_filter(hit, 1.0) > 0.5
    _stand_on_plane(solid, int(UNSEEN_FRACTION * (high[2] - origin[2]) / size_m))
    solid = ndimage.gaussian_filter(solid.astype(np.float32), 1.0) > 0.5
    # The shell was thickened outwards too, but not into the plane.
    solid[:, :, :MARGIN_CELLS] = solid[:, :, MARGIN_CELLS : MARGIN_CELLS + 1]
    solid = ndimage.distance_transform_edt(solid) > radius
    solid[:, :, :MARGIN_CELLS] = False
    return FilledCells(cells=np.asarray(solid), origin_m=origin, size_m=size_m)


def _hidden(shell: Bool[np.ndarray, "num_x num_y num_z"]) -> Bool[np.ndarray, "num_x num_y num_z"]:
    """Cells that at most one direction sees; the plane hides everything from below."""
    count = np.ones(shell.shape, dtype=np.int64)
    for axis, forward in ((0, True), (0, False), (1, True), (1, False), (2, False)):
        walls = shell if forward else np.flip(shell, axis)
        behind = np.logical_or.accumulate(walls, axis=axis)
        count += behind if forward else np.flip(behind, axis)
    return np.asarray((count >= 5) | shell)


def _sparse_spacing(p_m: Float[np.ndarray, "num_points 3"]) -> float:
    """Distance to the next point where points are sparse."""
    if len(p_m) < 3:
        return 0.0
    distance, _ = cKDTree(p_m).query(p_m[:: max(1, len(p_m) // 3000)], k=2)
    return float(np.quantile(distance[:, 1], 0.9))


def _stand_on_plane(solid: Bool[np.ndarray, "num_x num_y num_z"], num_unseen: int) -> None:
    """Fill columns whose lowest cell is near the plane down to it."""
    lowest = np.where(solid.any(axis=2), solid.argmax(axis=2), solid.shape[2])
    levels = np.arange(solid.shape[2])
    near = lowest <= MARGIN_CELLS + num_unseen
    solid |= near[..., None] & (levels < lowest[..., None])


CONNECTED = np.ones((3, 3, 3), dtype=bool)
BODY, HEAD, PROTRUSION = 1, 2, 3
LEVELS = tuple(np.arange(0.97, 0.5, -0.03))
"""Thickness, as a share of the largest, at which thick places are told apart."""
MIN_PROMINENCE = 1.06
"""A thick place counts when it is this much thicker than the neck to the next."""
LOW_FRACTION = 0.35
"""Of the whole height: what sticks out of a head below that is an arm before it."""
MAX_ATTACHED = 0.04
"""Share of the whole that may stick out of a head: nose and ears, not a pair of legs."""
MIN_CORE = 0.3
"""Thickness of a thick place, as a share of the largest."""
CUTS = (0.0, 0.3, 0.45, 0.6)
"""Heights above which thick places are looked for, as shares of the whole."""
UNDER = 0.5
"""A thick place nearer to the head's middle than this share of its radius is its neck."""
MIN_PIECE = 0.008
"""What sticks out has at least this share of the solid's cells."""


@dataclass(frozen=True, kw_only=True)
class Core:
    """A thick place: cells thicker than a level, alone up to its neck to the next."""

    region: Bool[np.ndarray, "num_x num_y num_z"]
    level: float
    """In cells."""


def animal_parts(
    xyh_m: Float[np.ndarray, "num_points 3"], protrusion_ratio: float
) -> tuple[dict[str, Bool[np.ndarray, " num_points"]], dict[str, Float[np.ndarray, "3"]]]:
    """Tell body, head and limbs apart by thickness.

    The visible surface is filled to a solid that stands on the plane. Opening it with a ball
    takes off whatever is thinner than the ball: pieces that come off stick out. Thick places are
    told apart where a neck separates them. Of those beside the largest, the head is the highest
    with the least attached to it (nose and ears go with it); a body of two thick places keeps
    both. With one thick place only, the head is the thickest and highest piece that sticks out.

    Args:
        xyh_m: Points of the surface: x, y and height above the plane.
        protrusion_ratio: Radius of the ball over the radius of the thickest place.

    Returns:
        Masks of the parts that are there, and keypoints: the middle of body and head, the tip
        of each limb.
    """
    solid = fill_solid(xyh_m)
    parts, protrusions = _label_cells(solid.cells, thickness_of(solid.cells), protrusion_ratio)
    nearest = ndimage.distance_transform_edt(
        parts == 0, return_distances=False, return_indices=True
    )
    of_point = parts[tuple(nearest)][solid.cells_of(xyh_m)]
    masks = {
        name: of_point == part
        for name, part in (("body", BODY), ("head", HEAD), ("limbs", PROTRUSION))
        if (of_point == part).any()
    }
    return masks, _keypoints(parts, protrusions, solid)


def _label_cells(
    solid: Bool[np.ndarray, "num_x num_y num_z"],
    thickness: Float[np.ndarray, "num_x num_y num_z"],
    protrusion_ratio: float,
) -> tuple[Int[np.ndarray, "num_x num_y num_z"], list[np.ndarray]]:
    """Part of each solid cell, and the cells of each limb."""
    smooth = _smooth(thickness)
    most = float(smooth.max())
    ball = protrusion_ratio * most
    thick = solid & (ndimage.distance_transform_edt(smooth <= ball) <= ball + 0.7)
    pieces = _pieces(solid & ~thick, int(solid.sum()))
    parts = np.where(solid, BODY, 0)
    owner, touches, head = _find_head(solid, thick, pieces, most)
    if head >= 0:
        parts[owner == head + 1] = HEAD
    elif pieces:
        head_piece = max(range(len(pieces)), key=lambda k: _headness(pieces[k], thickness))
        parts[pieces[head_piece]] = HEAD
        pieces = [piece for k, piece in enumerate(pieces) if k != head_piece]
        touches = [0] * len(pieces)
    protrusions: list[np.ndarray] = []
    low = MARGIN_CELLS + LOW_FRACTION * (
        int(np.flatnonzero(solid.any(axis=(0, 1))).max()) - MARGIN_CELLS
    )
    for piece, touched in zip(pieces, touches, strict=True):
        if touched == head and float(np.nonzero(piece)[2].mean()) > low:
            parts[piece] = HEAD
        else:
            parts[piece] = PROTRUSION
            protrusions.append(piece)
    return parts, protrusions


def thickness_of(
    solid: Bool[np.ndarray, "num_x num_y num_z"], level: int = MARGIN_CELLS
) -> Float[np.ndarray, "num_x num_y num_z"]:
    """Distance to the outside, in cells; the plane (or a higher level) is a mirror.

    Otherwise a body that rests on the plane would have thin edges all around its foot. Below the
    level it is zero.

    Args:
        solid: True inside the body; z points up from the plane.
        level: Layer along z at which the mirror lies.
    """
    above = solid[:, :, level:]
    mirrored = np.concatenate([np.flip(above, axis=2), above], axis=2)
    distance = np.zeros(solid.shape)
    distance[:, :, level:] = ndimage.distance_transform_edt(mirrored)[:, :, above.shape[2] :]
    return distance


def _smooth(thickness: np.ndarray) -> np.ndarray:
    """Distances on a grid come in steps; as they are every step would be a thick place."""
    return np.asarray(ndimage.gaussian_filter(thickness, 0.8) * (thickness > 0))


def _find_head(
    solid: np.ndarray, thick: np.ndarray, pieces: list[np.ndarray], most: float
) -> tuple[np.ndarray, list[int], int]:
    """Owner of each thick cell, the core each piece touches, and which core is the head (or -1).

    Near the plane a chin and two arms fill the gap that is a clear neck from above. So where the
    best head has much attached to it, thick places are looked for again above some height; if
    there are more of them, the highest is the head. If there are not, chest and head look like one
    at every height, and what is thickest at the top is the head, see ``_highest_ball``.
    """
    found: list[tuple[np.ndarray, list[int], int]] = []
    num_cores = 0
    top = int(np.flatnonzero(solid.any(axis=(0, 1))).max())
    for fraction in CUTS:
        smooth = _smooth(thickness_of(solid, MARGIN_CELLS + int(fraction * (top - MARGIN_CELLS))))
        cores = [
            core
            for core in find_cores(smooth)
            if float(smooth[core.region].max()) > MIN_CORE * most
        ]
        if not cores:  # above what is thick only a tail or an antenna is left
            break
        # For each thick cell the core whose ball reaches it best, from 1; 0 elsewhere.
        gaps = [ndimage.distance_transform_edt(~core.region) - core.level for core in cores]
        owner = np.where(thick, np.argmin(gaps, axis=0) + 1, 0)
        touches = [_touched(piece, owner, len(cores)) for piece in pieces]
        if len(cores) < 2 and not found:
            return owner, touches, -1
        if found and len(cores) > num_cores:
            heights = [int(np.nonzero(core.region)[2].max()) for core in cores]
            return owner, touches, int(np.argmax(heights))
        if not found:
            num_cores, head = len(cores), _head_core(cores, owner, pieces, touches)
            found.append((owner, touches, head))
            attached = [piece.sum() for piece, k in zip(pieces, touches, strict=True) if k == head]
            if sum(attached) < MAX_ATTACHED * solid.sum():
                return found[0]
    by_ball = _highest_ball(solid, thick, top)
    if by_ball is None:
        return found[0]
    num_balls = int(by_ball.max())
    return by_ball, [_touched(piece, by_ball, num_balls) for piece in pieces], num_balls - 1


def _highest_ball(
    solid: np.ndarray, thick: np.ndarray, top: int
) -> Int[np.ndarray, "num_x num_y num_z"] | None:
    """Owner of each thick cell among balls, of which the last is the head; None without a body.

    The head's ball is the thickest place of the top; those of the body are the thick places from
    further down that are not under it. A cell belongs to the ball in which it has the most power
    (Aurenhammer 1987): the border between two balls that cut each other is where they do.
    """
    balls = []
    for fraction in (CUTS[-1], CUTS[1]):
        smooth = _smooth(thickness_of(solid, MARGIN_CELLS + int(fraction * (top - MARGIN_CELLS))))
        inside = [np.where(core.region, smooth, 0.0) for core in find_cores(smooth)]
        peaks = [np.unravel_index(int(values.argmax()), smooth.shape) for values in inside]
        balls.append([(np.array(peak, dtype=np.float64), float(smooth[peak])) for peak in peaks])
    if not balls[0]:
        return None
    middle, radius = head = balls[0][0]
    body = [ball for ball in balls[1] if np.hypot(*(ball[0] - middle)[:2]) > UNDER * radius]
    if not body:
        return None
    cells = np.argwhere(thick)
    power = [np.square(cells - p).sum(axis=1) - r**2 for p, r in (*body, head)]
    owner = np.zeros(solid.shape, dtype=np.int64)
    owner[tuple(cells.T)] = np.argmin(power, axis=0) + 1
    return owner


def find_cores(thickness: Float[np.ndarray, "num_x num_y num_z"]) -> list[Core]:
    """Thick places that necks separate, thickest first.

    Thresholds come down from the thickest place; components appear, grow and meet. Where two
    meet, the one that is hardly thicker than the neck was only a bump on the other.
    """
    most = float(thickness.max())
    growing: list[tuple[tuple[int, ...], Core]] = []
    done: list[Core] = []
    for level in LEVELS:
        cells, num = ndimage.label(thickness > level * most, structure=CONNECTED)
        unmet: list[tuple[tuple[int, ...], Core]] = []
        taken = {int(cells[core.region].flat[0]) for core in done}
        for number in range(1, num + 1):
            region = cells == number
            own = [item for item in growing if cells[item[0]] == number]
            firm = [item for item in own if thickness[item[0]] > MIN_PROMINENCE * level * most]
            if number in taken or len(firm) > 1:  # met a finished one earlier, or now
                done += [core for _, core in firm]
            else:
                inside = np.where(region, thickness, 0.0)
                peak = np.unravel_index(int(inside.argmax()), thickness.shape)
                grown = Core(region=region, level=level * most)
                unmet.append((tuple(int(k) for k in peak), grown))
        growing = unmet
    cores = done + [core for peak, core in growing if thickness[peak] > 0.6 * most]
    return sorted(cores, key=lambda core: -float(thickness[core.region].max()))


def _pieces(rest: np.ndarray, num_solid: int) -> list[np.ndarray]:
    """Connected cells that are more than a bump."""
    cells, num = ndimage.label(rest)
    counts = np.bincount(cells.ravel(), minlength=num + 1)
    least = max(8, MIN_PIECE * num_solid)
    return [cells == piece for piece in range(1, num + 1) if counts[piece] >= least]


def _touched(piece: np.ndarray, owner: np.ndarray, num_cores: int) -> int:
    """The core that most cells around a piece belong to."""
    around = owner[ndimage.binary_dilation(piece, structure=CONNECTED) & (owner > 0)]
    return int(np.bincount(around, minlength=num_cores + 1)[1:].argmax())


def _head_core(
    cores: list[Core], owner: np.ndarray, pieces: list[np.ndarray], touches: list[int]
) -> int:
    """High up and little attached; never the largest."""
    sizes = np.bincount(owner.ravel(), minlength=len(cores) + 1)[1:]
    total = float(sizes.sum())
    best, best_score = 0, -np.inf
    for core in range(len(cores)):
        cells = np.argwhere(owner == core + 1)
        if core == int(sizes.argmax()) or not len(cells):
            continue
        attached = sum(
            int(piece.sum()) for piece, k in zip(pieces, touches, strict=True) if k == core
        )
        score = float(cells[:, 2].mean()) / owner.shape[2] - 5.0 * attached / total
        if score > best_score:
            best, best_score = core, score
    return best


def _headness(piece: np.ndarray, thickness: np.ndarray) -> float:
    """Thick and high."""
    levels = np.nonzero(piece)[2]
    height = float(levels.mean()) / piece.shape[2]
    return float(thickness[piece].max() * (1.0 + 0.5 * height))


def _keypoints(
    parts: Int[np.ndarray, "num_x num_y num_z"], protrusions: list[np.ndarray], solid: FilledCells
) -> dict[str, Float[np.ndarray, "3"]]:
    points = {"body": solid.centres_m(parts == BODY).mean(axis=0)}
    if (parts == HEAD).any():
        points["head"] = solid.centres_m(parts == HEAD).mean(axis=0)
    tips = []
    for protrusion in protrusions:
        cells = solid.centres_m(protrusion)
        away = np.linalg.norm(cells - points["body"], axis=1)
        tips.append(cells[away >= np.quantile(away, 0.9)].mean(axis=0))
    x, y = points["body"][:2]
    around = sorted(tips, key=lambda tip: float(np.arctan2(tip[1] - y, tip[0] - x)))
    return points | {f"limb {number}": tip for number, tip in enumerate(around, start=1)}


MAX_HANDLE = 0.45
"""Share of the cells around a cavity; more is no handle but the rim itself."""
MIN_HANDLE = 0.012
"""Share of the points; less is noise at a rim or a foot."""
MIN_SHARE = 0.005
"""A part has at least this share of the points."""


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Named subsets of points, and named places."""

    masks: Mapping[str, Bool[np.ndarray, " num_points"]]
    """Disjoint."""
    keypoints: Mapping[str, Float[np.ndarray, "3"]]
    """x, y and height above the plane, like the points."""


@dataclass(frozen=True, kw_only=True)
class PartsConfig:
    """How parts are told apart."""

    rim_fraction: float = 0.1
    """Points within this share of the height of the rim's height are rim."""
    floor_fraction: float = 0.12
    """Points in the lowest share of the cavity's depth are its floor."""
    handle_fraction: float = 0.08
    """Points this share of the height above the rim are handle."""
    protrusion_ratio: float = 0.55
    """What is thinner than this share of the thickest place sticks out of the body."""


def find_parts(
    xyh_m: Float[np.ndarray, "num_points 3"],
    label: str,
    cell_m: float,
    config: PartsConfig,
) -> Parts:
    """Parts and keypoints of one thing.

    Containers get rim, floor, walls and handle; animals and toys body, head and limbs; every
    thing the keypoints centre, top and bottom. A part that is not there is not named.

    Args:
        xyh_m: Its points: x, y and height above what it stands on.
        label: What it is called; decides what parts to look for.
        cell_m: Spacing of the points.
        config: How parts are told apart.
    """
    low, high = np.quantile(xyh_m, [0.01, 0.99], axis=0)
    middle = (low + high) / 2
    keypoints = {
        "centre": middle,
        "top": np.array([middle[0], middle[1], high[2]]),
        "bottom": np.array([middle[0], middle[1], max(low[2], 0.0) if low[2] > cell_m else 0.0]),
    }
    kind = kind_of(label)
    masks: dict[str, np.ndarray] = {}
    if kind == "container":
        heights = height_map(xyh_m, max(cell_m, float((high - low).max()) / 48))
        cavity = find_height_map_cavity(heights)
        if cavity is not None:
            masks = _container(xyh_m, heights, cavity, float(high[2]), config)
            keypoints |= _container_points(xyh_m, heights, cavity, masks)
    elif kind == "animal":
        masks, places = animal_parts(xyh_m, config.protrusion_ratio)
        keypoints |= places
    least = MIN_SHARE * len(xyh_m)
    return Parts(
        masks={name: mask for name, mask in masks.items() if mask.sum() >= max(least, 1)},
        keypoints=keypoints,
    )


def _container(
    xyh_m: np.ndarray,
    heights: HeightMap,
    cavity: HeightMapCavity,
    top_m: float,
    config: PartsConfig,
) -> dict[str, np.ndarray]:
    over = ndimage.binary_dilation(cavity.mask)[heights.cells(xyh_m)]
    height, depth = xyh_m[:, 2], cavity.rim_m - cavity.floor_m
    span = config.rim_fraction * cavity.rim_m
    margin = max(config.handle_fraction * cavity.rim_m, heights.cell_m)
    wall = heights.top_m[heights.footprint & ~cavity.mask]
    if (wall > cavity.rim_m + margin).mean() > MAX_HANDLE:
        handle = np.zeros(len(xyh_m), dtype=bool)  # the rim is that high, but for a low place
    else:
        handle = (height > cavity.rim_m + margin) & (top_m > cavity.rim_m + 2 * margin)
    handle |= _sticking_out(xyh_m, heights, cavity)
    if handle.sum() < MIN_HANDLE * len(xyh_m):
        handle = np.zeros_like(handle)  # a ragged rim
    thick = max(config.floor_fraction * depth, 0.004)
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


def _container_points(
    xyh_m: np.ndarray, heights: HeightMap, cavity: HeightMapCavity, masks: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    centre = heights.centre_m(cavity.mask)
    points = {
        "opening": np.array([*centre, cavity.rim_m]),
        "cavity": np.array([*centre, (cavity.rim_m + cavity.floor_m) / 2]),
        "floor": np.array([*centre, cavity.floor_m]),
    }
    handle = xyh_m[masks["handle"]]
    if len(handle) >= MIN_SHARE * len(xyh_m):
        points["handle"] = handle[handle[:, 2] >= np.quantile(handle[:, 2], 0.8)].mean(axis=0)
    rim = xyh_m[masks["rim"]]
    for name, axis, sign in (("+x", 0, 1), ("-x", 0, -1), ("+y", 1, 1), ("-y", 1, -1)):
        if len(rim):
            along = sign * rim[:, axis]
            points[f"rim {name}"] = rim[along >= np.quantile(along, 0.95)].mean(axis=0)
    return points
