"""A few convex parts in place of a shape, for engines that know convex parts only.

Convexity is tested first. Otherwise the voxels are cut by planes, the worst part first, until the
hulls hold little more than the solid: a container falls apart into floor and walls. Points known
to be free in its cavity must end up outside of all parts. The grid of signed distances stays
the exact answer; the parts are for the physics engine.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from bridge.errors import refuse_outside
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.mesh import Faces
from twin.scene.shape.reconstruct import ObjectShape

_CUBE = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
NUM_DIRECTIONS = 160


@dataclass(frozen=True, kw_only=True)
class ConvexPart:
    """One convex solid."""

    vertices_m: Float[np.ndarray, "num_vertices 3"]
    faces: Faces
    """Counter-clockwise seen from outside."""
    planes: Float[np.ndarray, "num_planes 4"]
    """(unit normal, offset): inside where normal . p + offset <= 0."""
    volume_m3: float

    def contains(
        self, points_m: Float[np.ndarray, "num_points 3"], margin_m: float = 0.0
    ) -> Bool[np.ndarray, " num_points"]:
        """Say which points lie inside, or within a margin of every plane.

        Args:
            points_m: In the frame of the part.
            margin_m: How far outside a plane still counts as inside.
        """
        height = points_m @ self.planes[:, :3].T + self.planes[:, 3]
        return np.asarray((height <= margin_m).all(axis=1))


def hull_of_points(points_m: Float[np.ndarray, "num_points 3"]) -> ConvexPart:
    """Smallest convex solid that holds the points.

    Raises:
        ShapeError: When the points lie in a plane.
    """
    try:
        hull = ConvexHull(points_m)
    except (QhullError, ValueError) as error:
        message = f"{len(points_m)} points span no volume, so they have no convex hull."
        raise ShapeError(message) from error
    used = hull.vertices
    number = np.full(len(points_m), -1, dtype=np.int64)
    number[used] = np.arange(len(used))
    faces = hull.simplices.astype(np.int64)
    a, b, c = (points_m[faces[:, k]] for k in range(3))
    inwards = np.einsum("ni,ni->n", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return ConvexPart(
        vertices_m=np.asarray(points_m[used], dtype=np.float64),
        faces=number[faces],
        planes=np.unique(hull.equations.round(12), axis=0),
        volume_m3=float(hull.volume),
    )


def thinned(points_m: Float[np.ndarray, "num_points 3"]) -> Float[np.ndarray, "num_kept 3"]:
    """The points that reach farthest in evenly spread directions: a hull of few vertices.

    Directions on a Fibonacci sphere; the axes are among them, so a box keeps its extents.
    """
    turn = np.arange(NUM_DIRECTIONS) * np.pi * (3.0 - np.sqrt(5.0))
    z = 1.0 - (2.0 * np.arange(NUM_DIRECTIONS) + 1.0) / NUM_DIRECTIONS
    r = np.sqrt(1.0 - z * z)
    directions = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    directions = np.concatenate([directions, np.eye(3), -np.eye(3), 2.0 * _CUBE - 1.0])
    return np.asarray(points_m[np.unique((points_m @ directions.T).argmax(axis=0))])


def voxel_corners(voxels: Int[np.ndarray, "num_voxels 3"]) -> Int[np.ndarray, "num_corners 3"]:
    """Corners that can be vertices of the hull of voxels; voxel i covers [i, i + 1].

    A voxel between two others of its row is never extreme, so only the ends of rows are kept,
    along one axis after the other.
    """
    ends = voxels
    for axis in (2, 1, 0):
        ends = ends[_row_ends(ends, axis)]
    corners = (ends[:, None, :] + _CUBE).reshape(-1, 3)
    return np.asarray(np.unique(corners, axis=0))


def _row_ends(voxels: np.ndarray, axis: int) -> np.ndarray:
    others = [voxels[:, a] for a in range(3) if a != axis]
    order = np.lexsort((voxels[:, axis], *others))
    changed = np.zeros(len(voxels) + 1, dtype=bool)
    changed[[0, -1]] = True
    for rows in others:
        along = rows[order]
        changed[1:-1] |= along[1:] != along[:-1]
    keep = changed[:-1] | changed[1:]
    return np.asarray(order[keep])


JUMPS = 3
"""Candidate cuts along an axis: where the cross-section changes most, and the middle."""
TURNS_RAD = (np.pi / 8, np.pi / 4, 3 * np.pi / 8, 5 * np.pi / 8, 3 * np.pi / 4, 7 * np.pi / 8)
"""Vertical cuts that do not follow the axes."""
CRUMB = 0.003
MOST_CRUMBS = 0.02
"""Pieces below this share of the shape's voxels are roughness and left out, as long as all of them
together stay below the second share."""
TIE = 0.05
"""Cuts that save this share of a part's hull more or less save alike."""
MIN_EXCESS = 0.04
"""A part that holds less than this share of the shape's volume too much is not cut further."""
MIN_GAIN, MUCH_EXCESS = 0.01, 0.2
"""A cut must save this share of the shape's volume, unless the part holds much too much: the
first cut through a ring saves nothing."""

