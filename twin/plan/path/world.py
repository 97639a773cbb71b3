"""The arm, what it carries and what stands around it, as the native search wants them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from twin.plan.path._motion import Motion
from twin.plan.problem import Flags, Numbers, Points, Pose, Poses, Problem, Spheres, Vector
from twin.replay.clearance.bodies import SCENE, TABLE, names_of, placed_panels
from twin.replay.clearance.bounding_spheres import (
    ARM_FINE_M,
    FINE_M,
    BoundingSphereTree,
    bounding_spheres_of,
)
from twin.replay.clearance.monitor import Allowed
from twin.replay.clearance.static_obstacles import stationary_links
from twin.replay.clearance.surroundings import scene_grid
from twin.robot.collision import RobotHulls, hulls_of
from twin.robot.model import RobotModel
from twin.scene.shape.sdf import SdfGrid

SPARE_M = 0.0003
"""A path keeps this much more than was asked: what the search may overlook is less."""
BOX, PLANE, GRID, BODY = range(4)

SPHERES = 16
"""For each hull of a link or box that is carried."""
_GROWN = 1 + 1e-9
"""So that rounding leaves no corner outside."""
_PROBES = 64

Names = tuple[str, str]


@dataclass(frozen=True, kw_only=True)
class Carried:
    """An object in the hand."""

    object_id: str
    T_tcp_object: Pose


@dataclass(frozen=True, kw_only=True)
class Chain:
    """The arm's joints one after the other, and its hulls in their frames, at one gripper width."""

    placements: Poses
    """Each joint's frame in that of the one before, at 0."""
    axes: Points
    slides: Flags
    T_last_tcp: Pose
    joint_of: tuple[int, ...]
    """For each hull: how many joints move it."""
    Ts_joint_hull: Poses


def chain_of(hulls: RobotHulls, width_m: float) -> Chain:
    """Read an arm's joints off pinocchio, its fingers held at an opening."""
    robot = hulls.robot
    model, data = robot.model, robot.data
    zero = np.zeros(len(robot.joints))
    q = robot.configuration(zero, width_m)
    ids = [int(model.getJointId(name)) for name in robot.joints]
    pin.computeJointJacobians(model, data, q)
    frames = [np.eye(4)] + [np.array(data.oMi[joint].homogeneous) for joint in ids]
    axes, slides = [], []
    for joint in ids:
        column = pin.getJointJacobian(model, data, joint, pin.LOCAL)[:, model.joints[joint].idx_v]
        turning = bool(np.linalg.norm(column[3:]) > 0.5)
        axes.append(column[3:] if turning else column[:3])
        slides.append(not turning)
    hulls.place(zero, width_m)
    joint_of, Ts = [], []
    for hull, R, t in zip(hulls.hulls, hulls.rotations, hulls.translations, strict=True):
        joint = int(model.frames[robot.frame_id(hull.link)].parentJoint)
        while joint and joint not in ids:
            joint = int(model.parents[joint])
        number = ids.index(joint) + 1 if joint else 0
        joint_of.append(number)
        Ts.append(se3.invert(frames[number]) @ se3.from_rotation(R, t))
    return Chain(
        placements=np.stack([se3.invert(before) @ own for before, own in pairwise(frames)]),
        axes=np.array(axes),
        slides=np.array(slides),
        T_last_tcp=se3.invert(frames[-1]) @ robot.T_base_tcp(zero),
        joint_of=tuple(joint_of),
        Ts_joint_hull=np.stack(Ts),
    )


def covering_spheres(corners_m: Points, count: int = SPHERES) -> Spheres:
    """Cover a convex hull: the box along its axes, its longest cells halved, a sphere for each."""
    middle = corners_m.mean(axis=0)
    axes = np.linalg.svd(corners_m - middle, full_matrices=True)[2]
    along = (corners_m - middle) @ axes.T
    low, extents = along.min(axis=0), np.ptp(along, axis=0)
    cells = np.ones(3, dtype=np.int64)
    while 2 * cells.prod() <= count:
        cells[int(np.argmax(extents / cells))] *= 2
    size = extents / cells
    numbers = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).reshape(-1, 3)
    centres = middle + (low + (numbers + 0.5) * size) @ axes
    radius = np.full((len(centres), 1), np.linalg.norm(size) / 2 * _GROWN)
    return np.concatenate([centres, radius], axis=1)


