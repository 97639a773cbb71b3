"""Measure one state after another; name who came too close to what, and when first.

Robot, gripper and moved objects against the static scene (table, container panels, and what the
scene's grid shows beside them), and the arm against objects. Pairs the active stage allows may
touch, but not lie in each other; all others keep ``eps_col_m``. Objects that have not moved since
the start belong to nobody's motion and are left out. Links and the carried boxes are convex hulls,
soft bodies their nodes, and distances are on the safe side.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from math import asin, hypot, sqrt
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.causes import Cause
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.plan import Plan, Stage
from bridge.task.predicate import Contact
from twin.replay.clearance.bodies import (
    GRIPPER,
    distance_to_planes_m,
    names_of,
    placement_of,
    planes_of,
)
from twin.replay.clearance.surroundings import Pair, Surroundings
from twin.replay.config import MOVED_M, ReplayConfig
from twin.replay.failure import Failure
from twin.replay.scene import ReplayScene
from twin.robot.collision import RobotHulls, signed_distance
from twin.robot.model import RobotModel

# What may have happened between two states: how far anything moved, and the state half way.
# A point that travels s between two instants is never farther than s / 2 from where it was at one
# of them. Two bodies that were d0 and d1 apart and travelled s together therefore kept at least
# (d0 + d1 - s) / 2. Where that is not enough, the state half way is looked at, and so on.

MAX_CONTACT_DEPTH_M = 0.005
"""Bodies that may touch may not lie deeper in each other than this [m]."""
PRE_GRASP_DEPTH_M, PRE_GRASP_SOFT_DEPTH_M = 0.002, 0.004
"""Deepest overlap with an object before the first grasp that localisation may explain [m]; soft
ones give way. A finger is 12 mm thick: what it is pushed into lies at most 6 mm deep in it."""
MAX_LEAP_M = 0.05
"""An object that is this far away at the next state did not move there: something else became
known of it. Nothing is said of its way."""


@dataclass(frozen=True, kw_only=True)
class State:
    """Where everything is at one instant."""

    t_ns: int
    joints_rad: Float[np.ndarray, " num_joints"]
    width_m: float
    Ts_base_object: dict[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    nodes_m: dict[str, Float[np.ndarray, "num_nodes 3"]] = field(default_factory=dict)
    """Soft bodies, base frame."""


def half_way(a: State, b: State) -> State:
    """The state in the middle, straight in joints, positions and nodes.

    Objects that leapt, or are known at one of the two only, are left out.
    """
    poses, nodes = {}, {}
    for name in (*a.Ts_base_object, *a.nodes_m):
        if object_travel_m(a, b, name, 0.0) > MAX_LEAP_M:
            continue
        if name in a.nodes_m:
            nodes[name] = (a.nodes_m[name] + b.nodes_m[name]) / 2
            continue
        q, p = se3.split(np.stack([each.Ts_base_object[name] for each in (a, b)]))
        middle = se3.interpolate_quaternion(q[0], q[1], np.array(0.5))
        poses[name] = se3.transform_from(middle, (p[0] + p[1]) / 2)
    return State(
        t_ns=(a.t_ns + b.t_ns + 1) // 2,
        joints_rad=(a.joints_rad + b.joints_rad) / 2,
        width_m=(a.width_m + b.width_m) / 2,
        Ts_base_object=poses,
        nodes_m=nodes,
    )


_WIDTHS = 33
"""Openings at which a finger's law is asked how fast it moves."""


class Reach:
    """How far a joint can move any point of each link, per radian."""

    def __init__(self, hulls: RobotHulls) -> None:
        """Add up the lengths of the links between each joint and each hull."""
        robot = hulls.robot
        model = robot.model
        joint_ids = [int(model.getJointId(name)) for name in robot.joints]
        self._per_rad = np.zeros((len(hulls.hulls), len(joint_ids)))
        self._fingers = np.zeros(len(hulls.hulls))
        for row, hull in enumerate(hulls.hulls):
            frame = model.frames[robot.frame_id(hull.link)]
            points = hull.points_m @ frame.placement.rotation.T + frame.placement.translation
            reach = ends_m = float(np.linalg.norm(points, axis=1).max())
            joint = int(frame.parentJoint)
            while joint:
                if joint in joint_ids:
                    self._per_rad[row, joint_ids.index(joint)] = reach
                # The joint's own slide, if it is one, moves it by at most its range.
                reach += float(np.linalg.norm(model.jointPlacements[joint].translation))
                if "P" in model.joints[joint].shortname().removeprefix("JointModel"):
                    index = model.joints[joint].idx_q
                    ends = model.lowerPositionLimit[index], model.upperPositionLimit[index]
                    reach += float(np.abs(ends).max())
                joint = int(model.parents[joint])
            self._fingers[row] = _per_width(robot, int(frame.parentJoint), reach=ends_m)

    def travel_m(
        self,
        turned_rad: Float[np.ndarray, "*num_steps num_joints"],
        opened_m: float | Float[np.ndarray, "*num_steps"],
    ) -> Float[np.ndarray, "*num_steps num_links"]:
        """How far any point of each link moved at most [m], if joints and width moved straight."""
        opened = np.multiply.outer(np.abs(opened_m), self._fingers)
        return np.asarray(np.abs(turned_rad) @ self._per_rad.T + opened)


