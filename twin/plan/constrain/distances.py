"""How near a carried body comes to grids and boxes, for many poses that are proposed at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from twin.plan.problem import Numbers, Points, Pose, Poses, Problem, Vector
from twin.replay._clearance import (
    points_to_boxes,
    points_to_grid,
    surface_to_boxes,
    surface_to_grid,
)
from twin.replay.clearance.bodies import placed_panels
from twin.replay.clearance.distance_grid import GridLookup
from twin.replay.clearance.static_obstacles import stationary_links, unmodelled_obstacles
from twin.robot.collision import RobotHulls


def grid_clearance(lookup: GridLookup, points_m: Points, Ts_grid_body: Poses) -> Numbers:
    """Smallest signed distance of a body's surface points to what a grid holds, for each pose."""
    nearest = np.empty(len(Ts_grid_body))
    grid = lookup.values_m, lookup.origin_m, lookup.voxel_m
    surface_to_grid(*grid, *_poses(Ts_grid_body), np.ascontiguousarray(points_m), nearest)
    return nearest


@dataclass(frozen=True, kw_only=True)
class Boxes:
    """Boxes that stand still, as the native loops want them."""

    R: Float[np.ndarray, "num_boxes 3 3"]
    """Rotations ``R_base_box``."""
    centres_m: Points
    """In the base frame."""
    halves_m: Points

    @staticmethod
    def of(boxes: Sequence[tuple[Pose, Vector]]) -> "Boxes":
        """Lay them out: pose ``T_base_box`` of the middle, and extents [m]."""
        R, centres_m = _poses(np.array([T for T, _ in boxes]).reshape(-1, 4, 4))
        extents = np.array([extents for _, extents in boxes], dtype=np.float64)
        return Boxes(R=R, centres_m=centres_m, halves_m=extents.reshape(-1, 3) / 2)

    def candidate_clearance(
        self, points_m: Points, Ts_base_body: Poses
    ) -> Float[np.ndarray, "num_candidates num_boxes"]:
        """Smallest signed distance of a body's surface points to each box, for each pose [m]."""
        nearest = np.empty((len(Ts_base_body), len(self.R)))
        body = *_poses(Ts_base_body), np.ascontiguousarray(points_m)
        surface_to_boxes(self.R, self.centres_m, self.halves_m, *body, nearest)
        return nearest

    def lower(
        self,
        margins_m: Float[np.ndarray, "num_candidates num_points"],
        keep_m: Numbers,
        points_m: Points,
        Ts_base_body: Poses,
    ) -> None:
        """Lower each point's margin to its distance to the boxes less what is to be kept.

        Args:
            margins_m: Overwritten; one value everywhere at first, boxes beyond it do not count.
        """
        most = float(margins_m.max(initial=-np.inf))
        body = *_poses(Ts_base_body), np.ascontiguousarray(points_m)
        points_to_boxes(self.R, self.centres_m, self.halves_m, keep_m, most, *body, margins_m)


def lower_by_grid(
    lookup: GridLookup,
    margins_m: Float[np.ndarray, "num_candidates num_points"],
    keep_m: float,
    points_m: Points,
    Ts_grid_body: Poses,
) -> None:
    """Lower each point's margin to its distance to a grid less what is to be kept."""
    grid = lookup.values_m, lookup.origin_m, lookup.voxel_m
    body = *_poses(Ts_grid_body), np.ascontiguousarray(points_m)
    points_to_grid(*grid, keep_m, *body, margins_m)


def scene_grid(problem: Problem, hulls: RobotHulls) -> GridLookup | None:
    """Distances to what has no name in a scene: all but table, containers and the robot's foot."""
    scene = problem.scene
    if scene.static_sdf is None:
        return None
    _, foot = stationary_links(hulls)
    panels = [
        panel
        for name, T in scene.containers().items()
        for panel in placed_panels(problem.model(name), T)
    ]
    grid = unmodelled_obstacles(scene.static_sdf, scene.table_height_m, foot, panels)
    return None if grid is None else GridLookup(grid)


def _poses(Ts: Poses) -> tuple[Float[np.ndarray, "num_poses 3 3"], Points]:
    """Rotations and origins, each in one piece of memory."""
    return np.ascontiguousarray(Ts[:, :3, :3]), np.ascontiguousarray(Ts[:, :3, 3])