def excess_m(corners_m: Points, spheres_m: Spheres) -> float:
    """How far spheres stand out of the hull of points at most [m], looked at in some directions."""
    equations = ConvexHull(corners_m).equations
    normals, offsets = equations[:, :3], equations[:, 3]
    turns = np.random.default_rng(0).normal(size=(_PROBES, 3))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    tips = spheres_m[:, None, :3] + spheres_m[:, 3, None, None] * turns
    outside = (tips.reshape(-1, 3) @ normals.T + offsets).max(axis=1)
    return float(max(0.0, outside.max()))


@lru_cache(maxsize=4)
def _link_spheres(hulls: RobotHulls) -> list[tuple[Spheres, float]]:
    """Spheres of each hull in its own frame, and how far they stand out; once for a robot."""
    fitted = [covering_spheres(hull.points_m) for hull in hulls.hulls]
    return [(s, excess_m(hull.points_m, s)) for hull, s in zip(hulls.hulls, fitted, strict=True)]


@lru_cache(maxsize=4)
def _link_trees(hulls: RobotHulls) -> tuple[BoundingSphereTree, ...]:
    """What grids are asked about, for each hull."""
    gripper = hulls.robot.record.gripper.links
    return tuple(
        bounding_spheres_of(hull.points_m, FINE_M if hull.link in gripper else ARM_FINE_M)
        for hull in hulls.hulls
    )


@dataclass(frozen=True, kw_only=True)
class World:
    """A native world, and what its numbers mean."""

    motion: Motion
    names: list[Names]
    robot: RobotModel
    limits_m: list[float]


def _add_pairs(
    motion: Motion,
    hulls: RobotHulls,
    boxes: list[str],
    carried: Carried | None,
    *,
    has_grid: bool,
    eps_m: float,
    allowed: Allowed,
    wider_m: Mapping[frozenset[str], float],
) -> tuple[list[Names], list[float]]:
    """Add the pairs that are kept apart; return their names, and how far."""
    names: list[Names] = []
    limits_m: list[float] = []

    def pair(body: int, kind: int, other: int, named: Names, least_m: float = eps_m) -> None:
        """Add one, unless it may touch: what was refused before may not."""
        more = wider_m.get(frozenset(named))
        known = names_of(named[0], hulls.robot.record.gripper)
        if more is None and any(frozenset((name, named[1])) in allowed for name in known):
            return
        limits_m.append(least_m + SPARE_M + (more or 0.0))
        motion.add_pair(body, kind, other, limits_m[-1])
        names.append(named)

    stationary, _ = stationary_links(hulls)
    links = [hull.link for hull in hulls.hulls]
    held = [] if carried is None else [carried.object_id]
    for body, name in enumerate([*links, *held]):
        for number, other in enumerate(boxes):
            pair(body, BOX, number, (name, other))
        if name not in stationary:
            pair(body, PLANE, 0, (name, TABLE))
            if has_grid:
                pair(body, GRID, 0, (name, SCENE))
    for one, two in hulls.pairs:
        pair(one, BODY, two, (links[one], links[two]), 0.0)
    for name in held:  # those links that do not hold it
        for index, link in enumerate(links):
            pair(len(links), BODY, index, (link, name))
    return names, limits_m


def _placed_spheres(T: Pose, spheres_m: Spheres) -> Spheres:
    return np.column_stack([se3.apply(T, spheres_m[:, :3]), spheres_m[:, 3]])


