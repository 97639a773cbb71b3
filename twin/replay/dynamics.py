"""Dynamic replay: put the objects into a physics world, drive the robot and sample the states.

Objects that were localised into each other are moved apart first, or refused: physics answers an
overlap with a kick, and what follows says nothing about the plan.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import coal
import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from bridge.leaves import load_leaf
from bridge.task.task_file import ObjectModel
from twin.physics.engines import PhysicsWorld, open_world
from twin.physics.unseen import EVEN
from twin.replay.clearance.bodies import placed_panels, placement_of
from twin.replay.config import STATE_EVERY, ReplayConfig
from twin.replay.failure import NotEvaluatedError
from twin.replay.path import JointPath
from twin.replay.result import Burst, ReplayResult, States
from twin.replay.scene import ReplayScene
from twin.replay.varied import hand_near
from twin.robot.collision import RobotHulls, convex_hull, signed_distance
from twin.robot.model import check_dynamics

LIFT_M = 0.0002
"""Objects localised into their support start this far above it instead."""


def soft_models(scene: ReplayScene) -> dict[str, Any]:
    """The soft objects that were localised: the scene's lattice where it has one, else the task's.

    Their extents at rest are those of the task file either way, so that the same shape predicate
    judges both.
    """
    models: dict[str, Any] = {}
    for name in scene.movable():
        model = scene.task.objects[name]
        if model.soft is not None:
            models[name] = load_leaf("soft", "shape")(model, scene.lattices.get(name))
    return models


def spawn(world: PhysicsWorld, scene: ReplayScene, soft: Mapping[str, Any]) -> None:
    """Put table, containers and objects where the scene says."""
    world.add_table(scene.table_height_m)
    for name, T in scene.containers().items():
        world.add_static(scene.task.objects[name].panels(), T)
    for name, T in scene.movable().items():
        model = scene.task.objects[name]
        T_free = lifted(T, outline_m(model, soft.get(name)), scene.table_height_m)
        if name in soft:
            world.soft_bodies().add(name, soft[name], T_free)
        else:
            unseen = scene.unseen.get(name, EVEN)
            world.add_free(name, np.array(model.size_m), model.mass_kg, T_free, unseen)


def outline_m(model: ObjectModel, soft: Any) -> Float[np.ndarray, "num_points 3"]:
    """Points whose hull holds the object, in its own frame [m]: of its lattice, or else its box."""
    if soft is not None:
        return np.asarray(soft.nodes_m, dtype=np.float64)
    return box_corners(np.array(model.size_m))


def lifted(
    T_base_object: Float[np.ndarray, "4 4"],
    points_m: Float[np.ndarray, "num_points 3"],  # outline in the object's own frame
    table_height_m: float,  # of its top, over the robot's base
) -> Float[np.ndarray, "4 4"]:
    """Raise an object whose localised pose reaches into the table until it stands just above."""
    lowest = float(se3.apply(T_base_object, points_m)[:, 2].min())
    T = T_base_object.copy()
    T[2, 3] += max(0.0, table_height_m + LIFT_M - lowest)
    return T


def num_steps(end_ns: int, config: ReplayConfig) -> int:
    """Physics steps of a replay whose trajectory ends then, settling before and after included."""
    settling = round(config.settle_before_s * config.physics.rate_hz)
    return settling + _steps_kept(end_ns, config)


def _steps_kept(end_ns: int, config: ReplayConfig) -> int:
    """Those from the start on: whole samples, so that the last lies at the end of settling."""
    rate = config.physics.rate_hz
    moving_steps = int(np.ceil(end_ns * 1e-9 * rate))
    return -(-(moving_steps + round(config.settle_after_s * rate)) // STATE_EVERY) * STATE_EVERY


def simulate(
    path: JointPath,
    scene: ReplayScene,
    hulls: RobotHulls,
    config: ReplayConfig,
    *,
    known: ReplayResult | None = None,  # of the same path
) -> States:
    """Follow a path with position-controlled motors and free objects.

    Every run of the same inputs gives the same bits: one fresh world, fixed steps. A soft body
    that bursts ends it: what comes after would be noise. Nothing is simulated where the hand is
    known to be away from all objects, and they lie still.
    """
    check_dynamics(hulls.robot)
    rate = config.physics.rate_hz
    total = _steps_kept(path.end_ns(), config)
    times_ns = (np.arange(total + 1) * (1e9 / rate)).round().astype(np.int64)
    postures = path.joints_at(times_ns)
    targets = postures.tolist()
    velocities = (np.diff(postures, axis=0) * rate).tolist()
    widths = path.width_at(times_ns).tolist()
    stamps = times_ns.tolist()
    soft = soft_models(scene)
    samples = Samples(scene, soft)
    settling = round(config.settle_before_s * rate)
    places = {name: T[:3, 3] for name, T in scene.movable().items()}
    first = 0 if known is None else int(hand_near(known, places, scene, hulls).argmax())
    at = first - settling // STATE_EVERY
    with open_world(config.engine, hulls.robot.urdf, mesh_hulls(hulls), config.physics) as world:
        spawn(world, scene, soft)
        if known is not None and at > 0:  # objects come to rest while the arm is on its way
            speeds = velocities[at * STATE_EVERY]
            world.reset_robot(known.joints_rad[at], float(known.width_m[at]), speeds)
        else:
            at = first = 0
            world.reset_robot(postures[0], widths[0])
            world.robot.command(targets[0], [0.0] * len(targets[0]), widths[0])
            for _ in range(settling):
                world.step()
            samples.take(world, 0)
        for step in range(at * STATE_EVERY, total):
            world.robot.command(targets[step + 1], velocities[step], widths[step])
            world.step()
            state, between = divmod(step + 1, STATE_EVERY)
            if between or state < first:
                continue
            if not samples.take(world, stamps[step + 1]):
                break
            if known is not None and state % STATE_EVERY == 0 and samples.lie():
                places = {name: np.array(world.object_pose(name)[:3]) for name in places}
                if not hand_near(known, places, scene, hulls)[state:].any():
                    samples.fill(known, slice(state + 1, None))
                    break
        if known is not None:
            samples.fill(known, slice(0, first))
        return samples.states(world)


@lru_cache(maxsize=4)
def mesh_hulls(hulls: RobotHulls) -> dict[str, list[Float[np.ndarray, "num_points 3"]]]:
    """Hulls of links' meshes, as an engine takes them."""
    found: dict[str, list[Float[np.ndarray, "num_points 3"]]] = {}
    for hull in hulls.hulls:
        if hull.from_mesh:
            found.setdefault(hull.link, []).append(hull.points_m)
    return found


