"""Check a replay's clearance again with another library, on real meshes instead of hulls.

Before a yes, python-fcl (BSD-3) measures what coal measured: links by the triangles of their
collision meshes, carried objects, the table, the panels or the mesh of containers, and the surface
of the scene that has no name. Bodies are placed and chosen here, not by the monitor whose answer is
examined; what may touch is read from the task's stages by both. Where less distance is found than
was said, the answer is null, and both numbers are kept.

Between two states of the replay others are put, so that nothing moves farther than ``STEP_M`` from
one to the next. At those only ``eps_col_m`` was promised. Soft bodies are known by their nodes
alone and are left to the monitor; so are the robot's own links against each other. Triangles have
no inside: a body wholly inside a link's mesh is not found.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float, Int

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.plan import Plan
from bridge.task.task_file import BASKET
from bridge.task.verdict import Factor
from twin.replay.clearance.bodies import SCENE, TABLE, PanelBox, names_of, placed_panels
from twin.replay.clearance.monitor import MAX_LEAP_M, allowed_at
from twin.replay.clearance.static_obstacles import stationary_links
from twin.replay.config import MOVED_M, ReplayConfig
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene
from twin.robot.collision import collision_geometry, hulls_of
from twin.robot.model import RobotModel, load_robot
from twin.scene.shape.isosurface import isosurface
from twin.scene.shape.static import OBJECT_MARGIN_VOXELS, StaticSdf

NEAR_M = 0.05
"""Pairs whose boxes are farther apart are not asked."""
STEP_M = 0.004
"""Most that anything moves between two states: what lies between is missed by half of it."""
TOLERANCE_M = 0.0005
"""Less than was said by no more than this is rounding: what is missed between two states."""
_SLAB_M = (4.0, 4.0, 0.4)
_BLOCK_M = 0.15
"""The scene's surface is cut into blocks, so that most of it need not be asked."""

Corners = Float[np.ndarray, "8 3"]
_Excess = tuple[float, str, tuple[str, str]]
"""How much less distance was found than was said [m], in words, and between which bodies."""


@dataclass(frozen=True)
class _Body:
    """One shape of python-fcl with a box that holds it, in its own frame."""

    name: str
    shape: Any
    """An ``fcl.CollisionObject``; placed anew for each question."""
    centre_m: Float[np.ndarray, "3"]
    half_m: Float[np.ndarray, "3"]
    tolerance_m: float = TOLERANCE_M


@dataclass(frozen=True)
class _Placed:
    """A body over all states, or one that does not move (one state)."""

    body: _Body
    R: Float[np.ndarray, "num_states 3 3"]
    t: Float[np.ndarray, "num_states 3"]

    def box(self) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Lower and upper ends of the axis-aligned boxes that hold it."""
        centre = self.R @ self.body.centre_m + self.t
        reach = np.abs(self.R) @ self.body.half_m
        return centre - reach, centre + reach

    def corners(self) -> Float[np.ndarray, "num_states 8 3"]:
        """The corners of its box."""
        local = self.body.centre_m + box_corners(2 * self.body.half_m)
        return np.asarray(np.einsum("sij,cj->sci", self.R, local) + self.t[:, None])


@dataclass(frozen=True, kw_only=True)
class _States:
    """The states that are asked about."""

    stamps_ns: Int[np.ndarray, " num_states"]
    joints_rad: Float[np.ndarray, "num_states num_joints"]
    width_m: Float[np.ndarray, " num_states"]
    claimed_m: Float[np.ndarray, " num_states"]
    """What the clearance said; between two states of the replay what it promised."""
    Ts_base_object: dict[str, Float[np.ndarray, "num_states 4 4"]]


def audit(
    result: ReplayResult,
    plan: Plan,  # no more contacts in its stages than the task allows (``limited_to_task``)
    scene: ReplayScene,
    config: ReplayConfig,
    *,
    max_queries: int = 20_000,  # pairs; a replay that needs more is not decided
) -> Factor:
    """Whether python-fcl finds nowhere less distance than a replay's clearance; None: why not."""
    try:
        import fcl  # noqa: PLC0415  # [replay] brings it; without it there is no yes
    except ImportError:
        fcl = None
    if not hasattr(fcl, "distance"):
        return Factor(
            value=None, detail="the clearance cannot be audited: install python-fcl ([replay])"
        )
    blind = hulls_of(load_robot(scene.urdf)).blind()
    if blind is not None:
        return Factor(value=None, detail=blind)
    return _Audit(fcl, plan, scene, config, max_queries).of(result)