def build_world(
    problem: Problem,
    *,
    width_m: float,
    eps_col_m: float,
    carried: Carried | None = None,
    allowed: Allowed = frozenset(),
    wider_m: Mapping[frozenset[str], float] | None = None,
) -> World:
    """Fill a native world with an arm, what it carries and what is around it.

    Pairs that may touch are left to the monitor; what a check refused before keeps more.
    """
    robot = problem.robot
    hulls = hulls_of(robot)
    chain = chain_of(hulls, width_m)
    motion = Motion(
        chain.placements,
        chain.axes,
        chain.slides,
        robot.lower_rad,
        robot.upper_rad,
        chain.T_last_tcp[:3, 3],
    )
    obstacles = _obstacles(problem, carried)
    grid = scene_grid(problem.scene, hulls)
    points = _add_bodies(problem, hulls, chain, motion, carried, grid)
    if grid is not None:
        _set_grid(motion, grid, points)
    motion.set_table(problem.scene.table_height_m)
    for _, T, size in obstacles:
        motion.add_box(T, np.asarray(size, dtype=np.float64) / 2)
    names, limits_m = _add_pairs(
        motion,
        hulls,
        [name for name, *_ in obstacles],
        carried,
        has_grid=grid is not None,
        eps_m=eps_col_m,
        allowed=allowed,
        wider_m=wider_m or {},
    )
    motion.prepare()
    return World(motion=motion, names=names, robot=robot, limits_m=limits_m)


PlacedBox = tuple[str, Pose, Vector]
"""Its name, ``T_base_box`` and extents [m]."""


def _obstacles(problem: Problem, carried: Carried | None) -> list[PlacedBox]:
    """Panels of what stands still, and a box for each other object."""
    scene = problem.scene
    found: list[PlacedBox] = [
        (name, T_base_panel, extents)
        for name, T in scene.containers().items()
        for T_base_panel, extents in placed_panels(scene.task.objects[name], T)
    ]
    found += [
        (name, T, np.array(scene.task.objects[name].size_m))
        for name, T in scene.movable().items()
        if carried is None or name != carried.object_id
    ]
    return found


@dataclass
class _Points:
    """Trees of points behind each other."""

    points: list[Points] = field(default_factory=list)
    radii: list[Numbers] = field(default_factory=list)
    children: list[np.ndarray] = field(default_factory=list)
    count: int = 0

    def add(self, tree: BoundingSphereTree, T: Pose) -> tuple[int, int]:
        """Put a tree behind the others; where its roots begin and end."""
        begin = self.count
        self.points.append(se3.apply(T, tree.points_m))
        self.radii.append(tree.radius_m)
        self.children.append(tree.children + begin)
        self.count += len(tree.points_m)
        return begin, begin + tree.num_roots


def _add_bodies(
    problem: Problem,
    hulls: RobotHulls,
    chain: Chain,
    motion: Motion,
    carried: Carried | None,
    grid: SdfGrid | None,
) -> _Points:
    """Add the links, then what is carried."""
    points, trees = _Points(), [None] * len(hulls.hulls) if grid is None else _link_trees(hulls)
    corners = [hull.points_m for hull in hulls.hulls]
    fitted = _link_spheres(hulls)
    bodies = [*zip(chain.joint_of, chain.Ts_joint_hull, corners, fitted, trees, strict=True)]
    if carried is not None:
        box = box_corners(np.array(problem.model(carried.object_id).size_m))
        spheres = covering_spheres(box)
        tree = None if grid is None else bounding_spheres_of(box)
        T = chain.T_last_tcp @ carried.T_tcp_object
        bodies.append((len(chain.placements), T, box, (spheres, excess_m(box, spheres)), tree))
    for joint, T, own, (spheres, excess), tree in bodies:
        roots, cover = (0, 0), 0.0
        if tree is not None:
            roots, cover = points.add(tree, T), tree.cover_m
        placed = _placed_spheres(T, spheres)
        motion.add_body(joint, se3.apply(T, own), placed, excess, cover, *roots)
    return points


def _set_grid(motion: Motion, grid: SdfGrid, points: _Points) -> None:
    motion.set_grid(
        grid.values_m,
        grid.origin_m,
        grid.voxel_m,
        np.ascontiguousarray(np.concatenate(points.points)),
        np.concatenate(points.radii),
        np.ascontiguousarray(np.concatenate(points.children).astype(np.int32)),
    )
