"""Body, head and limbs of an animal or toy: what is thick, and what sticks out of it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from twin.scene.semantics.solid import MARGIN_CELLS, Solid, fill_solid

CONNECTED = np.ones((3, 3, 3), dtype=bool)
BODY, HEAD, LIMB = 1, 2, 3
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
    xyh_m: Float[np.ndarray, "num_points 3"], limb_ratio: float
) -> tuple[dict[str, Bool[np.ndarray, " num_points"]], dict[str, Float[np.ndarray, "3"]]]:
    """Tell body, head and limbs apart by thickness.

    The visible surface is filled to a solid that stands on the plane. Opening it with a ball
    takes off whatever is thinner than the ball: pieces that come off stick out. Thick places are
    told apart where a neck separates them. Of those beside the largest, the head is the highest
    with the least attached to it (nose and ears go with it); a body of two thick places keeps
    both. With one thick place only, the head is the thickest and highest piece that sticks out.

    Args:
        xyh_m: Points of the surface: x, y and height above the plane.
        limb_ratio: Radius of the ball over the radius of the thickest place.

    Returns:
        Masks of the parts that are there, and keypoints: the middle of body and head, the tip
        of each limb.
    """
    solid = fill_solid(xyh_m)
    parts, limbs = _label_cells(solid.cells, thickness_of(solid.cells), limb_ratio)
    nearest = ndimage.distance_transform_edt(
        parts == 0, return_distances=False, return_indices=True
    )
    of_point = parts[tuple(nearest)][solid.cells_of(xyh_m)]
    masks = {
        name: of_point == part
        for name, part in (("body", BODY), ("head", HEAD), ("limbs", LIMB))
        if (of_point == part).any()
    }
    return masks, _keypoints(parts, limbs, solid)


def _label_cells(
    solid: Bool[np.ndarray, "num_x num_y num_z"],
    thickness: Float[np.ndarray, "num_x num_y num_z"],
    limb_ratio: float,
) -> tuple[Int[np.ndarray, "num_x num_y num_z"], list[np.ndarray]]:
    """Part of each solid cell, and the cells of each limb."""
    smooth = _smooth(thickness)
    most = float(smooth.max())
    ball = limb_ratio * most
    thick = solid & _grown(smooth > ball, ball)
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
    limbs: list[np.ndarray] = []
    low = MARGIN_CELLS + LOW_FRACTION * (
        int(np.flatnonzero(solid.any(axis=(0, 1))).max()) - MARGIN_CELLS
    )
    for piece, touched in zip(pieces, touches, strict=True):
        if touched == head and float(np.nonzero(piece)[2].mean()) > low:
            parts[piece] = HEAD
        else:
            parts[piece] = LIMB
            limbs.append(piece)
    return parts, limbs


def thickness_of(
    solid: Bool[np.ndarray, "num_x num_y num_z"], level: int = MARGIN_CELLS
) -> Float[np.ndarray, "num_x num_y num_z"]:
    """Distance to the outside, in cells; the plane (or a higher level) is a mirror.

    Otherwise a body that rests on the plane would have thin edges all around its foot. Below the
    level it is zero.
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
        owner = _nearest_core(cores, thick)
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


def _grown(core: np.ndarray, radius: float) -> np.ndarray:
    return np.asarray(ndimage.distance_transform_edt(~core) <= radius + 0.7)


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
        still: list[tuple[tuple[int, ...], Core]] = []
        taken = {int(cells[_inside(core)]) for core in done}
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
                still.append((tuple(int(k) for k in peak), grown))
        growing = still
    cores = done + [core for peak, core in growing if thickness[peak] > 0.6 * most]
    return sorted(cores, key=lambda core: -float(thickness[core.region].max()))


def _inside(core: Core) -> tuple[int, ...]:
    return tuple(int(k) for k in np.argwhere(core.region)[0])


def _nearest_core(cores: list[Core], thick: np.ndarray) -> Int[np.ndarray, "num_x num_y num_z"]:
    """For each thick cell the core whose ball reaches it best, from 1; 0 elsewhere."""
    gaps = [ndimage.distance_transform_edt(~core.region) - core.level for core in cores]
    return np.where(thick, np.argmin(gaps, axis=0) + 1, 0)


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
    parts: Int[np.ndarray, "num_x num_y num_z"], limbs: list[np.ndarray], solid: Solid
) -> dict[str, Float[np.ndarray, "3"]]:
    points = {"body": solid.centres_m(parts == BODY).mean(axis=0)}
    if (parts == HEAD).any():
        points["head"] = solid.centres_m(parts == HEAD).mean(axis=0)
    tips = []
    for limb in limbs:
        cells = solid.centres_m(limb)
        away = np.linalg.norm(cells - points["body"], axis=1)
        tips.append(cells[away >= np.quantile(away, 0.9)].mean(axis=0))
    around = sorted(tips, key=lambda tip: _bearing(tip - points["body"]))
    return points | {f"limb {number}": tip for number, tip in enumerate(around, start=1)}


def _bearing(away: np.ndarray) -> float:
    return float(np.arctan2(away[1], away[0]))
