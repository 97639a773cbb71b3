"""The arm, what it carries and what stands around it, as the native search wants them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pinocchio as pin

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from twin.plan.path._motion import Motion
from twin.plan.problem import Points, Pose, Problem, Vector
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
Names = tuple[str, str]


@dataclass(frozen=True, kw_only=True)
class Carried:
    """An object in the hand."""

    object_id: str
    T_tcp_object: Pose


@dataclass(frozen=True, kw_only=True)
class World:
    """A native world, and what its numbers mean."""

    motion: Motion
    names: list[Names]
    robot: RobotModel
    limits_m: list[float]


@dataclass(frozen=True, kw_only=True)
class _Body:
    """A convex piece that the arm moves."""

    joint: int
    """How many joints move it."""
    T_joint_body: Pose
    corners_m: Points
    tree: BoundingSphereTree | None
    """What a grid is asked about, where there is one."""


@lru_cache(maxsize=4)
def _link_trees(hulls: RobotHulls) -> tuple[BoundingSphereTree, ...]:
    gripper = hulls.robot.record.gripper.links
    return tuple(
        bounding_spheres_of(hull.points_m, FINE_M if hull.link in gripper else ARM_FINE_M)
        for hull in hulls.hulls
    )


def _arm(hulls: RobotHulls, width_m: float, *, has_grid: bool) -> tuple[Motion, list[_Body], Pose]:
    """Read an arm's joints off pinocchio, its fingers held at an opening; its tool comes last."""
    robot = hulls.robot
    model, data = robot.model, robot.data
    zero = np.zeros(len(robot.joints))
    ids = [int(model.getJointId(name)) for name in robot.joints]
    pin.computeJointJacobians(model, data, robot.configuration(zero, width_m))
    frames = [np.eye(4)] + [np.array(data.oMi[joint].homogeneous) for joint in ids]
    axes, slides = [], []
    for joint in ids:
        column = pin.getJointJacobian(model, data, joint, pin.LOCAL)[:, model.joints[joint].idx_v]
        turning = bool(np.linalg.norm(column[3:]) > 0.5)
        axes.append(column[3:] if turning else column[:3])
        slides.append(not turning)
    T_last_tcp = se3.invert(frames[-1]) @ robot.T_base_tcp(zero)
    hulls.place(zero, width_m)
    bodies = []
    trees = _link_trees(hulls) if has_grid else [None] * len(hulls.hulls)
    for number, (hull, tree) in enumerate(zip(hulls.hulls, trees, strict=True)):
        joint = int(model.frames[robot.frame_id(hull.link)].parentJoint)
        while joint and joint not in ids:
            joint = int(model.parents[joint])
        index = ids.index(joint) + 1 if joint else 0
        T_base_hull = se3.from_rotation(hulls.rotations[number], hulls.translations[number])
        T = se3.invert(frames[index]) @ T_base_hull
        bodies.append(_Body(joint=index, T_joint_body=T, corners_m=hull.points_m, tree=tree))
    placements = np.stack([se3.invert(before) @ own for before, own in pairwise(frames)])
    motion = Motion(
        placements,
        np.array(axes),
        np.array(slides),
        robot.lower_rad,
        robot.upper_rad,
        T_last_tcp[:3, 3],
    )
    return motion, bodies, T_last_tcp


def _pairs(
    hulls: RobotHulls, boxes: list[str], carried: Carried | None, *, has_grid: bool
) -> Iterator[tuple[int, int, int, Names]]:
    """Pairs that are kept apart: number of a body, kind and number of the other, their names."""
    stationary, _ = stationary_links(hulls)
    links = [hull.link for hull in hulls.hulls]
    held = [] if carried is None else [carried.object_id]
    for body, name in enumerate([*links, *held]):
        for number, other in enumerate(boxes):
            yield body, BOX, number, (name, other)
        if name not in stationary:
            yield body, PLANE, 0, (name, TABLE)
            if has_grid:
                yield body, GRID, 0, (name, SCENE)
    for one, two in hulls.pairs:
        yield one, BODY, two, (links[one], links[two])
    for name in held:  # those links that do not hold it
        for index, link in enumerate(links):
            yield len(links), BODY, index, (link, name)


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
    hulls = hulls_of(problem.robot)
    grid = scene_grid(problem.scene, hulls)
    motion, bodies, T_last_tcp = _arm(hulls, width_m, has_grid=grid is not None)
    if carried is not None:
        box = box_corners(np.array(problem.model(carried.object_id).size_m))
        T = T_last_tcp @ carried.T_tcp_object
        tree = None if grid is None else bounding_spheres_of(box)
        joints = len(problem.robot.joints)
        bodies.append(_Body(joint=joints, T_joint_body=T, corners_m=box, tree=tree))
    _add_bodies(motion, bodies, grid)
    obstacles = _obstacles(problem, carried)
    motion.set_table(problem.scene.table_height_m)
    for _, T, size in obstacles:
        motion.add_box(T, np.asarray(size, dtype=np.float64) / 2)
    names: list[Names] = []
    limits_m: list[float] = []
    boxes = [name for name, *_ in obstacles]
    for body, kind, other, named in _pairs(hulls, boxes, carried, has_grid=grid is not None):
        more_m = (wider_m or {}).get(frozenset(named))
        known = names_of(named[0], problem.robot.record.gripper)
        if more_m is None and any(frozenset((name, named[1])) in allowed for name in known):
            continue  # what was refused before may not touch
        is_own = kind == BODY and body < len(hulls.hulls)
        limits_m.append((0.0 if is_own else eps_col_m) + SPARE_M + (more_m or 0.0))
        motion.add_pair(body, kind, other, limits_m[-1])
        names.append(named)
    motion.prepare()
    return World(motion=motion, names=names, robot=problem.robot, limits_m=limits_m)


def _add_bodies(motion: Motion, bodies: list[_Body], grid: SdfGrid | None) -> None:
    """Add bodies; where there is a grid, with the points that it is asked about."""
    begin, points, radii, children = 0, [], [], []
    for body in bodies:
        T, tree = body.T_joint_body, body.tree
        if tree is None:
            motion.add_body(body.joint, se3.apply(T, body.corners_m), 0.0, 0, 0)
            continue
        roots = begin, begin + tree.num_roots
        motion.add_body(body.joint, se3.apply(T, body.corners_m), tree.cover_m, *roots)
        points.append(se3.apply(T, tree.points_m))
        radii.append(tree.radius_m)
        children.append((tree.children + begin).astype(np.int32))
        begin += len(tree.points_m)
    if grid is not None:
        about = grid.values_m, grid.origin_m, grid.voxel_m
        motion.set_grid(*about, *map(np.concatenate, (points, radii, children)))


def _obstacles(problem: Problem, carried: Carried | None) -> list[tuple[str, Pose, Vector]]:
    """Panels of what stands still, and a box for each other object: name, pose and extents [m]."""
    scene = problem.scene
    found = [
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