Voxels = Int[np.ndarray, "num_voxels 3"]


@dataclass(frozen=True, kw_only=True)
class CollisionConfig:
    """How far the parts may deviate."""

    convex_ratio: float = 1.15
    """A shape whose hull holds at most this many times its volume is one hull."""
    enough_ratio: float = 1.06
    """Cutting ends when all hulls together hold at most this many times the volume."""
    max_parts: int = 16
    """More parts make the physics engine slow."""

    def __post_init__(self) -> None:
        """Refuse what cannot be met."""
        allowed = {"convex_ratio": (1.0, 10.0), "enough_ratio": (1.0, 10.0), "max_parts": (1, 64)}
        refuse_outside(self, allowed)


@dataclass(frozen=True, kw_only=True)
class CollisionParts:
    """Convex parts and how well they stand for the shape."""

    parts: tuple[ConvexPart, ...]
    hull_ratio: float
    """Volume of the convex hull of everything over the shape's volume; 1 is convex."""
    volume_ratio: float
    """Volume of all parts over the shape's volume."""
    cavity_blocked: float | None
    """Share of the cavity's sample points that lie in a part; None without a cavity."""


def collision_parts(shape: ObjectShape, config: CollisionConfig | None = None) -> CollisionParts:
    """Convex parts of a shape, in its frame.

    Args:
        shape: From ``reconstruct``.
        config: Settings; the defaults when None.

    Raises:
        ShapeError: When the shape has no volume.
    """
    config = CollisionConfig() if config is None else config
    if shape.volume_m3 <= 0:
        message = f"a shape of {shape.volume_m3 * 1e6:.3g} cm3 has no collision parts."
        raise ShapeError(message)
    whole = hull_of_points(thinned(shape.vertices_m))
    ratio = whole.volume_m3 / shape.volume_m3
    if shape.cavity is None and ratio <= config.convex_ratio:
        parts: tuple[ConvexPart, ...] = (whole,)
    else:
        parts = _cut_up(shape, config)
    return CollisionParts(
        parts=parts,
        hull_ratio=ratio,
        volume_ratio=sum(part.volume_m3 for part in parts) / shape.volume_m3,
        cavity_blocked=_blocked(parts, shape),
    )


def _blocked(parts: tuple[ConvexPart, ...], shape: ObjectShape) -> float | None:
    if shape.cavity is None or len(shape.cavity.points_m) == 0:
        return None
    held = np.logical_or.reduce([part.contains(shape.cavity.points_m) for part in parts])
    return float(held.mean())


@dataclass(frozen=True)
class _Piece:
    """Voxels that one hull stands for; lengths in voxels."""

    voxels: Voxels
    hull: ConvexPart
    blocked: int
    """Sample points of the cavity inside the hull."""

    @property
    def excess(self) -> float:
        """Volume the hull holds beyond its voxels."""
        return self.hull.volume_m3 - len(self.voxels)