def _per_width(robot: RobotModel, joint: int, *, reach: float) -> float:
    """How far a point of a finger moves at most per width, when its joint moves it."""
    gripper, name = robot.record.gripper, str(robot.model.names[joint])
    laws = {finger.joint: (finger, 1.0) for finger in gripper.fingers}
    for item in robot.followers:
        if item.leader in laws:
            laws[item.joint] = (laws[item.leader][0], item.multiplier)
    if name not in laws:
        return 0.0
    finger, ratio = laws[name]
    widths = np.linspace(0.0, gripper.max_width_m, _WIDTHS).tolist()
    slope = abs(ratio) * max(abs(finger.slope(width)) for width in widths)
    return slope * (reach if finger.turns else 1.0)


def object_travel_m(a: State, b: State, name: str, radius_m: float) -> float:
    """How far an object's points in a radius moved at most [m]; infinite if in one state only."""
    if name in a.nodes_m and name in b.nodes_m:
        return float(np.linalg.norm(b.nodes_m[name] - a.nodes_m[name], axis=1).max())
    if name not in a.Ts_base_object or name not in b.Ts_base_object:
        return float("inf")
    change = b.Ts_base_object[name] - a.Ts_base_object[name]
    # Rotations an angle apart differ by a matrix of norm sqrt(8) sin(angle / 2).
    turned = 2 * asin(min(1.0, hypot(*change[:3, :3].ravel().tolist()) / sqrt(8)))
    return hypot(*change[:3, 3].tolist()) + turned * radius_m


Poses = Mapping[str, Float[np.ndarray, "4 4"]]
Nodes = Mapping[str, Float[np.ndarray, "num_nodes 3"]]

LATE_S = 0.01
"""Where a body is at its speed so long earlier or later is not known; distances must allow for
it."""
_LOOK_AHEAD_M = 0.01
"""Pairs nearer than this are measured although they keep their distance now, so that what may
happen before the next state is bounded: steps of up to twice as far need no state in between."""
_FINE_TRAVEL_M = 0.001
"""Motion between two states that is not looked into further: half of it is what may be missed."""
_MAX_HALVINGS = 10


Allowed = frozenset[frozenset[str]]
"""Pairs of bodies, or of a body and a group, that may touch."""


@dataclass(frozen=True)
class _Look:
    """Distances at one state."""

    state: State
    distances: dict[Pair, float]
    cut_m: float
    """Every pair without a distance is at least this far apart."""
    allowed: Allowed
    centres_m: Float[np.ndarray, "num_links 3"]
    """Of the links."""


