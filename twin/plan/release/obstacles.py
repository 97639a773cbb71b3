"""What a carried object and the hand must stay away from, measured for many poses at once."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from twin.plan.constrain.distances import Boxes, grid_clearance, lower_by_grid, scene_grid
from twin.plan.problem import Numbers, Points, Poses, Problem
from twin.replay.clearance.bodies import SCENE, TABLE, placed_panels
from twin.replay.clearance.distance_grid import GridLookup
from twin.replay.clearance.static_obstacles import PanelBox
from twin.robot.collision import RobotHulls

TABLE_SIDE_M = 20.0


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """One body that stands still: boxes, or the grid of what has no name."""

    name: str
    error_m: float
    """How far its surface may be off: distances are smaller by this."""
    boxes: tuple[PanelBox, ...] = ()
    grid: GridLookup | None = None


class Obstacles:
    """All bodies around, asked together."""

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        """Lay their boxes out in one list."""
        self.all = tuple(obstacles)
        self.names = tuple(obstacle.name for obstacle in self.all)
        self._boxes = Boxes.of([box for obstacle in self.all for box in obstacle.boxes])
        num_boxes = [len(obstacle.boxes) for obstacle in self.all]
        self._first = np.cumsum([0, *num_boxes])
        self._owner = np.repeat(np.arange(len(self.all)), num_boxes)
        self._error_m = np.array([obstacle.error_m for obstacle in self.all])

    def distances(
        self, points_m: Points, Ts_base_body: Poses
    ) -> Float[np.ndarray, "num_poses num_obstacles"]:
        """Least signed distance of a body's points to each obstacle, its error taken off [m]."""
        found = np.empty((len(Ts_base_body), len(self.all)))
        to_boxes = self._boxes.candidate_clearance(points_m, Ts_base_body)
        for index, obstacle in enumerate(self.all):
            if obstacle.grid is None:
                first, last = self._first[index : index + 2]
                found[:, index] = to_boxes[:, first:last].min(axis=1)
            else:
                found[:, index] = grid_clearance(obstacle.grid, points_m, Ts_base_body)
        return np.asarray(found - self._error_m)

    def margins(
        self, points_m: Points, Ts_base_body: Poses, keep_m: Numbers, *, most_m: float = np.inf
    ) -> Float[np.ndarray, "num_poses num_points"]:
        """How much farther each point is from what is around than it must be [m]."""
        found = np.full((len(Ts_base_body), len(points_m)), most_m)
        keep = keep_m + self._error_m
        self._boxes.lower(found, keep[self._owner], points_m, Ts_base_body)
        for index, obstacle in enumerate(self.all):
            if obstacle.grid is not None:
                lower_by_grid(obstacle.grid, found, float(keep[index]), points_m, Ts_base_body)
        return found


def obstacles_of(problem: Problem, hulls: RobotHulls, carried: Collection[str]) -> Obstacles:
    """Collect what stands still around carried objects."""
    scene = problem.scene
    found = [_table(scene.table_height_m)]
    for name, T in scene.Ts_base_object.items():
        if name in carried:
            continue
        boxes = tuple(placed_panels(problem.model(name), T))
        found.append(Obstacle(name=name, error_m=0.0, boxes=boxes))
    if (grid := scene_grid(problem, hulls)) is not None:
        error_m = float(np.sqrt(3) / 2 * grid.voxel_m)
        found.append(Obstacle(name=SCENE, error_m=error_m, grid=grid))
    return Obstacles(found)


def _table(height_m: float) -> Obstacle:
    T = np.eye(4)
    T[2, 3] = height_m - TABLE_SIDE_M / 2
    boxes = ((T, np.full(3, TABLE_SIDE_M)),)
    return Obstacle(name=TABLE, error_m=0.0, boxes=boxes)


def allowed_with(body: str, pairs: Collection[frozenset[str]], names: Sequence[str]) -> Numbers:
    """Whether a stage allows a body to touch each obstacle, as 1 or 0."""
    return np.array([frozenset((body, name)) in pairs for name in names], dtype=np.float64)


def hand_points(hulls: RobotHulls, width_m: float, num_points: int) -> Points:
    """Points of the hand's hulls in the tool's frame, with this width between the pads [m]."""
    robot = hulls.robot
    hulls.place(robot.home_rad, width_m)
    T_tcp_base = se3.invert(robot.T_base_link(robot.record.tool_frame, robot.home_rad, width_m))
    hulls.place(robot.home_rad, width_m)
    found = []
    for hull, R, t in zip(hulls.hulls, hulls.rotations, hulls.translations, strict=True):
        if hull.link in robot.record.gripper.links:
            found.append(se3.apply(T_tcp_base, _dense(hull.points_m) @ R.T + t))
    return spread_points(np.concatenate(found), num_points)


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