def _cut_up(shape: ObjectShape, config: CollisionConfig) -> tuple[ConvexPart, ...]:
    grid = shape.sdf
    corner = grid.origin_m - grid.voxel_m / 2
    free = np.zeros((0, 3)) if shape.cavity is None else shape.cavity.points_m
    free = (free - corner) / grid.voxel_m
    voxels = np.argwhere(grid.values_m < 0)
    pieces = [_piece(voxels, free)]
    kept = (1 - MOST_CRUMBS) * len(voxels)
    while len(pieces) < config.max_parts:
        held = sum(piece.hull.volume_m3 for piece in pieces)
        if held <= config.enough_ratio * len(voxels) and not any(p.blocked for p in pieces):
            break
        # A hull that closes the cavity weighs more than any excess elsewhere.
        order = sorted(pieces, key=lambda p: (-p.blocked, -p.excess))
        for worst in order:
            if worst.blocked == 0 and worst.excess < MIN_EXCESS * len(voxels):
                continue
            others = [p for p in pieces if p is not worst]
            spare = sum(len(p.voxels) for p in pieces) - kept
            parts_left = config.max_parts - len(others)
            cut = _best_cut(worst, free, parts_left, min(CRUMB * len(voxels), spare))
            if cut is not None and _worth_it(worst, cut, len(voxels)):
                pieces = others + cut
                break
        else:
            break
    return tuple(hull_of_points(corner + grid.voxel_m * piece.hull.vertices_m) for piece in pieces)


def _worth_it(piece: _Piece, cut: list[_Piece], num_voxels: int) -> bool:
    saved = piece.hull.volume_m3 - sum(half.hull.volume_m3 for half in cut)
    return (
        piece.blocked > 0
        or piece.excess > MUCH_EXCESS * num_voxels
        or saved > MIN_GAIN * num_voxels
    )


def _piece(voxels: Voxels, free: Float[np.ndarray, "num_free 3"]) -> _Piece:
    hull = hull_of_points(voxel_corners(voxels).astype(np.float64))
    return _Piece(voxels, hull, int(hull.contains(free).sum()))


def _best_cut(
    piece: _Piece, free: Float[np.ndarray, "num_free 3"], max_pieces: int, spare: float
) -> list[_Piece] | None:
    """Of all candidate planes, the one whose halves' hulls hold least; None without one.

    Of cuts that save alike, that where the cross-section jumps most, then the evenest: floor and
    walls of a box come apart where they meet although the first cut saves nothing. At most
    ``spare`` voxels of crumbs may be left out.
    """
    best: tuple[int, float, float] | None = None
    chosen: list[_Piece] | None = None
    for jump, side in _candidate_cuts(piece.voxels):
        groups = [*_connected(piece.voxels[side], spare), *_connected(piece.voxels[~side], spare)]
        left = len(piece.voxels) - sum(len(group) for group in groups)
        if not 1 <= len(groups) <= max_pieces or left > max(spare, 0.0):
            continue
        halves = [_piece(group, free) for group in groups]
        volume = sum(half.hull.volume_m3 for half in halves)
        uneven = max(len(half.voxels) for half in halves) / len(piece.voxels)
        score = (round(volume / piece.hull.volume_m3 / TIE), -jump, uneven)
        if best is None or score < best:
            best, chosen = score, halves
    return chosen


def _candidate_cuts(voxels: Voxels) -> list[tuple[float, np.ndarray]]:
    """Planes as the jump of the cross-section there and the side of each voxel."""
    cuts: list[tuple[float, np.ndarray]] = []
    for axis in range(3):
        along = voxels[:, axis]
        first = int(along.min())
        profile = np.bincount(along - first)
        if len(profile) < 2:
            continue
        change = np.abs(np.diff(profile))
        places = {*np.argsort(-change, kind="stable")[:JUMPS].tolist(), (len(profile) - 2) // 2}
        cuts += [(float(change[place]), along <= first + place) for place in sorted(places)]
    for turn in TURNS_RAD:
        across = voxels[:, :2] @ np.array([np.cos(turn), np.sin(turn)])
        middle = (across.min() + across.max()) / 2
        cuts.append((0.0, across <= middle))
    return [(jump, side) for jump, side in cuts if side.any() and not side.all()]


def _connected(voxels: np.ndarray, least: float) -> list[np.ndarray]:
    """Pieces that hang together by faces, edges or corners; crumbs are left out."""
    low = voxels.min(axis=0)
    grid = np.zeros(voxels.max(axis=0) - low + 1, dtype=bool)
    grid[tuple((voxels - low).T)] = True
    labels, count = ndimage.label(grid, structure=np.ones((3, 3, 3), dtype=np.int64))
    label = labels[tuple((voxels - low).T)]
    sizes = np.bincount(label, minlength=count + 1)
    return [voxels[label == n] for n in range(1, count + 1) if sizes[n] >= least]
