"""What stands still around the robot, and how far placed pieces are from it and from objects."""

from collections.abc import Callable, Mapping
from functools import lru_cache

import coal
import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.box import box_corners
from twin.replay.clearance.bodies import (
    SCENE,
    TABLE,
    Placed,
    Solid,
    placed_panels,
    placement_of,
    solid_of,
)
from twin.replay.clearance.grid import GridLookup
from twin.replay.clearance.nodes import distances_to_boxes_m, planes_of
from twin.replay.clearance.shells import Shells, shell_of, shells_of_robot
from twin.replay.clearance.unnamed import Foot, unnamed_scene
from twin.replay.place.scene import ReplayScene
from twin.robot.collision import RobotHulls, signed_distance

Pair = tuple[str, int, str, int]
"""A body and which of the robot's hulls it is (-1: an object), the other body and its piece."""

_STILL_M = 1e-9
_SAMPLES = 4


class Surroundings:
    """Table, container panels and the unnamed rest of the scene."""

    def __init__(self, scene: ReplayScene, hulls: RobotHulls, eps_m: float) -> None:
        """Place the panels and take what has a name out of the scene's grid.

        Args:
            scene: Table height, containers and the static scene.
            hulls: The robot.
            eps_m: Pairs closer than this are always measured.
        """
        self._hulls = hulls
        self._eps_m = eps_m
        self._table_height_m = scene.table_height_m
        half_space = coal.Halfspace(np.array([0.0, 0.0, 1.0]), scene.table_height_m)
        self._table = Placed(TABLE, half_space, coal.Transform3s())
        self._panels = [
            (name, piece, panel)
            for name, T in scene.containers().items()
            for piece, panel in enumerate(placed_panels(scene.task.objects[name], T))
        ]
        self._placed = [
            Placed(name, coal.Box(*extents), placement_of(T), piece)
            for name, piece, (T, extents) in self._panels
        ]
        if self._panels:
            Ts_panel_base = np.stack([se3.invert(T) for _, _, (T, _) in self._panels])
            self._R_panel_base, self._p_panel_base = (
                Ts_panel_base[:, :3, :3],
                Ts_panel_base[:, :3, 3],
            )
            self._half_m = np.stack([extents / 2 for _, _, (_, extents) in self._panels])
        standing, foot = standing_links(hulls)
        self._mobile = [i for i, hull in enumerate(hulls.hulls) if hull.link not in standing]
        solids = [solid_of(hull.link, hull.shape, hull.points_m) for hull in hulls.hulls]
        self._centres = np.stack([solid.centre for solid in solids])
        self._radii = np.array([solid.radius_m for solid in solids])
        self.links = solids
        self.lookup: GridLookup | None = None
        if scene.static_sdf is not None:
            panels = [panel for _, _, panel in self._panels]
            grid = unnamed_scene(scene.static_sdf, scene.table_height_m, foot, panels)
            self.lookup = None if grid is None else GridLookup(grid)
        self._shells: Shells | None = None
        self._object_shells: dict[str, Shells] = {}
        if self.lookup is not None:
            self._shells = shells_of_robot(hulls, standing)
            self._object_shells = {
                name: _box_shell(scene.task.objects[name].size_m)
                for name in scene.movable()
                if scene.task.objects[name].soft is None
            }

    def measure(
        self,
        solids: list[Solid],
        Ts_base_moved: list[Float[np.ndarray, "4 4"]],
        objects: Mapping[str, tuple[Solid, Float[np.ndarray, "4 4"]]],
        *,
        near_m: float,
        counts: Callable[[str, str], bool],
    ) -> tuple[dict[Pair, float], float]:
        """Measure the nearest pairs.

        Args:
            solids: The robot's hulls, placed by ``RobotHulls.place``, then moved objects.
            Ts_base_moved: Poses of the moved objects.
            objects: What the robot is measured against.
            near_m: Pairs closer than this are all measured.
            counts: Whether a pair's distance counts for the smallest one.

        Returns:
            Distances [m], and one that all other pairs keep.
        """
        num_links = len(self._hulls.hulls)
        placements = self._hulls.placements + [placement_of(T) for T in Ts_base_moved]
        R, t = self._hulls.rotations, self._hulls.translations
        if Ts_base_moved:
            Ts = np.stack(Ts_base_moved)
            R, t = np.concatenate([R, Ts[:, :3, :3]]), np.concatenate([t, Ts[:, :3, 3]])
        found = self._to_scene(solids[num_links:], R, t)
        best = min(
            (d for (body, _, other, _), d in found.items() if counts(body, other)), default=np.inf
        )
        # Nearest bounds first: most pairs are then skipped, and the minimum stays exact.
        for bound, index, other in self._candidates(solids, R, t, objects):
            if bound > max(best, near_m):
                return found, max(best, near_m)
            solid = solids[index]
            distance = signed_distance(solid.shape, placements[index], other.shape, other.placement)
            piece = index if index < num_links else -1
            found[solid.body, piece, other.body, other.piece] = distance
            if counts(solid.body, other.body):
                best = min(best, distance)
        return found, np.inf

    def measure_nodes(
        self,
        links: list[Solid],
        nodes_m: Mapping[str, Float[np.ndarray, "num_nodes 3"]],
        moved_m: Mapping[str, Float[np.ndarray, "num_nodes 3"]],
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
                    planes = planes_of(self._hulls)[index]
                    found[link.body, index, name, 0] = planes.distance_m(nodes, R, t)
                else:
                    found[link.body, index, name, 0] = gap
        for name, nodes in moved_m.items():
            found[name, -1, TABLE, 0] = float(nodes[:, 2].min()) - self._table_height_m
            if self._panels:
                panels = self._R_panel_base, self._p_panel_base, self._half_m
                distances = distances_to_boxes_m(nodes, *panels).tolist()
                for (container, piece, _), distance in zip(self._panels, distances, strict=True):
                    found[name, -1, container, piece] = distance
            if self.lookup is not None:
                found[name, -1, SCENE, 0] = float(self.lookup.distance(nodes).min())
        return found

    def _to_scene(
        self,
        moved: list[Solid],
        R: Float[np.ndarray, "num_solids 3 3"],
        t: Float[np.ndarray, "num_solids 3"],
    ) -> dict[Pair, float]:
        """Distances to the unnamed scene: of every link that moves, and of moved objects."""
        if self.lookup is None or self._shells is None:
            return {}
        links = self._shells.distances_m(self.lookup, R[self._mobile], t[self._mobile])
        found: dict[Pair, float] = {
            (self.links[index].body, index, SCENE, 0): distance
            for index, distance in zip(self._mobile, links.tolist(), strict=True)
        }
        start = len(self.links)
        for index, solid in enumerate(moved, start=start):
            shell = self._object_shells.get(solid.body)
            if shell is not None:
                one = slice(index, index + 1)
                distance = shell.distances_m(self.lookup, R[one], t[one])[0]
                found[solid.body, -1, SCENE, 0] = float(distance)
        return found

    def _candidates(
        self,
        solids: list[Solid],
        R: Float[np.ndarray, "num_solids 3 3"],
        t: Float[np.ndarray, "num_solids 3"],
        objects: Mapping[str, tuple[Solid, Float[np.ndarray, "4 4"]]],
    ) -> list[tuple[float, int, Placed]]:
        """Pairs with a lower bound of their distance, nearest first."""
        num_links = len(self._hulls.hulls)
        own, radii = self._centres, self._radii
        if len(solids) > num_links:
            own = np.concatenate([own, [solid.centre for solid in solids[num_links:]]])
            radii = np.concatenate([radii, [solid.radius_m for solid in solids[num_links:]]])
        centres = np.matmul(R, own[:, :, None])[:, :, 0] + t
        pairs: list[tuple[float, int, Placed]] = []
        mobile = [*self._mobile, *range(num_links, len(solids))]
        heights = (centres[:, 2] - radii - self._table_height_m).tolist()
        pairs += [(heights[index], index, self._table) for index in mobile]
        if self._panels:
            local = np.einsum("pij,sj->psi", self._R_panel_base, centres)
            outside = np.abs(local + self._p_panel_base[:, None]) - self._half_m[:, None]
            gaps = np.linalg.norm(np.maximum(outside, 0.0), axis=-1) - radii
            pairs += [
                (gap, index, panel)
                for row, panel in zip(gaps.tolist(), self._placed, strict=True)
                for index, gap in enumerate(row)
            ]
        for name, (solid, T) in objects.items():
            placed = Placed(name, solid.shape, placement_of(T))
            offsets = centres[:num_links] - se3.apply(T, solid.centre)
            gaps = np.linalg.norm(offsets, axis=1) - radii[:num_links] - solid.radius_m
            pairs += [(gap, index, placed) for index, gap in enumerate(gaps.tolist())]
        return sorted(pairs, key=lambda pair: pair[0])


@lru_cache(maxsize=32)
def _box_shell(size_m: tuple[float, float, float]) -> Shells:
    return Shells([shell_of(box_corners(np.array(size_m)))])


@lru_cache(maxsize=4)
def standing_links(hulls: RobotHulls) -> tuple[frozenset[str], Foot | None]:
    """Links whose height no motion changes: the base, and a shoulder that turns about vertical.

    The robot stands on the table with them, so their distance to it says nothing of a plan. With
    them the cylinder about the base's z axis that holds them.
    """
    rng = np.random.default_rng(0)
    corners = []
    for _ in range(_SAMPLES):
        hulls.place(rng.uniform(-1.0, 1.0, len(hulls.robot.arm_ids)), 0.0)
        corners.append(
            [
                hull.points_m @ R.T + t
                for hull, R, t in zip(hulls.hulls, hulls.rotations, hulls.translations, strict=True)
            ]
        )
    lowest = np.array([[points[:, 2].min() for points in posture] for posture in corners])
    still = np.flatnonzero(np.ptp(lowest, axis=0) < _STILL_M)
    if not len(still):
        return frozenset(), None
    held = np.concatenate([posture[index] for posture in corners for index in still])
    foot = Foot(
        radius_m=float(np.hypot(held[:, 0], held[:, 1]).max()), top_m=float(held[:, 2].max())
    )
    return frozenset(hulls.hulls[index].link for index in still), foot
