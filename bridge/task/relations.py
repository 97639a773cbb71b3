"""How objects stand to each other: the hard geometry behind the predicates about two or more.

Bodies are the boxes of their outer extents. Heights are along z of the base frame, against gravity;
"seen from above" is the projection along it. Nothing else of the base frame matters, except where a
direction is named: x points forwards, away from the robot's base, y to its left.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.check import TABLE

SIDES: dict[str, tuple[float, float, float]] = {
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "in_front": (-1.0, 0.0, 0.0),
    "behind": (1.0, 0.0, 0.0),
}
"""Sides of something as the robot sees it: what is in front of it is nearer to the robot."""
WAYS: dict[str, tuple[float, float, float]] = {
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "forwards": (1.0, 0.0, 0.0),
    "backwards": (-1.0, 0.0, 0.0),
}
"""Which way something moves, as the robot sees it: forwards is away from its base."""
ON_TOLERANCE_M = 0.008
"""Of a resting object's underside from the top below it, where a task says nothing else [m]."""
BESIDE_GAP_M = (0.0, 0.1)
"""Least and greatest gap between two objects beside each other, where a task says nothing else."""
SECTOR_RAD = np.pi / 4
"""How far from a direction something may lie and still be on that side; four sides fill a turn."""
BETWEEN_TOLERANCE_M = 0.03
"""Of an object's middle from the line between two others, where a task says nothing else [m]."""
TILT_TOLERANCE_RAD = 0.17
"""Of ``upright`` and ``aligned`` where a task says nothing else, 10 degrees."""
AXES = ("x", "y", "z")
_PARALLEL_M = 1e-9


@dataclass(frozen=True, kw_only=True)
class Box:
    """The box around an object: its middle with its axes, and half its extents."""

    T_base_box: Float[np.ndarray, "4 4"]
    half_m: Float[np.ndarray, "3"]
    is_cube: bool = False
    """Its three axes are alike."""

    @property
    def centre_m(self) -> Float[np.ndarray, "3"]:
        """Its middle in the base frame."""
        return np.asarray(self.T_base_box[:3, 3])

    @property
    def heights_m(self) -> tuple[float, float]:
        """Of its lowest and of its highest point."""
        reach = float(np.abs(self.T_base_box[2, :3]) @ self.half_m)
        return float(self.T_base_box[2, 3]) - reach, float(self.T_base_box[2, 3]) + reach

    def reach_m(self, direction: Float[np.ndarray, "3"]) -> float:
        """How far it extends from its middle along a unit vector."""
        return float(np.abs(direction @ self.T_base_box[:3, :3]) @ self.half_m)

    def axes(self, name: str) -> Float[np.ndarray, "3 num_axes"]:
        """Its axis of a name in the base frame; of a cube all three."""
        if self.is_cube:
            return np.asarray(self.T_base_box[:3, :3])
        return np.asarray(self.T_base_box[:3, [AXES.index(name)]])


def footprint_gap_m(
    T_a: Float[np.ndarray, "*#batch 4 4"],
    half_a_m: Float[np.ndarray, "3"],
    T_b: Float[np.ndarray, "*#batch 4 4"],
    half_b_m: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "..."]:
    """Horizontal gap between two boxes seen from above; negative: how deep they overlap [m].

    The difference of two projected boxes is a polygon with a pair of parallel edges for each
    edge direction (a zonotope, see Ziegler, Lectures on Polytopes, 7.3): the gap is the distance
    of the origin from it.
    """
    T_a, T_b = np.broadcast_arrays(T_a, T_b)
    centre = (T_a[..., :2, 3] - T_b[..., :2, 3])[..., None, :]
    halves = [T_a[..., :2, :3] * half_a_m, T_b[..., :2, :3] * half_b_m]
    edges = np.concatenate(halves, axis=-1).swapaxes(-1, -2)
    long = np.linalg.norm(edges, axis=-1)
    flat = long > _PARALLEL_M  # an edge that points straight up has no direction from above
    along = edges / np.where(flat, long, 1.0)[..., None]
    normals = np.stack((-along[..., 1], along[..., 0]), axis=-1)
    across = normals @ edges.swapaxes(-1, -2)
    parallel = np.abs(across) < _PARALLEL_M
    across = np.where(parallel, 0.0, across)
    depth = np.abs((normals * centre).sum(axis=-1)) - np.abs(across).sum(axis=-1)
    overlap = np.where(flat, depth, -np.inf).max(axis=-1)
    lengths = np.where(parallel, np.abs(along @ edges.swapaxes(-1, -2)), 0.0).sum(axis=-1)
    to_middle = np.sign(across) @ edges
    gaps = []
    for sign in (1.0, -1.0):
        from_middle = -(centre + sign * to_middle)
        t = np.clip((from_middle * along).sum(axis=-1), -lengths, lengths)
        away = np.linalg.norm(from_middle - t[..., None] * along, axis=-1)
        gaps.append(np.where(flat, away, np.inf).min(axis=-1))
    return np.asarray(np.where(overlap <= 0, overlap, np.minimum(*gaps)))