class _Audit:
    """One audit; counts what it asks."""

    def __init__(
        self, fcl: Any, plan: Plan, scene: ReplayScene, config: ReplayConfig, max_queries: int
    ) -> None:
        self._fcl, self._scene, self._config = fcl, scene, config
        self._allowed_at = allowed_at(plan.stages)
        self._robot = load_robot(scene.urdf)
        self._links = _link_bodies(self._robot)
        self._stationary, _ = stationary_links(hulls_of(self._robot))
        self._request = fcl.DistanceRequest(gjk_solver_type=fcl.GJKSolverType.GST_INDEP)
        self._left = self._most = max_queries
        self._objects = {
            name: _box_body(fcl, name, np.array(scene.task.objects[name].size_m))
            for name in scene.movable()
            if scene.task.objects[name].soft is None
        }

    def of(self, result: ReplayResult) -> Factor:
        """Ask about every near pair of every state."""
        states = self._dense(result)
        if states is None:
            return self._too_many()
        links = self._placed_links(states)
        objects = [
            _Placed(self._objects[name], Ts[:, :3, :3], Ts[:, :3, 3])
            for name, Ts in states.Ts_base_object.items()
        ]
        moved = {  # belongs to somebody's motion; a millimetre later than for the monitor
            name: np.linalg.norm(Ts[:, :3, 3] - Ts[0, :3, 3], axis=1) > MOVED_M + 0.001
            for name, Ts in states.Ts_base_object.items()
        }
        found: list[_Excess] = []
        fixed = self._fixed()
        always = np.ones(len(states.stamps_ns), dtype=bool)
        for first in links:
            for second in (*fixed, *objects):
                if second.body.name == TABLE and first.body.name in self._stationary:
                    continue  # the robot stands on it with them
                found += self._ask(first, second, states, always)
        for item in objects:
            for second in fixed:
                found += self._ask(item, second, states, moved[item.body.name])
        asked = self._most - self._left
        if self._left < 0:
            return self._too_many()
        if found:
            _, detail, bodies = max(found)
            return Factor(value=None, detail=detail, bodies=bodies)
        detail = f"{len(states.stamps_ns)} states and {asked} distances asked again"
        return Factor(value=True, detail=detail)

    def _too_many(self) -> Factor:
        detail = f"the audit needs more than {self._most} distances; nothing is said without it"
        return Factor(value=None, detail=detail)

    def _ask(
        self, first: _Placed, second: _Placed, states: _States, where: Bool[np.ndarray, " n"]
    ) -> list[_Excess]:
        """Distances of a pair that are less than was said: by how much, and in words."""
        tolerance = max(first.body.tolerance_m, second.body.tolerance_m)
        low, high = first.box()
        other_low, other_high = second.box()
        gap = np.linalg.norm(
            np.maximum(0.0, np.maximum(other_low - high, low - other_high)), axis=1
        )
        ask = where & (gap < NEAR_M) & (gap < states.claimed_m - tolerance)
        names = names_of(first.body.name, self._robot.record.gripper)
        pairs = {frozenset((name, second.body.name)) for name in names}
        found: list[_Excess] = []
        for index in np.flatnonzero(ask).tolist():
            if pairs & self._allowed_at(int(states.stamps_ns[index])):
                continue
            self._left -= 1
            if self._left < 0:
                return found
            distance = self._distance_m(first, second, index)
            excess = float(states.claimed_m[index]) - distance
            if not excess <= tolerance:
                claimed_mm, t_s = states.claimed_m[index] * 1e3, states.stamps_ns[index] * 1e-9
                detail = (
                    f"{first.body.name} is {distance * 1e3:.1f} mm from {second.body.name} at "
                    f"{t_s:.2f} s by python-fcl, the clearance said {claimed_mm:.1f} mm"
                )
                found.append((excess, detail, (first.body.name, second.body.name)))
        return found

    def _distance_m(self, first: _Placed, second: _Placed, index: int) -> float:
        """Distance at a state [m]; touching is 0, for which fcl says -1."""
        for item in (first, second):
            at = min(index, len(item.t) - 1)
            item.body.shape.setTransform(self._fcl.Transform(item.R[at], item.t[at]))
        answer = self._fcl.DistanceResult()
        found = self._fcl.distance(first.body.shape, second.body.shape, self._request, answer)
        return max(0.0, float(found))

    def _placed_links(self, states: _States) -> list[_Placed]:
        robot = self._robot
        R = np.zeros((len(self._links), len(states.width_m), 3, 3))
        t = np.zeros((len(self._links), len(states.width_m), 3))
        rows = zip(states.joints_rad, states.width_m.tolist(), strict=True)
        for index, (joints_rad, width_m) in enumerate(rows):
            q = robot.configuration(joints_rad, width_m)
            pin.framesForwardKinematics(robot.model, robot.data, q)
            for number, (frame, T_link_shape, _) in enumerate(self._links):
                placement = robot.data.oMf[frame] * T_link_shape
                R[number, index], t[number, index] = placement.rotation, placement.translation
        return [_Placed(body, R[n], t[n]) for n, (_, _, body) in enumerate(self._links)]

    def _dense(self, result: ReplayResult) -> _States | None:
        """The replay's states and others between them; None when they are too many."""
        known = {n: Ts for n, Ts in result.Ts_base_object.items() if n in self._objects}
        sampled = _States(
            stamps_ns=result.stamps_ns,
            joints_rad=result.joints_rad,
            width_m=result.width_m,
            claimed_m=result.clearance_m,
            Ts_base_object=known,
        )
        travel = np.zeros(len(result.stamps_ns) - 1)
        movers = self._placed_links(sampled) + [
            _Placed(self._objects[name], Ts[:, :3, :3], Ts[:, :3, 3]) for name, Ts in known.items()
        ]
        for item in movers:
            steps = np.linalg.norm(np.diff(item.corners(), axis=0), axis=2).max(axis=1)
            if item.body.name in known:
                steps = np.where(steps > MAX_LEAP_M, 0.0, steps)  # nobody's way
            travel = np.maximum(travel, steps)
        parts = np.maximum(np.ceil(travel / STEP_M), 1).astype(np.int64)
        if parts.sum() > self._most:
            return None
        first = np.repeat(np.arange(len(parts)), parts)
        share = np.concatenate([np.arange(n) / n for n in parts] or [np.zeros(0)])
        first, share = np.append(first, len(parts)), np.append(share, 0.0)
        second = np.minimum(first + 1, len(parts))
        return _between(sampled, first, second, share, self._config.eps_col_m)

    def _fixed(self) -> list[_Placed]:
        fcl, scene = self._fcl, self._scene
        T_table = np.eye(4)
        T_table[2, 3] = scene.table_height_m - _SLAB_M[2] / 2
        placed = [(_box_body(fcl, TABLE, np.array(_SLAB_M)), T_table)]
        panels = []
        for name, T in scene.containers().items():
            model = scene.task.objects[name]
            panels += placed_panels(model, T)
            if model.mesh == BASKET:
                mesh = object_mesh(model)
                body = _mesh_body(fcl, name, mesh.vertices_m, np.asarray(mesh.triangles))
                placed.append((body, T))
            else:
                placed += [
                    (_box_body(fcl, name, extents), T_base_panel)
                    for T_base_panel, extents in placed_panels(model, T)
                ]
        if scene.static_sdf is not None:
            _, foot = stationary_links(hulls_of(self._robot))
            cylinder = None if foot is None else (foot.radius_m, foot.top_m)
            blocks = _scene_blocks(scene.static_sdf, scene.table_height_m, cylinder, panels)
            voxel_m = scene.static_sdf.observed.voxel_m
            placed += [
                (_mesh_body(fcl, SCENE, points, faces, voxel_m), np.eye(4))
                for points, faces in blocks
            ]
        return [_Placed(body, T[None, :3, :3], T[None, :3, 3]) for body, T in placed]