LIE_STATES, LIE = 15, 1e-4
"""What moves [m] and turns by less in so many states lies still."""


class Samples:
    """Collects states while a world runs."""

    def __init__(self, scene: ReplayScene, soft: dict[str, Any]) -> None:
        """Begin without any."""
        self._soft, self._fixed = list(soft), scene.containers()
        self._rows: list[tuple[int, Float[np.ndarray, " num_joints"], float, float]] = []
        """Stamp, joints, width and force on the arm."""
        self._seen: dict[str, list[tuple[Any, ...]]] = {name: [] for name in scene.movable()}
        """Place and touch of each object; of soft ones nodes and extents too."""
        self._burst: Burst | None = None

    def take(self, world: PhysicsWorld, t_ns: int) -> bool:
        """Keep the state; False, and nothing kept, when a soft body has burst."""
        for name in self._soft:
            health = world.soft_bodies().health(name)
            if health.burst:
                found = health.describe()
                self._burst = Burst(object_id=name, t_ns=t_ns, found=found)
                if self._rows:
                    return False
                raise NotEvaluatedError(f"{name} before anything moved: {found}")
        self._rows.append((t_ns, *world.robot.posture(), world.arm_force_N()))
        for name, rows in self._seen.items():
            touch = world.finger_touches(name)
            if name in self._soft:
                soft = world.soft_bodies()
                nodes_m = soft.nodes_m(name).astype(np.float32)
                rows.append((world.T_base_object(name), touch, nodes_m, soft.extents_m(name)))
            else:
                rows.append((world.object_pose(name), touch))
        return True

    def lie(self) -> bool:
        """Whether no rigid object has moved in the last ``LIE_STATES``."""
        recent = [[row[0] for row in rows[-LIE_STATES - 1 :]] for rows in self._seen.values()]
        columns = (column for poses in recent for column in zip(*poses, strict=True))
        return len(self._rows) > LIE_STATES and all(max(c) - min(c) < LIE for c in columns)

    def fill(self, known: States, steps: slice) -> None:
        """Put in known states of the arm before or after all others; objects lie as there."""
        at = len(self._rows) if steps.start else 0
        arm = (known.stamps_ns, known.joints_rad, known.width_m, known.arm_force_N)
        filled = list(zip(*(column[steps] for column in arm), strict=True))
        self._rows[at:at] = filled
        for rows in self._seen.values():
            rows[at:at] = [rows[max(at - 1, 0)]] * len(filled)

    def states(self, world: PhysicsWorld) -> States:
        """All that was kept."""
        stamps, joints, widths, forces = zip(*self._rows, strict=True)
        seen = {name: list(zip(*rows, strict=True)) for name, rows in self._seen.items()}
        poses = {name: self._Ts_base_object(name, columns[0]) for name, columns in seen.items()}
        poses |= {name: np.repeat(T[None], len(stamps), axis=0) for name, T in self._fixed.items()}
        return States(
            stamps_ns=np.array(stamps, dtype=np.int64),
            joints_rad=np.stack(joints),
            width_m=np.array(widths),
            Ts_base_object=poses,
            finger_contact={name: np.array(columns[1]) for name, columns in seen.items()},
            nodes_m={name: np.stack(seen[name][2]) for name in self._soft},
            extents_m={name: np.array(seen[name][3], dtype=float) for name in self._soft},
            broken=self._broken(world),
            burst=self._burst,
            arm_force_N=np.array(forces),
        )

    def _Ts_base_object(
        self, name: str, places: Sequence[Any]
    ) -> Float[np.ndarray, "num_steps 4 4"]:
        rows = np.array(places)
        if name in self._soft:
            return rows
        if not np.isfinite(rows).all():
            raise NotEvaluatedError(f"physics lost {name}: its place is not a number any more")
        return se3.transform_from(rows[:, 3:], rows[:, :3])

    def _broken(self, world: PhysicsWorld) -> dict[str, str]:
        found = {}
        if self._burst is not None:
            found[self._burst.object_id] = self._burst.found
        for name in self._soft:
            health = world.soft_bodies().health(name)
            if not health.sound and name not in found:
                found[name] = f"at the end: {health.describe()}"
        return found