def _gap_m(a: Box, b: Box) -> float:
    return float(footprint_gap_m(a.T_base_box, a.half_m, b.T_base_box, b.half_m))


def direction_of(value: str | Sequence[int | float]) -> Float[np.ndarray, "3"]:
    """The unit vector in the base frame of a direction that is a word or three numbers."""
    named = {**SIDES, **WAYS}
    vector = np.array(named[value] if isinstance(value, str) else value, dtype=np.float64)
    return np.asarray(vector / np.linalg.norm(vector))


Boxes = Mapping[str, Box]
Found = tuple[bool, str]
"""Whether a relation holds, and what was found."""


def on(spec: Mapping[str, Any], boxes: Boxes) -> Found:
    """Whether an object rests on another: at the height of its top, and not over its edge.

    The underside of the object may be ``tolerance_m`` above or below the top of the support. The
    middle of the object, at the height of the contact, must lie within the support's uppermost
    face, ``margin_m`` away from its edges: it would tip otherwise. The table is at z = 0 and has
    no edges.
    """
    object_id, support_id = spec["object"], spec["support"]
    thing = boxes[object_id]
    top = 0.0 if support_id == TABLE else boxes[support_id].heights_m[1]
    gap_m = thing.heights_m[0] - top
    high = abs(gap_m) <= float(spec.get("tolerance_m", ON_TOLERANCE_M))
    detail = (
        f"{object_id} is {abs(gap_m) * 1e3:.0f} mm {'above' if gap_m >= 0 else 'below'} the top of "
        f"{support_id}"
    )
    if support_id == TABLE:
        return high, detail
    support = boxes[support_id]
    contact = np.array([*thing.centre_m[:2], top])
    excess = np.abs(se3.apply(se3.invert(support.T_base_box), contact)) - support.half_m
    upward = int(np.argmax(np.abs(support.T_base_box[2, :3])))  # the face that looks up is no edge
    over_m = float(np.max(np.delete(excess, upward))) + float(spec.get("margin_m", 0.0))
    detail += (
        f", its middle {abs(over_m) * 1e3:.0f} mm {'over' if over_m > 0 else 'within'} the edge"
    )
    return high and over_m <= 0, detail


def outside(spec: Mapping[str, Any], boxes: Boxes) -> Found:
    """Whether an object is wholly out of a container, rim included, seen from above."""
    gap_m = _gap_m(boxes[spec["object"]], boxes[spec["container"]])
    detail = (
        f"{spec['object']} is {abs(gap_m) * 1e3:.0f} mm "
        f"{'away from' if gap_m >= 0 else 'within'} {spec['container']}, seen from above"
    )
    return gap_m >= float(spec.get("margin_m", 0.0)), detail