def _between(
    states: _States,
    first: Int[np.ndarray, " n"],
    second: Int[np.ndarray, " n"],
    share: Float[np.ndarray, " n"],
    eps_m: float,
) -> _States:
    """States a share of the way from one to another, straight in joints, positions and turns."""

    def mixed(values: Float[np.ndarray, "num ..."]) -> Any:
        weight = share.reshape(-1, *[1] * (values.ndim - 1))
        return values[first] + weight * (values[second] - values[first])

    stamps = mixed(states.stamps_ns.astype(np.float64)).round().astype(np.int64)
    poses = {}
    for name, Ts in states.Ts_base_object.items():
        q, p = se3.split(Ts)
        turned = se3.interpolate_quaternion(q[first], q[second], share)
        poses[name] = se3.transform_from(turned, mixed(p))
    claimed_m = np.minimum(states.claimed_m[second], eps_m)
    return _States(
        stamps_ns=stamps,
        joints_rad=mixed(states.joints_rad),
        width_m=mixed(states.width_m),
        claimed_m=np.where(share == 0.0, states.claimed_m[first], claimed_m),
        Ts_base_object=poses,
    )


def _box_body(fcl: Any, name: str, size_m: Float[np.ndarray, "3"]) -> _Body:
    x, y, z = (float(value) for value in size_m)
    return _Body(name, fcl.CollisionObject(fcl.Box(x, y, z)), np.zeros(3), np.asarray(size_m) / 2)