class ClearanceMonitor:
    """Measures one state after another and remembers what went wrong first."""

    def __init__(
        self, scene: ReplayScene, plan: Plan, hulls: RobotHulls, config: ReplayConfig
    ) -> None:
        """Prepare the static scene and the bounding spheres."""
        self.config = config
        self.hulls = hulls
        self._allowed_at = allowed_at(plan.stages)
        self.failures: list[Failure] = []
        self.scene = scene
        self._around = Surroundings(scene, hulls, config.eps_col_m)
        self._links = self._around.links
        self._objects = self._around.objects
        self._centres = np.stack([link.centre for link in self._links])[:, :, None]
        self._radii = np.array([link.radius_m for link in self._links])
        # How far off a body that stands still may be: as localisation says, one deviation.
        fixed = {n: c for n, c in scene.covariances.items() if n in scene.containers()}
        self.sigma_m = {
            name: float(np.sqrt(np.linalg.eigvalsh(np.asarray(c)[:3, :3]).max()))
            for name, c in fixed.items()
        }
        self.lacking_m: dict[tuple[str, ...], float] = {}  # of bodies: how much farther apart
        gripper = hulls.robot.record.gripper
        self._hand = [k for k, s in enumerate(self._links) if s.body in gripper.links]
        self.reach = Reach(hulls)
        self._contacts: dict[tuple[str, str, bool], list[Contact]] = {}
        self._last_ns = 0
        self._nearest: tuple[float, Pair, int] | None = None
        self._first_centre: dict[str, Float[np.ndarray, " 3"]] = {}
        self.leap()

    def leap(self) -> None:
        """Say nothing of what was between the state before and the next one."""
        self._last: _Look | None = None
        self._late_m = np.zeros(len(self._links))
        self._object_late_m: dict[str, float] = {}
        # The most by which a pair must keep more than ``eps_col_m``.
        self._more_m = max(self.sigma_m.values(), default=0.0)

    def measure(
        self,
        t_ns: int,  # from the start of the trajectory; calls come in order
        joints_rad: Float[np.ndarray, " num_joints"],
        width_m: float,
        Ts_base_object: Poses,  # movable objects; those not known are left out
        nodes_m: Nodes | None = None,  # base frame; soft with a pose only: the box around it
    ) -> float:
        """Return delta(x_t), the smallest distance over the pairs that may not touch [m].

        What may have happened since the call before is bounded by how far everything moved; where
        the bound is not enough, states in between are measured too, straight in joints and poses.
        A body that comes too close between two calls is therefore missed by half a millimetre at
        most, and the smallest distance in between is returned.
        """
        nodes = {n: np.asarray(rows, dtype=np.float64) for n, rows in (nodes_m or {}).items()}
        state = State(
            t_ns=t_ns,
            joints_rad=joints_rad,
            width_m=width_m,
            Ts_base_object={n: T for n, T in Ts_base_object.items() if n not in nodes},
            nodes_m=nodes,
        )
        look = self._look(state)
        if self._last is not None:
            self._move_on(self._last, look)
        looks = [] if self._last is None else self._between(self._last, look, _MAX_HALVINGS)
        self._last = look
        return min(self._judge_all(item) for item in (*looks, look))

    def _move_on(self, before: _Look, now: _Look) -> None:
        """Note how far each body may be from where it should be, at the speed it has."""
        share = LATE_S / max((now.state.t_ns - before.state.t_ns) * 1e-9, LATE_S / 10)
        self._late_m = np.linalg.norm(now.centres_m - before.centres_m, axis=1) * share
        if self._hand:  # fingers may be told to close from one instant to the next
            self._late_m[self._hand] = self._late_m[self._hand].min()
        places = before.state.Ts_base_object
        steps = {
            name: hypot(*(T[:3, 3] - places[name][:3, 3]).tolist())
            for name, T in now.state.Ts_base_object.items()
            if name in places
        }  # a leap is no speed
        self._object_late_m = {n: m * share for n, m in steps.items() if m <= MAX_LEAP_M}
        late_m = max([float(self._late_m.max()), *self._object_late_m.values()])
        self._more_m = min(late_m, MAX_LEAP_M) + max(self.sigma_m.values(), default=0.0)

    def least_m(self, pair: Pair) -> float:
        """How far a pair that may not touch must be apart now: farther when it is fast."""
        body, piece, other, _ = pair
        late_m = self._object_late_m.get(body, 0.0) if piece < 0 else float(self._late_m[piece])
        return self.config.eps_col_m + min(late_m, MAX_LEAP_M) + self.sigma_m.get(other, 0.0)

    def _look(self, state: State) -> _Look:
        """Measure every pair that is near, or the nearest one."""
        self.hulls.place(state.joints_rad, state.width_m)
        moved = [name for name, T in state.Ts_base_object.items() if self._has_moved(name, T)]
        soft = {n: p for n, p in state.nodes_m.items() if self._nodes_have_moved(n, p)}
        allowed = self._allowed_at(state.t_ns)
        distances, cut = self._around.measure(
            state.Ts_base_object,
            moved,
            near_m=self.config.eps_col_m + self._more_m + _LOOK_AHEAD_M,
            counts=lambda body, other: not _may_touch(body, other, allowed, self.hulls.robot),
        )
        distances |= self._around.measure_nodes(self._links, state.nodes_m, soft)
        centres = np.matmul(self.hulls.rotations, self._centres)[:, :, 0] + self.hulls.translations
        return _Look(state, distances, cut, allowed, centres)

    def _between(self, a: _Look, b: _Look, halvings: int) -> list[_Look]:
        """States between two that must be measured because the bound allows a touch."""
        if halvings == 0 or not self._may_have_touched(a, b):
            return []
        middle = self._look(half_way(a.state, b.state))
        before = self._between(a, middle, halvings - 1)
        return [*before, middle, *self._between(middle, b, halvings - 1)]

    def _may_have_touched(self, a: _Look, b: _Look) -> bool:
        links_m = self.reach.travel_m(
            b.state.joints_rad - a.state.joints_rad, b.state.width_m - a.state.width_m
        )
        objects_m = {
            name: object_travel_m(a.state, b.state, name, solid.radius_m)
            for name, solid in self._objects.items()
        }
        farthest = float(links_m.max()) + max(
            (travel for travel in objects_m.values() if travel <= MAX_LEAP_M), default=0.0
        )
        most_m = self.config.eps_col_m + self._more_m
        if farthest <= _FINE_TRAVEL_M:
            return False  # objects that leapt are nobody's way
        if a.cut_m + b.cut_m - farthest < 2 * most_m:
            return True
        for pair in a.distances.keys() | b.distances.keys():
            body, piece, other, _ = pair
            travel = objects_m.get(body, 0.0) if piece < 0 else float(links_m[piece])
            travel += objects_m.get(other, 0.0)
            first, last = (look.distances.get(pair, look.cut_m) for look in (a, b))
            eps = self.least_m(pair)
            if travel <= _FINE_TRAVEL_M or first + last - travel >= 2 * eps:
                continue
            if max(objects_m.get(body, 0.0), objects_m.get(other, 0.0)) > MAX_LEAP_M:
                continue
            limit = eps
            if any(_may_touch(body, other, look.allowed, self.hulls.robot) for look in (a, b)):
                # Objects push each other and the fingers; only what stands still can be run into.
                if piece < 0 or other in objects_m:
                    continue
                limit = -MAX_CONTACT_DEPTH_M
            known = first < limit or last < limit  # judged at that state already
            if not known and first + last - travel < 2 * limit:
                return True
        return False

    def _judge_all(self, look: _Look) -> float:
        """Note every pair of a state that is too close; return its delta."""
        t_ns = look.state.t_ns
        ordered = sorted(look.distances.items(), key=lambda item: item[1])
        least_m = float("inf")
        for pair, distance in ordered:
            counted_m = self._judge(t_ns, pair, distance, look.allowed)
            if counted_m < least_m:
                least_m = counted_m
                if self._nearest is None or counted_m < self._nearest[0]:
                    self._nearest = (counted_m, pair, t_ns)
        self._last_ns = t_ns
        return least_m

    def check_pre_grasp(
        self, t_ns: int, joints_rad: Float[np.ndarray, " num_joints"], width_m: float
    ) -> None:
        """Look for links inside objects that still lie where they were localised.

        Physics would push the object aside and hide that a finger comes down on it.
        """
        self.hulls.place(joints_rad, width_m)
        R, t = self.hulls.rotations, self.hulls.translations
        centres = np.matmul(R, self._centres)[:, :, 0] + t
        for name, T in self.scene.movable().items():
            model = self.scene.task.objects[name]
            solid = self._objects[name]
            limit_m = PRE_GRASP_DEPTH_M
            if model.soft is not None:  # it gives way, and is localised less exactly
                limit_m = PRE_GRASP_SOFT_DEPTH_M
            away = np.linalg.norm(centres - se3.apply(T, solid.centre), axis=1)
            for index in np.flatnonzero(away <= self._radii + solid.radius_m).tolist():
                link = self._links[index]
                distance = (
                    distance_to_planes_m(
                        planes_of(self.hulls)[index],
                        se3.apply(T, object_mesh(model).vertices_m),
                        R[index],
                        t[index],
                    )
                    if model.mesh is not None
                    else signed_distance(
                        link.shape, self.hulls.placement(index), solid.shape, placement_of(T)
                    )
                )
                if distance < -limit_m:
                    self._fail(t_ns, Cause.PRE_GRASP_PENETRATION, link.body, name, distance)

    def contacts(self) -> list[Contact]:
        """Stretches of time in which two bodies were closer than the margin."""
        collected = [contact for stretch in self._contacts.values() for contact in stretch]
        return sorted(collected, key=lambda contact: (contact.start_ns, contact.bodies))

    def nearest(self) -> dict[str, Any] | None:
        """When and between what the smallest clearance so far was, as a verdict keeps it."""
        if self._nearest is None:
            return None
        distance_m, (body, _, other, _), t_ns = self._nearest
        return {"t_ns": t_ns, "distance_m": distance_m, "bodies": [body, other]}

    def _has_moved(self, name: str, T: Float[np.ndarray, "4 4"]) -> bool:
        start = self.scene.Ts_base_object[name]
        return hypot(*(T[:3, 3] - start[:3, 3]).tolist()) > MOVED_M

    def _nodes_have_moved(self, name: str, nodes: Float[np.ndarray, "num_nodes 3"]) -> bool:
        """Against where the body had come to rest, because it sags when it is put down."""
        centre = nodes.mean(axis=0)
        start = self._first_centre.setdefault(name, centre)
        return bool(np.linalg.norm(centre - start) > MOVED_M)

    def _judge(self, t_ns: int, pair: Pair, distance: float, allowed: Allowed) -> float:
        """Note a pair that is too close; returns its distance if the pair may not touch."""
        body, _, other, _ = pair
        may_touch = _may_touch(body, other, allowed, self.hulls.robot)
        if distance < self.config.eps_col_m:
            self._note(t_ns, (body, other), distance, may_touch)
        if may_touch:
            # An object that drops may lie deep for one step: the solver's doing, not the plan's.
            # Neither is a finger among the nodes of a soft body that it squeezes as it may.
            solid = body not in self._objects and other not in self.scene.task.soft_objects
            if distance < -MAX_CONTACT_DEPTH_M and solid:
                self._fail(t_ns, Cause.DEEP_CONTACT, body, other, distance)
            return np.inf
        least_m = self.least_m(pair)
        if distance < least_m:
            lacking_m = self.lacking_m.get((body, other), 0.0)
            self.lacking_m[body, other] = max(lacking_m, least_m - distance)
            cause = Cause.COLLISION if distance < 0 else Cause.TOO_CLOSE
            self._fail(t_ns, cause, body, other, distance, least_m)
        return distance

    def _fail(
        self, t_ns: int, cause: Cause, body: str, other: str, distance: float, least_m: float = 0.0
    ) -> None:
        if any(failure.cause == cause for failure in self.failures):
            return
        if distance < 0:
            where = f"{-distance * 1e3:.1f} mm inside {other}"
        else:
            where = f"{distance * 1e3:.2f} mm from {other}, nearer than {least_m * 1e3:.3g} mm"
            if least_m > self.config.eps_col_m:
                where += f", of which {(least_m - self.config.eps_col_m) * 1e3:.1f} mm are for its "
                where += "speed and for what localisation does not know"
        bodies, detail = (body, other), f"{body} is {where}"
        self.failures.append(Failure(t_ns=t_ns, cause=cause, bodies=bodies, detail=detail))

    def _note(self, t_ns: int, bodies: tuple[str, str], distance: float, may_touch: bool) -> None:
        stretches = self._contacts.setdefault((*bodies, may_touch), [])
        if stretches and stretches[-1].end_ns >= self._last_ns:
            last = stretches.pop()
            start, least = last.start_ns, min(last.min_distance_m, distance)
        else:
            start, least = t_ns, distance
        stretches.append(
            Contact(
                start_ns=start, end_ns=t_ns, bodies=bodies, allowed=may_touch, min_distance_m=least
            )
        )


