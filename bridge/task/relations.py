"""How objects stand to each other: the geometry behind success predicates and the planner's goals.

Bodies are the boxes of their outer extents. Heights are along z of the base frame, against gravity;
"seen from above" is the projection along it. Nothing else of the base frame matters, except where a
direction is named: x points forwards, away from the robot's base, y to its left.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.task.check import TABLE
from bridge.task.task_file import ObjectModel

SIDES: dict[str, tuple[float, float, float]] = {
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "in_front": (-1.0, 0.0, 0.0),
    "behind": (1.0, 0.0, 0.0),
}
"""Sides of something as the robot sees it: what is in front of it is nearer to the robot."""
_SAME = (("left", "left"), ("right", "right"), ("forwards", "behind"), ("backwards", "in_front"))
WAYS = {way: SIDES[side] for way, side in _SAME}
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
MOVED_TOLERANCE_M = 0.02
"""Of where an object ends that is to move ``by_m``, where a task says nothing else [m]."""
SHOWN = {"m": (1e3, "mm"), "rad": (180 / np.pi, "degrees"), "m/s": (1e3, "mm/s")}
"""By unit: what a number of it is multiplied by for a person, and what it then is."""
AXES = ("x", "y", "z")
_TIE, _SHORT = 1e-6, 1e-12

Numbers = Float[np.ndarray, "..."]
Poses = Float[np.ndarray, "*#batch 4 4"]


@dataclass(frozen=True)
class Measured:
    """A number of each of many states, and the interval in which it should be."""

    what: str
    value: Any
    """One for each state, ``(*batch)``."""
    low: float = -np.inf
    high: float = np.inf
    unit: str = "m"
    """``m``, ``rad`` or ``m/s``."""
    beyond: str = ""
    """What it is beyond where it is above 0, and within where it is below: said for the sign."""

    @property
    def excess(self) -> Numbers:
        """How far it is outside of the interval; negative inside."""
        return np.asarray(np.maximum(self.low - self.value, self.value - self.high))

    def told(self, digits: int = 0) -> str:
        """What it is in the first state, in words."""
        value = float(np.ravel(self.value)[0])
        if not self.beyond:
            return f"{self.what} is {shown(value, self.unit, digits)}"
        side = "within" if value < 0 else "beyond"
        return f"{self.what} is {shown(abs(value), self.unit, digits)} {side} {self.beyond}"

    def wanted(self) -> str:
        """Where it should be, in words."""
        low, high, margin = (
            shown(each, self.unit, 1) for each in (self.low, self.high, -self.high)
        )
        if self.beyond:
            return f"{f'at least {margin} ' if self.high else ''}within {self.beyond}"
        if np.isneginf(self.low):
            return f"at most {high}"
        return f"at least {low}" if np.isposinf(self.high) else f"{low.split()[0]} to {high}"


def shown(value: float, unit: str, digits: int = 0) -> str:
    """A number with its unit, for a person."""
    factor, name = SHOWN[unit]
    return f"{round(value * factor, digits) + 0.0:.15g} {name}"  # never -0


@dataclass(frozen=True, kw_only=True)
class Box:
    """The box around an object in many states: its middle with its axes, and half its extents."""

    T_base_box: Poses
    half_m: Float[np.ndarray, "3"]
    is_cube: bool = False
    """Its three axes are alike."""
    origin_m: Any = None
    """Of the object's frame, ``(*batch, 3)``."""
    before_m: Any = None
    """Where that was before anything moved, ``(3,)``."""
    cavity: Any = None
    """The box of what a container holds, if it is one."""

    @staticmethod
    def around(
        model: ObjectModel, T: Poses, *, extents_m: Any = None, before_m: Any = None
    ) -> "Box":
        """The box around an object with poses ``T_base_object``."""

        def box(height_m: float, size_m: Any, **more: Any) -> Box:
            raised = T.copy()
            raised[..., :3, 3] += T[..., :3, 2] * height_m
            return Box(T_base_box=raised, half_m=np.array(size_m, dtype=np.float64) / 2, **more)

        up_m, wall_m, inner_m = model.size_m[2] / 2, model.wall_m, model.inner_m
        return box(
            0.0 if model.origin_at_centre else up_m,
            model.size_m if extents_m is None else extents_m,
            is_cube=model.symmetry == "cube",
            origin_m=T[..., :3, 3],
            before_m=before_m,
            cavity=box(wall_m + inner_m[2] / 2, inner_m),
        )

    @property
    def centre_m(self) -> Float[np.ndarray, "... 3"]:
        """Its middle in the base frame."""
        return np.asarray(self.T_base_box[..., :3, 3])

    @property
    def heights_m(self) -> tuple[Numbers, Numbers]:
        """Of its lowest and of its highest point."""
        reach, middle = self.reach_m(np.array([0.0, 0.0, 1.0])), self.centre_m[..., 2]
        return np.asarray(middle - reach), np.asarray(middle + reach)

    def reach_m(self, direction: Float[np.ndarray, "... 3"]) -> Numbers:
        """How far it extends from its middle along a unit vector."""
        along = np.abs((direction[..., None, :] @ self.T_base_box[..., :3, :3])[..., 0, :])
        return np.asarray(along @ self.half_m)

    def axes(self, name: str) -> Float[np.ndarray, "... 3 num_axes"]:
        """Its axis of a name in the base frame; of a cube all three."""
        columns = [0, 1, 2] if self.is_cube else [AXES.index(name)]
        return np.asarray(self.T_base_box[..., :3, columns])

    def beyond_m(self, p_m: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """How far points are beyond its sides along each of its axes; negative: within."""
        way = (p_m - self.centre_m)[..., None, :]
        return np.asarray(np.abs((way @ self.T_base_box[..., :3, :3])[..., 0, :]) - self.half_m)


def footprint_gap_m(a: Box, b: Box) -> Numbers:
    """Horizontal gap between two boxes seen from above; negative: how deep they overlap [m].

    The difference of two projected boxes is a polygon with a pair of parallel edges for each
    edge direction (a zonotope, see Ziegler, Lectures on Polytopes, 7.3). The origin is as far from
    it as the farthest of the lines that touch it across an edge, or across the way to a corner.
    """
    centre = (a.centre_m - b.centre_m)[..., None, :2]
    halves = (box.T_base_box[..., :2, :3] * box.half_m for box in (a, b))
    columns = np.concatenate(np.broadcast_arrays(*halves), axis=-1)
    edges = columns.swapaxes(-1, -2)
    normals = np.stack((-edges[..., 1], edges[..., 0]), axis=-1)
    turned = np.concatenate([normals + _TIE * edges, normals - _TIE * edges], axis=-2)
    tips = np.sign(turned @ columns) @ edges

    def apart(ways: Numbers) -> Numbers:  # one that is no direction tells nothing
        length = np.linalg.norm(ways, axis=-1)
        away = np.abs((ways * centre).sum(axis=-1)) - np.abs(ways @ columns).sum(axis=-1)
        return np.asarray(np.where(length <= _SHORT, -np.inf, away / np.maximum(length, _SHORT)))

    overlap = apart(normals).max(axis=-1)
    corners = np.concatenate([centre + tips, centre - tips], axis=-2)
    gap = np.maximum(overlap, apart(corners).max(axis=-1))
    return np.asarray(np.where(overlap <= 0, overlap, gap))


def direction_of(value: str | Sequence[int | float]) -> Float[np.ndarray, "3"]:
    """The unit vector in the base frame of a direction that is a word or three numbers."""
    vector = np.array((SIDES | WAYS)[value] if isinstance(value, str) else value, dtype=np.float64)
    return np.asarray(vector / np.linalg.norm(vector))


Boxes = Mapping[str, Box]
Spec = Mapping[str, Any]
Found = list[Measured]


def on(spec: Spec, boxes: Boxes) -> Found:
    """An object rests on another: at the height of its top, and not over its edge.

    The underside of the object may be ``tolerance_m`` above or below the top of the support. The
    middle of the object, at the height of the contact, must lie within the support's uppermost
    face, ``margin_m`` away from its edges: it would tip otherwise. The table has no edges.
    """
    name, under = spec["object"], spec["support"]
    thing, support = boxes[name], boxes[under]
    top_m, tol_m = support.heights_m[1], float(spec.get("tolerance_m", ON_TOLERANCE_M))
    gap_m = thing.heights_m[0] - top_m
    found = [Measured(f"the gap from {under} up to {name}", gap_m, low=-tol_m, high=tol_m)]
    if under != TABLE:
        x, y, _ = np.moveaxis(thing.centre_m, -1, 0)
        contact = np.stack(np.broadcast_arrays(x, y, top_m), axis=-1)
        up = np.abs(support.T_base_box[..., 2, :3])
        upward = up == np.amax(up, axis=-1, keepdims=True)  # the face that looks up is no edge
        over_m = np.where(upward, -np.inf, support.beyond_m(contact)).max(axis=-1)
        high_m, edge = -float(spec.get("margin_m", 0.0)), f"the edge of {under}"
        found.append(Measured(f"the middle of {name}", over_m, high=high_m, beyond=edge))
    return found


def outside(spec: Spec, boxes: Boxes) -> Found:
    """An object is wholly out of a container, rim included, seen from above."""
    return [_gap(spec, "container", boxes, float(spec.get("margin_m", 0.0)))]


def _gap(spec: Spec, key: str, boxes: Boxes, low: float, high: float = np.inf) -> Measured:
    gap_m = footprint_gap_m(boxes[spec["object"]], boxes[spec[key]])
    what = f"the gap between {spec['object']} and {spec[key]} seen from above"
    return Measured(what, gap_m, low=low, high=high)


def beside(spec: Spec, boxes: Boxes) -> Found:
    """An object stands next to another, without touching, at a common height.

    Seen from above the gap between the two must lie within ``gap_m``; with ``direction`` the
    object's middle must be on that side of the other's, within 45 degrees.
    """
    found = [
        _gap(spec, "reference", boxes, *map(float, spec.get("gap_m", BESIDE_GAP_M))),
        _level(spec["object"], spec["reference"], boxes),
    ]
    if "direction" in spec:
        side = direction_of(spec["direction"])[:2]
        way = (boxes[spec["object"]].centre_m - boxes[spec["reference"]].centre_m)[..., :2]
        across = way[..., 0] * side[1] - way[..., 1] * side[0]
        off_rad = np.arctan2(np.abs(across), way @ side)
        word = spec["direction"] if isinstance(spec["direction"], str) else "its direction"
        what = f"the side of {spec['reference']} it is on, off {word},"
        found.append(Measured(what, off_rad, high=SECTOR_RAD, unit="rad"))
    return found


def between(spec: Spec, boxes: Boxes) -> Found:
    """An object stands between two others, seen from above, at a common height with both.

    Along the line between their middles it must lie in the gap between the two; its middle may be
    ``tolerance_m`` away from that line.
    """
    names = spec["object"], spec["first"], spec["second"]
    thing, first, second = (boxes[name] for name in names)
    way = (second.centre_m - first.centre_m) * (1.0, 1.0, 0.0)
    length_m = np.linalg.norm(way, axis=-1)
    along = way / np.maximum(length_m, 1e-12)[..., None]
    offset = thing.centre_m - first.centre_m
    at_m, reach_m = (offset * along).sum(axis=-1), thing.reach_m(along)
    before_m = at_m - reach_m - first.reach_m(along)
    after_m = length_m - at_m - reach_m - second.reach_m(along)
    side_m = np.abs(along[..., 0] * offset[..., 1] - along[..., 1] * offset[..., 0])
    most_m = float(spec.get("tolerance_m", BETWEEN_TOLERANCE_M))
    return [
        Measured(f"the room from {names[1]} to {names[0]}", before_m, low=0.0),
        Measured(f"the room from {names[0]} to {names[2]}", after_m, low=0.0),
        Measured(f"{names[0]} off the line between them", side_m, high=most_m),
        *(_level(names[0], other, boxes) for other in names[1:]),
    ]


def upright(spec: Spec, boxes: Boxes) -> Found:
    """An object's own z axis points up; of a cube any axis, up or down."""
    thing = boxes[spec["object"]]
    axes = thing.axes("z")
    up = np.abs(axes[..., 2, :]) if thing.is_cube else axes[..., 2, :]
    flat = np.linalg.norm(axes[..., :2, :], axis=-2)
    tilt_rad = np.amin(np.arctan2(flat, up), axis=-1)
    most_rad = float(spec.get("tolerance_rad", TILT_TOLERANCE_RAD))
    return [Measured(f"the tilt of {spec['object']}", tilt_rad, high=most_rad, unit="rad")]


def aligned(spec: Spec, boxes: Boxes) -> Found:
    """An axis of an object is parallel to one of another, whichever way they point.

    ``axis`` and ``reference_axis`` are x where nothing is said; of a cube the nearest one counts.
    """
    one = boxes[spec["object"]].axes(spec.get("axis", "x"))
    other = boxes[spec["reference"]].axes(spec.get("reference_axis", "x"))
    a, b = np.swapaxes(one, -1, -2)[..., :, None, :], np.swapaxes(other, -1, -2)[..., None, :, :]
    across = np.linalg.norm(np.cross(a, b), axis=-1)
    off_rad = np.arctan2(across, np.abs((a * b).sum(-1))).min(axis=(-1, -2))
    most_rad = float(spec.get("tolerance_rad", TILT_TOLERANCE_RAD))
    what = f"the turn of {spec['object']} from {spec['reference']}"
    return [Measured(what, off_rad, high=most_rad, unit="rad")]


def _level(a: str, b: str, boxes: Boxes) -> Measured:
    """Height that two boxes have in common; negative: the gap between their heights."""
    lows, highs = zip(boxes[a].heights_m, boxes[b].heights_m, strict=True)
    common_m = np.minimum(*highs) - np.maximum(*lows)
    return Measured(f"the height that {a} and {b} have in common", common_m, low=0.0)


def inside(spec: Spec, boxes: Boxes) -> Found:
    """The origin of an object is in a container's cavity, ``margin_m`` away from its walls."""
    cavity, middle = boxes[spec["container"]].cavity, boxes[spec["object"]].origin_m
    excess = cavity.beyond_m(middle).max(axis=-1)
    high_m, edge = -float(spec.get("margin_m", 0.0)), f"the cavity of {spec['container']}"
    return [Measured(f"the middle of {spec['object']}", excess, high=high_m, beyond=edge)]


def moved(spec: Spec, boxes: Boxes) -> Found:
    """An object is where it should be compared with where it was before.

    The way between the two is measured straight, or, with ``direction`` (in the base frame), along
    that direction, backwards counting as negative. It must be ``at_least_m`` and ``at_most_m``
    long. With ``by_m`` the origin must end, seen from above, within ``tolerance_m`` of the point so
    far along ``direction`` from its start. With ``target_m`` it must end within ``tolerance_m`` of
    that point of the base frame; of a point with two numbers, seen from above.
    """
    name, found = spec["object"], []
    p, p_before = boxes[name].origin_m, boxes[name].before_m
    way = p - p_before
    direction = direction_of(spec["direction"]) if "direction" in spec else None
    if "at_least_m" in spec or "at_most_m" in spec:
        length = np.linalg.norm(way, axis=-1) if direction is None else way @ direction
        low, high = spec.get("at_least_m", -np.inf), spec.get("at_most_m", np.inf)
        found.append(Measured(f"the way {name} was moved", length, low=low, high=high))
    targets = [np.array(spec["target_m"], dtype=np.float64)] if "target_m" in spec else []
    if "by_m" in spec and direction is not None:
        targets.append((p_before + spec["by_m"] * direction)[:2])
    for target in targets:
        off = np.linalg.norm(p[..., : len(target)] - target, axis=-1)
        what = f"the distance of {name} from {target.round(4).tolist()} m"
        found.append(Measured(what, off, high=spec.get("tolerance_m", MOVED_TOLERANCE_M)))
    return found


RELATIONS: dict[str, Callable[[Spec, Boxes], Found]] = {
    rule.__name__: rule for rule in (on, inside, moved, outside, beside, between, upright, aligned)
}
"""By the kind of the success predicate."""
