"""The clearance delta(x_t) of I(tau): who comes too close to what (errata resolution 8).

Robot, gripper and moved objects against the static scene (table and container panels), and the
arm against objects. Pairs the active stage allows may touch, but not lie in each other; all others
keep ``eps_col_m``. Objects that have not moved since the start belong to nobody's motion and are
left out. Links and the carried boxes are convex hulls, so distances are on the safe side.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import coal
import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.plan import Plan, Stage
from bridge.task.robot import GRIPPER_LINKS
from twin.replay.config import ReplayConfig
from twin.replay.failure import Failure
from twin.replay.result import Contact
from twin.replay.scene import ReplayScene
from twin.robot.collision import RobotHulls, signed_distance
from twin.robot.hulls import convex_hull

TABLE = "table"
GRIPPER = "gripper"

Poses = Mapping[str, Float[np.ndarray, "4 4"]]


@dataclass(frozen=True)
class _Solid:
    """One convex piece with a bounding sphere, to skip pairs that are far apart."""

    body: str
    shape: coal.CollisionGeometry
    centre: Float[np.ndarray, "3"]
    radius_m: float


@dataclass(frozen=True)
class _Placed:
    """One convex piece where it is."""

    body: str
    shape: coal.CollisionGeometry
    placement: coal.Transform3s


class ClearanceMonitor:
    """Measures one state after another and remembers what went wrong first."""

    def __init__(
        self, scene: ReplayScene, plan: Plan, hulls: RobotHulls, config: ReplayConfig
    ) -> None:
        """Prepare the static scene and the bounding spheres."""
        self.config = config
        self.hulls = hulls
        self.stages = plan.stages
        self.failures: list[Failure] = []
        self._scene = scene
        self._links = [_solid(hull.link, hull.shape, hull.points_m) for hull in hulls.hulls]
        self._objects = {
            name: _box_solid(name, np.array(scene.task.objects[name].size_m))
            for name in scene.movable()
        }
        self._table = _Placed(
            TABLE,
            coal.Halfspace(np.array([0.0, 0.0, 1.0]), scene.table_height_m),
            coal.Transform3s(),
        )
        self._add_panels(scene)
        self._standing = _standing_links(hulls)
        self._contacts: dict[tuple[str, str, bool], list[Contact]] = {}
        self._last_ns = 0

    def measure(
        self,
        t_ns: int,
        joints_rad: Float[np.ndarray, " num_joints"],
        width_m: float,
        Ts_base_object: Poses,
    ) -> float:
        """Return delta(x_t), the smallest distance over the pairs that may not touch [m].

        Args:
            t_ns: Time from the start of the trajectory; calls come in order.
            joints_rad: Where the arm is.
            width_m: Where the fingers are.
            Ts_base_object: Where the movable objects are; those not known are left out.
        """
        self.hulls.place(joints_rad, width_m)
        allowed = _allowed(active_stage(self.stages, t_ns))
        moved = [name for name, T in Ts_base_object.items() if self._has_moved(name, T)]
        solids = self._links + [self._objects[name] for name in moved]
        placements = self.hulls.placements + [_placement(Ts_base_object[name]) for name in moved]
        best = np.inf
        # Nearest bounds first: most pairs are then skipped, and the minimum stays exact.
        for bound, solid_id, other in self._candidates(solids, placements, Ts_base_object):
            if bound > max(best, self.config.eps_col_m):
                break
            solid, placement = solids[solid_id], placements[solid_id]
            distance = signed_distance(solid.shape, placement, other.shape, other.placement)
            best = min(best, self._judge(t_ns, solid.body, other.body, distance, allowed))
        self._last_ns = t_ns
        return float(best)

    def _candidates(
        self,
        solids: list[_Solid],
        placements: list[coal.Transform3s],
        Ts_base_object: Poses,
    ) -> list[tuple[float, int, _Placed]]:
        """Pairs with a lower bound of their distance, nearest first."""
        centres = np.stack(
            [
                placement.getRotation() @ solid.centre + placement.getTranslation()
                for solid, placement in zip(solids, placements, strict=True)
            ]
        )
        radii = np.array([solid.radius_m for solid in solids])
        pairs: list[tuple[float, int, _Placed]] = []
        heights = centres[:, 2] - radii - self._scene.table_height_m
        pairs += [
            (float(height), index, self._table)
            for index, height in enumerate(heights)
            if solids[index].body not in self._standing
        ]
        if self._panels:
            local = np.einsum("pij,sj->psi", self._R_panel_base, centres)
            outside = np.abs(local + self._p_panel_base[:, None]) - self._half_m[:, None]
            gaps = np.linalg.norm(np.maximum(outside, 0.0), axis=-1) - radii
            pairs += [
                (float(gaps[panel_id, index]), index, panel)
                for panel_id, panel in enumerate(self._panels)
                for index in range(len(solids))
            ]
        for name, T in Ts_base_object.items():
            solid = self._objects[name]
            placed = _Placed(name, solid.shape, _placement(T))
            offsets = centres[: len(self._links)] - se3.apply(T, solid.centre)
            gaps = np.linalg.norm(offsets, axis=1) - radii[: len(self._links)] - solid.radius_m
            pairs += [(float(gap), index, placed) for index, gap in enumerate(gaps)]
        return sorted(pairs, key=lambda pair: pair[0])

    def check_pre_grasp(
        self, t_ns: int, joints_rad: Float[np.ndarray, " num_joints"], width_m: float
    ) -> None:
        """Look for links inside objects that still lie where they were localised.

        Physics would push the object aside and hide that a finger comes down on it.
        """
        self.hulls.place(joints_rad, width_m)
        for index, link in enumerate(self._links):
            placement = self.hulls.placements[index]
            for name, T in self._scene.movable().items():
                solid = self._objects[name]
                if _gap(link, placement, solid, T) > 0:
                    continue
                distance = signed_distance(link.shape, placement, solid.shape, _placement(T))
                if distance < -self.config.pre_grasp_depth_m:
                    self._fail(t_ns, "pre_grasp_penetration", link.body, name, distance)

    def _add_panels(self, scene: ReplayScene) -> None:
        self._panels: list[_Placed] = []
        Ts_panel_base, half_m = [], []
        for name, T_base_object in scene.containers().items():
            for centre, extents in scene.task.objects[name].panels():
                T_object_panel = np.eye(4)
                T_object_panel[:3, 3] = centre
                T = T_base_object @ T_object_panel
                self._panels.append(_Placed(name, coal.Box(*extents), _placement(T)))
                Ts_panel_base.append(se3.invert(T))
                half_m.append(extents / 2)
        if self._panels:
            self._R_panel_base = np.stack(Ts_panel_base)[:, :3, :3]
            self._p_panel_base = np.stack(Ts_panel_base)[:, :3, 3]
            self._half_m = np.stack(half_m)

    def contacts(self) -> list[Contact]:
        """Stretches of time in which two bodies were closer than the margin."""
        collected = [contact for stretch in self._contacts.values() for contact in stretch]
        return sorted(collected, key=lambda contact: (contact.start_ns, contact.bodies))

    def _has_moved(self, name: str, T: Float[np.ndarray, "4 4"]) -> bool:
        start = self._scene.Ts_base_object[name]
        return bool(np.linalg.norm(T[:3, 3] - start[:3, 3]) > self.config.moved_m)

    def _judge(
        self, t_ns: int, body: str, other: str, distance: float, allowed: set[frozenset[str]]
    ) -> float:
        """Note a pair that is too close; returns its distance if the pair may not touch."""
        may_touch = frozenset((_group(body), other)) in allowed or (
            frozenset((body, other)) in allowed
        )
        if distance < self.config.eps_col_m:
            self._note(t_ns, (body, other), distance, may_touch)
        if may_touch:
            # An object that drops may lie deep for one step: the solver's doing, not the plan's.
            if distance < -self.config.max_contact_depth_m and body not in self._objects:
                self._fail(t_ns, "deep_contact", body, other, distance)
            return np.inf
        if distance < self.config.eps_col_m:
            self._fail(t_ns, "collision" if distance < 0 else "too_close", body, other, distance)
        return distance

    def _fail(self, t_ns: int, cause: str, body: str, other: str, distance: float) -> None:
        if any(failure.cause == cause for failure in self.failures):
            return
        where = f"{abs(distance) * 1e3:.1f} mm {'inside' if distance < 0 else 'from'} {other}"
        self.failures.append(
            Failure(
                t_ns=t_ns,
                cause=cause,
                bodies=(body, other),
                detail=f"{body} is {where}",
            )
        )

    def _note(self, t_ns: int, bodies: tuple[str, str], distance: float, may_touch: bool) -> None:
        stretches = self._contacts.setdefault((*bodies, may_touch), [])
        if stretches and stretches[-1].end_ns >= self._last_ns:
            last = stretches.pop()
            start, least = last.start_ns, min(last.min_distance_m, distance)
        else:
            start, least = t_ns, distance
        stretches.append(
            Contact(
                start_ns=start,
                end_ns=t_ns,
                bodies=bodies,
                allowed=may_touch,
                min_distance_m=least,
            )
        )


@lru_cache(maxsize=4)
def _standing_links(hulls: RobotHulls) -> frozenset[str]:
    """Links whose height no motion changes: the base, and a shoulder that turns about vertical.

    The robot stands on the table with them, so their distance to it says nothing of a plan.
    """
    rng = np.random.default_rng(0)
    lowest = []
    for _ in range(4):
        hulls.place(rng.uniform(-1.0, 1.0, len(hulls.robot.arm_ids)), 0.0)
        lowest.append(
            [
                (hull.points_m @ T.getRotation()[2] + T.getTranslation()[2]).min()
                for hull, T in zip(hulls.hulls, hulls.placements, strict=True)
            ]
        )
    still = np.ptp(np.array(lowest), axis=0) < 1e-9
    return frozenset(hull.link for hull, flag in zip(hulls.hulls, still, strict=True) if flag)


def active_stage(stages: tuple[Stage, ...], t_ns: int) -> Stage | None:
    """The last stage that has begun; before the first one begins, the first."""
    begun = [stage for stage in stages if stage.t_start_ns <= t_ns]
    if begun:
        return begun[-1]
    return stages[0] if stages else None


def _allowed(stage: Stage | None) -> set[frozenset[str]]:
    return set() if stage is None else {frozenset(pair) for pair in stage.allowed_contacts}


def _group(body: str) -> str:
    return GRIPPER if body in GRIPPER_LINKS else body


def _solid(
    body: str, shape: coal.CollisionGeometry, points_m: Float[np.ndarray, "num_points 3"]
) -> _Solid:
    centre = (points_m.min(axis=0) + points_m.max(axis=0)) / 2
    radius = float(np.linalg.norm(points_m - centre, axis=1).max())
    return _Solid(body, shape, centre, radius)


def _box_solid(body: str, size_m: Float[np.ndarray, "3"]) -> _Solid:
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * size_m
    return _solid(body, convex_hull(corners), corners)


def _placement(T: Float[np.ndarray, "4 4"]) -> coal.Transform3s:
    return coal.Transform3s(T[:3, :3], T[:3, 3])


def _gap(
    link: _Solid, placement: coal.Transform3s, solid: _Solid, T: Float[np.ndarray, "4 4"]
) -> float:
    """Lower bound of the distance of two pieces, from their bounding spheres."""
    centre = placement.getRotation() @ link.centre + placement.getTranslation()
    other = se3.apply(T, solid.centre)
    return float(np.linalg.norm(centre - other)) - link.radius_m - solid.radius_m