START_OVERLAP_M = 0.006
"""Rigid objects that were localised into each other by up to this are moved apart; deeper ones are
not evaluated [m]."""
GAP_M = 0.0002
"""What was moved apart stays this far apart."""
TOUCH_M = 0.0005
"""Overlaps up to this are what contact looks like."""
SOFT_SHARE = 2.0
"""A soft body may overlap so many times as deep: at rest it was pressed together, and its hull
covers more than itself."""
ROUNDS = 6


@dataclass(frozen=True)
class _Solid:
    name: str
    shape: coal.CollisionGeometry
    T: Float[np.ndarray, "4 4"]
    soft: bool = False
    fixed: bool = False


def free_start(scene: ReplayScene, soft: Mapping[str, Any]) -> ReplayScene:
    """Move objects apart that lie in each other or in a container by little.

    The object that can move is moved, along the direction of least depth; of two, each by half.
    Objects are their convex hulls. The table is left to ``spawn``, which lifts what reaches in.
    """
    movable = scene.movable()
    shapes = {
        name: convex_hull(outline_m(scene.task.objects[name], soft.get(name))) for name in movable
    }
    fixed = [
        _Solid(name, coal.Box(*extents), T_base_panel, fixed=True)
        for name, T in scene.containers().items()
        for T_base_panel, extents in placed_panels(scene.task.objects[name], T)
    ]
    moved = {name: T.copy() for name, T in movable.items()}
    for _ in range(ROUNDS):
        solids = [_Solid(n, shapes[n], T, soft=n in soft) for n, T in moved.items()]
        if not _separate(solids, fixed, moved):
            break
    else:
        names = ", ".join(moved)
        raise NotEvaluatedError(
            f"the objects ({names}) start in each other and cannot be separated"
        )
    return replace(scene, Ts_base_object={**scene.Ts_base_object, **moved})


def _separate(
    solids: list[_Solid], fixed: list[_Solid], moved: dict[str, Float[np.ndarray, "4 4"]]
) -> bool:
    """One round; says whether anything had to be moved."""
    anything = False
    for index, solid in enumerate(solids):
        for other in [*fixed, *solids[index + 1 :]]:
            depth, normal = _overlap(solid, other)
            if depth <= TOUCH_M:
                continue
            limit = START_OVERLAP_M * (SOFT_SHARE if solid.soft or other.soft else 1.0)
            if depth > limit:
                raise NotEvaluatedError(
                    f"{solid.name} starts {depth * 1e3:.0f} mm inside {other.name}; up to "
                    f"{limit * 1e3:.0f} mm are moved apart. Localise them again, or look whether "
                    "one hides the other"
                )
            share = 1.0 if other.fixed else 0.5
            moved[solid.name][:3, 3] -= share * (depth + GAP_M) * normal
            if not other.fixed:
                moved[other.name][:3, 3] += share * (depth + GAP_M) * normal
            anything = True
    return anything


def _overlap(first: _Solid, second: _Solid) -> tuple[float, Float[np.ndarray, "3"]]:
    """Depth, negative when apart, and the direction from the first into the second."""
    result = coal.DistanceResult()
    distance = signed_distance(
        first.shape, placement_of(first.T), second.shape, placement_of(second.T), result
    )
    normal = np.array(result.normal, dtype=np.float64)
    length = float(np.linalg.norm(normal))
    return -distance, normal / length if length > 0 else np.array([0.0, 0.0, -1.0])