def _mesh_body(
    fcl: Any,
    name: str,
    points_m: Float[np.ndarray, "num_points 3"],
    triangles: Int[np.ndarray, "num_triangles 3"],
    tolerance_m: float = TOLERANCE_M,
) -> _Body:
    shape = fcl.BVHModel()
    shape.beginModel(len(points_m), len(triangles))
    shape.addSubModel(np.asarray(points_m, dtype=np.float64), np.asarray(triangles))
    shape.endModel()
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    return _Body(name, fcl.CollisionObject(shape), (low + high) / 2, (high - low) / 2, tolerance_m)


@lru_cache(maxsize=4)
def _link_bodies(robot: RobotModel) -> tuple[tuple[int, pin.SE3, _Body], ...]:
    """The collision shapes of a robot as its description has them, each with its frame and place.

    Meshes by their triangles; boxes, spheres, cylinders and capsules are python-fcl's own.
    """
    import fcl  # noqa: PLC0415

    found = []
    for item in collision_geometry(robot.model, robot.urdf).geometryObjects:
        frame, shape = robot.model.frames[item.parentFrame], item.geometry
        if isinstance(shape, coal.BVHModelBase):
            corners = [shape.tri_indices(number) for number in range(shape.num_tris)]
            triangles = np.array([(each[0], each[1], each[2]) for each in corners], dtype=np.int64)
            body = _mesh_body(fcl, frame.name, np.array(shape.vertices()), triangles)
        elif isinstance(shape, coal.Box):
            body = _box_body(fcl, frame.name, 2 * np.array(shape.halfSide))
        else:
            shape.computeLocalAABB()
            high = np.array(shape.aabb_local.max_)  # about the middle
            body = _Body(frame.name, fcl.CollisionObject(_round(fcl, shape)), np.zeros(3), high)
        found.append((item.parentFrame, frame.placement.inverse() * item.placement, body))
    return tuple(found)


def _round(fcl: Any, shape: Any) -> Any:
    if isinstance(shape, coal.Sphere):
        return fcl.Sphere(shape.radius)
    kind = fcl.Capsule if isinstance(shape, coal.Capsule) else fcl.Cylinder
    return kind(shape.radius, 2 * shape.halfLength)


def _scene_blocks(
    static: StaticSdf,
    table_height_m: float,
    foot: tuple[float, float] | None,
    panels: Sequence[PanelBox],
) -> list[tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]]:
    """The surface of what has no name in a scene, in blocks.

    What lies within a voxel and a half of table, containers or the robot's foot is theirs.
    """
    grid = static.observed
    margin = OBJECT_MARGIN_VOXELS * grid.voxel_m
    lowest = int(np.ceil((table_height_m + margin - grid.origin_m[2]) / grid.voxel_m))
    values = grid.values_m[:, :, max(lowest, 0) :]
    if not values.size or not (values < 0).any():
        return []
    origin = grid.origin_m + np.array([0.0, 0.0, max(lowest, 0) * grid.voxel_m])
    points, faces = isosurface(np.ascontiguousarray(values), origin, grid.voxel_m)
    named = points[:, 2] <= table_height_m + 2 * margin
    if foot is not None:
        beside = np.hypot(points[:, 0], points[:, 1]) <= foot[0] + 2 * margin
        named |= beside & (points[:, 2] <= foot[1] + 2 * margin)
    for T, extents in panels:
        outside = np.maximum(np.abs(se3.apply(se3.invert(T), points)) - extents / 2, 0.0)
        named |= np.linalg.norm(outside, axis=1) <= 2 * margin
    faces = faces[~named[faces].any(axis=1)]
    blocks = []
    places = np.floor(points[faces[:, 0]] / _BLOCK_M).astype(np.int64) if len(faces) else faces
    for place in np.unique(places, axis=0):
        own = faces[(places == place).all(axis=1)]
        used, own = np.unique(own, return_inverse=True)
        blocks.append((points[used], own.reshape(-1, 3)))
    return blocks