def active_stage(stages: tuple[Stage, ...], t_ns: int) -> Stage | None:
    """The last stage that has begun; before the first one begins, the first."""
    begun = [stage for stage in stages if stage.t_start_ns <= t_ns]
    if begun:
        return begun[-1]
    return stages[0] if stages else None


def allowed_at(stages: tuple[Stage, ...]) -> Callable[[int], Allowed]:
    """As ``allowed_pairs`` by time, worked out once for each stage."""
    known: dict[int, Allowed] = {}

    def at(t_ns: int) -> Allowed:
        stage = id(active_stage(stages, t_ns))
        if stage not in known:
            known[stage] = allowed_pairs(stages, t_ns)
        return known[stage]

    return at


def allowed_pairs(stages: tuple[Stage, ...], t_ns: int) -> Allowed:
    """Pairs that may touch: those of the active stage, and what earlier stages let go of.

    Where a stage released an object, or pushed it and left, it may go on lying on what that stage
    allowed it to touch; the gripper's own leave ends with the stage.
    """
    active = active_stage(stages, t_ns)
    if active is None:
        return frozenset()
    left = [stage for stage in stages[: stages.index(active)] if stage.release or stage.push]
    stays = {frozenset(pair) for stage in left for pair in stage.allowed_contacts}
    return frozenset(pair for pair in stays if GRIPPER not in pair) | frozenset(
        frozenset(pair) for pair in active.allowed_contacts
    )


@lru_cache(maxsize=4096)
def _may_touch(body: str, other: str, allowed: Allowed, robot: RobotModel) -> bool:
    names = names_of(body, robot.record.gripper)
    return any(frozenset((name, other)) in allowed for name in names)