def beside(spec: Mapping[str, Any], boxes: Boxes) -> Found:
    """Whether an object stands next to another, without touching, at a common height.

    Seen from above the gap between the two must lie within ``gap_m``; with ``direction`` the
    object's middle must be on that side of the other's, within 45 degrees.
    """
    thing, other = boxes[spec["object"]], boxes[spec["reference"]]
    least, most = spec.get("gap_m", BESIDE_GAP_M)
    gap_m = _gap_m(thing, other)
    level = _overlap_m(thing, other) > 0
    detail = (
        f"{spec['object']} is {abs(gap_m) * 1e3:.0f} mm "
        f"{'from' if gap_m >= 0 else 'into'} {spec['reference']}"
        + ("" if level else " and at another height")
    )
    value = level and least <= gap_m <= most
    if "direction" in spec:
        direction = direction_of(spec["direction"])[:2]
        way = (thing.centre_m - other.centre_m)[:2]
        across = way[0] * direction[1] - way[1] * direction[0]
        off_rad = abs(float(np.arctan2(across, way @ direction)))
        word = spec["direction"] if isinstance(spec["direction"], str) else "its direction"
        detail += f", {np.degrees(off_rad):.0f} degrees off {word}"
        value = value and off_rad <= SECTOR_RAD
    return bool(value), detail


def between(spec: Mapping[str, Any], boxes: Boxes) -> Found:
    """Whether an object stands between two others, seen from above, at a common height with both.

    Along the line between their middles it must lie in the gap between the two; its middle may be
    ``tolerance_m`` away from that line.
    """
    thing, first, second = (boxes[spec[key]] for key in ("object", "first", "second"))
    way = second.centre_m - first.centre_m
    way[2] = 0.0
    length_m = float(np.linalg.norm(way))
    along = way / max(length_m, 1e-12)
    offset = thing.centre_m - first.centre_m
    at_m = float(offset @ along)
    reach_m = thing.reach_m(along)
    before_m = at_m - reach_m - first.reach_m(along)
    after_m = length_m - at_m - reach_m - second.reach_m(along)
    side_m = abs(float(along[0] * offset[1] - along[1] * offset[0]))
    level = min(_overlap_m(thing, first), _overlap_m(thing, second)) > 0
    value = (
        level
        and min(before_m, after_m) >= 0
        and side_m <= float(spec.get("tolerance_m", BETWEEN_TOLERANCE_M))
    )
    detail = (
        f"{spec['object']} is {before_m * 1e3:.0f} mm from {spec['first']}, {after_m * 1e3:.0f} mm "
        f"from {spec['second']} and {side_m * 1e3:.0f} mm off the line between them"
    )
    return bool(value), detail + ("" if level else ", at another height")


def upright(spec: Mapping[str, Any], boxes: Boxes) -> Found:
    """Whether an object's own z axis points up; of a cube any axis, up or down."""
    thing = boxes[spec["object"]]
    axes = thing.axes("z")
    up = np.abs(axes[2]) if thing.is_cube else axes[2]
    steepest = int(np.argmax(up))
    tilt_rad = float(np.arctan2(np.linalg.norm(axes[:2, steepest]), up[steepest]))
    detail = f"{spec['object']} is tilted by {np.degrees(tilt_rad):.0f} degrees"
    return tilt_rad <= float(spec.get("tolerance_rad", TILT_TOLERANCE_RAD)), detail


def aligned(spec: Mapping[str, Any], boxes: Boxes) -> Found:
    """Whether an axis of an object is parallel to one of another, whichever way they point.

    ``axis`` and ``reference_axis`` are x where nothing is said; of a cube the nearest one counts.
    """
    a = boxes[spec["object"]].axes(spec.get("axis", "x"))
    b = boxes[spec["reference"]].axes(spec.get("reference_axis", "x"))
    off_rad = min(
        float(np.arctan2(np.linalg.norm(np.cross(one, other)), abs(float(one @ other))))
        for one in a.T
        for other in b.T
    )
    detail = (
        f"{spec['object']} is turned by {np.degrees(off_rad):.0f} degrees from {spec['reference']}"
    )
    return off_rad <= float(spec.get("tolerance_rad", TILT_TOLERANCE_RAD)), detail


def _overlap_m(a: Box, b: Box) -> float:
    """Height that two boxes have in common; negative: the gap between their heights [m]."""
    low, high = zip(a.heights_m, b.heights_m, strict=True)
    return min(high) - max(low)


RELATIONS: dict[str, Callable[[Mapping[str, Any], Boxes], Found]] = {
    "on": on,
    "outside": outside,
    "beside": beside,
    "between": between,
    "upright": upright,
    "aligned": aligned,
}
"""By the kind of the success predicate."""
