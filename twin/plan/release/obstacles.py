"""What a carried object and the hand must stay away from, measured for many poses at once."""

from collections.abc import Collection

import numpy as np
from scipy.spatial import ConvexHull

from twin.plan.constrain.distances import Away, boxes_clearance, grid_clearance
from twin.plan.grasp.open_hand import open_hand
from twin.plan.grasp.search import PREGRASP_M
from twin.plan.problem import Points, Problem
from twin.replay.clearance.bodies import SCENE, TABLE, placed_panels
from twin.replay.clearance.surroundings import scene_grid
from twin.robot.collision import RobotHulls
from twin.robot.model import RobotModel

TABLE_SIDE_M = 20.0


def obstacles_of(problem: Problem, hulls: RobotHulls, carried: Collection[str]) -> dict[str, Away]:
    """Collect what stands still around carried objects; distances are never too large."""
    scene, T = problem.scene, np.eye(4)
    T[2, 3] = scene.table_height_m - TABLE_SIDE_M / 2
    found = {TABLE: boxes_clearance([(T, np.full(3, TABLE_SIDE_M))])}
    for name, T_base in scene.Ts_base_object.items():
        if name not in carried:
            found[name] = boxes_clearance([*placed_panels(problem.model(name), T_base)])
    if (grid := scene_grid(problem.scene, hulls)) is not None:
        error_m = float(np.sqrt(3) / 2 * grid.voxel_m)
        found[SCENE] = lambda points_m, Ts: grid_clearance(grid, points_m, Ts) - error_m
    return found


def hand_points(robot: RobotModel, width_m: float, num_points: int) -> Points:
    """Points of the hand's hulls in the tool's frame, with this width between the pads [m]."""
    pieces = open_hand(robot, width_m, PREGRASP_M).pieces
    return spread_points(np.concatenate([_dense(each.corners_m) for each in pieces]), num_points)


def _dense(corners_m: Points) -> Points:
    """Corners of a hull and points on its faces."""
    hull = ConvexHull(corners_m)
    a, b, c = (corners_m[hull.simplices[:, k]] for k in range(3))
    shares = [(i / 4, j / 4, (4 - i - j) / 4) for i in range(5) for j in range(5 - i)]
    return np.concatenate([i * a + j * b + k * c for i, j, k in shares])


def spread_points(points_m: Points, num_points: int) -> Points:
    """Choose points that are far from each other, each the farthest from those before it."""
    centre = points_m.mean(axis=0)
    index = int(np.argmax(np.linalg.norm(points_m - centre, axis=1)))
    away = np.full(len(points_m), np.inf)
    chosen: list[int] = []
    while len(chosen) < num_points and away[index] > 1e-9:
        chosen.append(index)
        away = np.minimum(away, np.linalg.norm(points_m - points_m[index], axis=1))
        index = int(np.argmax(away))
    return np.ascontiguousarray(points_m[chosen])
