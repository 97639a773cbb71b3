"""What stands still around the robot, and how far placed pieces are from it and from objects."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import coal
import numpy as np
from jaxtyping import Float

from bridge.geometry.mesh import box_corners
from twin.replay.clearance import bodies as geometry
from twin.replay.clearance.bounding_spheres import (
    BoundingSpheres,
    bounding_spheres_of,
    grid_distances_m,
    robot_bounding_spheres,
)
from twin.replay.clearance.static_obstacles import (
    static_obstacles,
    stationary_links,
    unmodelled_obstacles,
)
from twin.replay.config import ReplayConfig
from twin.replay.scene import ReplayScene
from twin.robot.collision import RobotHulls, signed_distance
from twin.scene.shape.sdf import SdfGrid

Pair = tuple[str, int, str, int]
"""A body and which of the robot's hulls it is (-1: an object), the other body and its piece."""

Poses = Mapping[str, Float[np.ndarray, "4 4"]]


@dataclass(frozen=True, kw_only=True)
class _Pairing:
    """The pairs that are measured while the same objects are known and have moved."""

    near: geometry.NearPairs
    names: list[Pair]
    bodies: list[tuple[int, int]]
    """Two of the links, the objects and what stands, in this order."""
    shapes: list[coal.CollisionGeometry]
    placements: list[coal.Transform3s | None]
    """Of what stands; None where something may move."""


def scene_grid(scene: ReplayScene, hulls: RobotHulls) -> SdfGrid | None:
    """Distances to what has no name in a scene: all but table, containers and the robot's foot."""
    if scene.static_sdf is None:
        return None
    _, foot = stationary_links(hulls)
    panels = [
        panel
        for name, T in scene.containers().items()
        for panel in geometry.placed_panels(scene.task.objects[name], T)
    ]
    return unmodelled_obstacles(scene.static_sdf, scene.table_height_m, foot, panels)


