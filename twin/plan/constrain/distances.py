"""How near a carried body comes to grids and boxes, for many poses that are proposed at once."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from twin.plan.problem import Numbers, Points, Pose, Poses, Problem, Vector
from twin.replay._clearance import surface_to_boxes, surface_to_grid
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


Away = Callable[[Points, Poses], Numbers]
"""Smallest signed distance of a body's surface points to something, for each pose [m]."""


def boxes_clearance(boxes: Sequence[tuple[Pose, Vector]]) -> Away:
    """Distances to boxes that stand still: pose ``T_base_box`` of the middle, and extents [m]."""
    R, centres_m = _poses(np.array([T for T, _ in boxes]))
    halves_m = np.array([extents for _, extents in boxes], dtype=np.float64) / 2

    def away(points_m: Points, Ts_base_body: Poses) -> Numbers:
        nearest = np.empty((len(Ts_base_body), len(R)))
        body = *_poses(Ts_base_body), np.ascontiguousarray(points_m)
        surface_to_boxes(R, centres_m, halves_m, *body, nearest)
        return np.asarray(nearest.min(axis=1))

    return away


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