class Surroundings:
    """Table, container panels and the unnamed rest of the scene."""

    def __init__(self, scene: ReplayScene, hulls: RobotHulls, eps_m: float) -> None:
        """Place the panels and take what has a name out of the scene's grid."""
        self._hulls = hulls
        self._eps_m = eps_m
        self._table_height_m = scene.table_height_m
        self._panels = [
            (name, piece, panel)
            for name, T in scene.containers().items()
            for piece, panel in enumerate(geometry.placed_panels(scene.task.objects[name], T))
        ]
        self.static = static_obstacles(self._panels, scene.table_height_m)
        self._pairings: dict[tuple[tuple[str, ...], tuple[str, ...]], _Pairing] = {}
        stationary, _ = stationary_links(hulls)
        self._mobile = [i for i, hull in enumerate(hulls.hulls) if hull.link not in stationary]
        self.links = [
            geometry.solid_of(hull.link, hull.shape, hull.points_m) for hull in hulls.hulls
        ]
        self.objects = {
            name: geometry.box_solid(name, np.array(scene.task.objects[name].size_m))
            for name in scene.movable()
        }
        self.grid = scene_grid(scene, hulls)
        self._link_spheres: BoundingSpheres | None = None
        self._object_spheres: dict[str, BoundingSpheres] = {}
        if self.grid is not None:
            self._link_spheres = robot_bounding_spheres(hulls, stationary)
            self._object_spheres = {
                name: _box_spheres(scene.task.objects[name].size_m)
                for name in scene.movable()
                if scene.task.objects[name].soft is None
            }

    def measure(
        self,
        Ts_base_object: Poses,
        moved: Sequence[str],
        *,
        near_m: float,
        counts: Callable[[str, str], bool],
    ) -> tuple[dict[Pair, float], float]:
        """Distances of a placed robot's nearest pairs [m], and one that all other pairs keep."""
        pairing = self._pairing(tuple(Ts_base_object), tuple(moved))
        links, near = self._hulls, pairing.near
        num_links = len(self.links)
        near.R[:num_links], near.t[:num_links] = links.rotations, links.translations
        for index, T in enumerate(Ts_base_object.values(), start=num_links):
            near.R[index], near.t[index] = T[:3, :3], T[:3, 3]
        found = self._to_scene(moved, Ts_base_object)
        best = min(
            (d for (body, _, other, _), d in found.items() if counts(body, other)), default=np.inf
        )
        first = num_links + len(Ts_base_object)
        shapes, placements = pairing.shapes, list(pairing.placements)

        def placed(index: int) -> coal.Transform3s:
            if index < num_links:
                return links.placement(index)
            if index < first and placements[index] is None:
                placements[index] = coal.Transform3s(near.R[index], near.t[index])
            return placements[index]

        # Nearest bounds first: most pairs are then skipped, and the minimum stays exact.
        for bound, number in near.nearest_first():
            if bound > max(best, near_m):
                return found, max(best, near_m)
            one, other = pairing.bodies[number]
            pair = pairing.names[number]
            distance = signed_distance(shapes[one], placed(one), shapes[other], placed(other))
            found[pair] = distance
            if distance < best and counts(pair[0], pair[2]):
                best = distance
        return found, np.inf

    def least_m(self, left_out: frozenset[str]) -> float:
        """Smallest distance of placed links, but for some, to what stands still [m]."""
        found, beyond_m = self.measure(
            {}, (), near_m=0.0, counts=lambda body, _: body not in left_out
        )
        return min((d for (body, *_), d in found.items() if body not in left_out), default=beyond_m)

    def _pairing(self, known: tuple[str, ...], moved: tuple[str, ...]) -> _Pairing:
        """Links and moved objects against what stands, then links against objects."""
        pairing = self._pairings.get((known, moved))
        if pairing is not None:
            return pairing
        num_links = len(self.links)
        first = num_links + len(known)  # what stands comes behind the objects
        movers = [num_links + known.index(name) for name in moved]
        solids = [
            *self.links,
            *(self.objects[name] for name in known),
            *(solid for solid, _, _ in self.static),
        ]
        names: list[Pair] = []
        bodies: list[tuple[int, int]] = []
        for other, (solid, number, _) in enumerate(self.static, start=first):
            links = self._mobile if solid.body == geometry.TABLE else range(num_links)
            for index in (*links, *movers):
                piece = index if index < num_links else -1
                names.append((solids[index].body, piece, solid.body, number))
                bodies.append((index, other))
        for other, name in enumerate(known, start=num_links):
            names += [(link.body, index, name, 0) for index, link in enumerate(self.links)]
            bodies += [(index, other) for index in range(num_links)]
        near = geometry.NearPairs(solids, bodies)
        for index, (_, _, T) in enumerate(self.static, start=first):
            near.R[index], near.t[index] = T[:3, :3], T[:3, 3]
        pairing = _Pairing(
            near=near,
            names=names,
            bodies=bodies,
            shapes=[solid.shape for solid in solids],
            placements=[None] * first + [geometry.placement_of(T) for _, _, T in self.static],
        )
        self._pairings[known, moved] = pairing
        return pairing

    def measure_nodes(
        self,
        links: list[geometry.Solid],  # in the order of the robot's hulls, which are placed already
        nodes_m: Mapping[str, Float[np.ndarray, "num_nodes 3"]],  # base frame
        moved_m: Mapping[str, Float[np.ndarray, "num_nodes 3"]],  # that left where they rested
    ) -> dict[Pair, float]:
        """Measure soft bodies: the near links against all, what stands still against moved ones."""
        found: dict[Pair, float] = {}
        for name, nodes in nodes_m.items():
            centre = (nodes.min(axis=0) + nodes.max(axis=0)) / 2
            radius = float(np.linalg.norm(nodes - centre, axis=1).max())
            for index, link in enumerate(links):
                R, t = self._hulls.rotations[index], self._hulls.translations[index]
                gap = float(np.linalg.norm(R @ link.centre + t - centre)) - radius - link.radius_m
                if gap < self._eps_m:
                    gap = geometry.distance_to_planes_m(
                        geometry.planes_of(self._hulls)[index], nodes, R, t
                    )
                found[link.body, index, name, 0] = gap
        for name, nodes in moved_m.items():
            found[name, -1, geometry.TABLE, 0] = float(nodes[:, 2].min()) - self._table_height_m
            distances = geometry.distances_to_boxes_m(
                nodes, [panel for _, _, panel in self._panels]
            )
            for (container, piece, _), distance in zip(self._panels, distances, strict=True):
                found[name, -1, container, piece] = float(distance)
            if self.grid is not None:
                found[name, -1, geometry.SCENE, 0] = float(grid_distances_m(self.grid, nodes).min())
        return found

    def _to_scene(self, moved: Sequence[str], Ts_base_object: Poses) -> dict[Pair, float]:
        """Distances to the unmodelled scene: of every link that moves, and of moved objects."""
        if self.grid is None or self._link_spheres is None:
            return {}
        R, t = self._hulls.rotations, self._hulls.translations
        links = self._link_spheres.distances_m(self.grid, R[self._mobile], t[self._mobile])
        found: dict[Pair, float] = {
            (self.links[index].body, index, geometry.SCENE, 0): distance
            for index, distance in zip(self._mobile, links.tolist(), strict=True)
        }
        for name in moved:
            spheres = self._object_spheres.get(name)
            if spheres is not None:
                T = Ts_base_object[name][None]
                R, t = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
                found[name, -1, geometry.SCENE, 0] = float(spheres.distances_m(self.grid, R, t)[0])
        return found


@lru_cache(maxsize=32)
def _box_spheres(size_m: tuple[float, float, float]) -> BoundingSpheres:
    return BoundingSpheres([bounding_spheres_of(box_corners(np.array(size_m)))])


def posture_clearance(
    scene: ReplayScene, hulls: RobotHulls, config: ReplayConfig
) -> Callable[[Float[np.ndarray, "num_postures num_joints"]], Float[np.ndarray, " num_postures"]]:
    """Return a function that says how far postures stay from contact: negative when links touch.

    The arm against itself and against what stands still, with ``eps_col_m`` taken off. The gripper
    is where the path says, whatever the arm does, so it is left out; so are objects. It moves the
    hulls.
    """
    around = Surroundings(scene, hulls, config.eps_col_m)
    links_touch, gripper = geometry.own_links_touch(hulls), hulls.robot.record.gripper
    hand = frozenset(gripper.links)

    def one(joints_rad: Float[np.ndarray, " num_joints"]) -> float:
        hulls.place(joints_rad, gripper.max_width_m)
        if links_touch():
            return hulls.self_distance()[0]
        return around.least_m(hand) - config.eps_col_m

    return lambda joints_rad: np.array([one(row) for row in joints_rad])
