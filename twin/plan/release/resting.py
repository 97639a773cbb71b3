"""Where an object would come to rest: the poses that final states are looked for around."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bridge.geometry import se3
from bridge.task.check import TABLE
from bridge.task.task_file import ObjectModel
from twin.plan.constrain.bodies import surface_points
from twin.plan.problem import (
    Grasp,
    Miss,
    NoPlanError,
    Points,
    Pose,
    Poses,
    Problem,
    Release,
    RotationMatrix,
    Vector,
)

QUARTER_TURNS = 4
_SAME_RAD = 0.02


@dataclass(frozen=True, kw_only=True)
class Target:
    """What an object is put into, onto, or where."""

    relation: str
    """inside, on, or at: a mark on the table."""
    name: str
    T_base: Pose
    """Upright frame in the middle of the area, at the height on which the object comes to lie."""
    half_m: tuple[float, float]
    """Half the extents of the area, along its axes."""
    rim_m: float
    """Height of the walls around it over that height."""
    sigma_m: float
    """Standard deviation of where it is, sideways."""


def target_of(problem: Problem, object_id: str) -> Target:
    """Find where the success predicates want an object."""
    scene = problem.scene
    goal = scene.task.goal_of(object_id)
    if goal is None:
        mark = scene.task.mark_of(object_id)
        if mark is None:
            message = f"no success predicate of task {scene.task.name} says where {object_id} goes."
            raise NoPlanError(message, cause="nowhere_said")
        T = np.eye(4)
        T[:3, 3] = (*mark, scene.table_height_m)
        return Target(
            relation="at", name="table", T_base=T, half_m=(0.0, 0.0), rim_m=0.0, sigma_m=0.0
        )
    relation, name = goal
    T_found = scene.Ts_base_object[name]
    model = problem.model(name)
    inside = relation == "inside"
    x, y, _ = model.inner_m if inside else model.size_m
    top = model.size_m[2] / 2 if model.origin_at_centre else model.size_m[2]
    height = model.wall_m if inside else top
    return Target(
        relation=relation,
        name=name,
        T_base=upright_frame(T_found, T_found[:3, 3] + T_found[:3, 2] * height),
        half_m=(x / 2, y / 2),
        rim_m=model.size_m[2] - model.wall_m if inside else 0.0,
        sigma_m=sideways_sigma_m(problem, name),
    )


def lying_there(problem: Problem, release: Release, miss: Miss | None = None) -> Pose:
    """Where an object lies that is let go a little above."""
    points_m = surface_points(problem, release.object_id)
    height_m = support_m(problem, release.object_id)
    T: Pose = settled(release.T_base_object[None], points_m, height_m, miss or Miss())[0]
    return T


def settled(Ts: Poses, points_m: Points, height_m: float, miss: Miss) -> Poses:
    """Where an object of some points lies on something: straight below, or aside by a miss."""
    found = miss.applied(Ts)
    low_m = (found[:, 2, :3] @ points_m.T).min(axis=1) + found[:, 2, 3]
    found[:, 2, 3] -= low_m - height_m
    return found


def support_m(problem: Problem, key: str) -> float:
    """Height of what an object comes to lie on, base frame."""
    goal = problem.scene.task.goal_of(key)
    if goal is None or goal[0] not in ("inside", "on") or goal[1] == TABLE:
        return problem.scene.table_height_m
    return float(target_of(problem, key).T_base[2, 3])


def sideways_sigma_m(problem: Problem, name: str) -> float:
    """Standard deviation of an object's position in its worst horizontal direction [m]."""
    covariance = problem.scene.covariances.get(name)
    if covariance is None:
        return 0.0
    return float(np.sqrt(max(np.linalg.eigvalsh(np.asarray(covariance)[:2, :2])[-1], 0.0)))


def upright_frame(T: Pose, p_m: Vector) -> Pose:
    """Frame at a point with z up and x along the heading of a pose."""
    yaw = np.arctan2(T[1, 0], T[0, 0])
    frame = np.eye(4)
    frame[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    frame[:3, 3] = p_m
    return frame


def orientations(
    model: ObjectModel, R_now: RotationMatrix, R_target: RotationMatrix
) -> list[RotationMatrix]:
    """Rotations in which an object may come to rest, the one nearest to now first."""
    found: list[RotationMatrix] = []
    for S in same_turns(model):
        R = R_now @ S
        heading = (
            np.arctan2(R[1, 0], R[0, 0])
            if abs(R[2, 0]) < np.sqrt(0.5)
            else np.arctan2(R[1, 1], R[0, 1])
        )
        aim = np.arctan2(R_target[1, 0], R_target[0, 0])
        for quarter in range(QUARTER_TURNS):
            about = np.array([0.0, 0.0, aim - heading + quarter * np.pi / 2])
            turned = se3.rotation_from_vector(about) @ R
            if all(se3.rotation_angle_rad(other.T @ turned) > _SAME_RAD for other in found):
                found.append(turned)
    return sorted(found, key=lambda R: round(float(se3.rotation_angle_rad(R_now.T @ R)), 6))


def same_turns(model: ObjectModel) -> Float[np.ndarray, "num 3 3"]:
    """Turns that nobody could tell: of a cube 24, of others none."""
    is_cube = model.symmetry == "cube"
    return (
        np.asarray(Rotation.create_group("O").as_matrix().round()) if is_cube else np.eye(3)[None]
    )


def resting_poses(
    problem: Problem, grasp: Grasp, target: Target, *, drop_m: float, most_tilted_rad: float
) -> list[Pose]:
    """Poses ``T_base_object`` a little above where the object would lie, in the middle."""
    T_now = problem.scene.Ts_base_object[grasp.object_id]
    points = surface_points(problem, grasp.object_id)
    found = []
    model = problem.model(grasp.object_id)
    for R in orientations(model, T_now[:3, :3], target.T_base[:3, :3]):
        approach = (R @ grasp.T_object_tcp[:3, :3])[:, 2]
        if np.arctan2(np.hypot(*approach[:2]), -approach[2]) > most_tilted_rad:
            continue
        placed = points @ R.T
        middle = (placed.min(axis=0) + placed.max(axis=0)) / 2
        T = np.eye(4)
        T[:3, :3] = R
        T[:2, 3] = target.T_base[:2, 3] - middle[:2]
        T[2, 3] = target.T_base[2, 3] + drop_m - placed[:, 2].min()
        found.append(T)
    if not found:
        message = (
            f"held as it is, {grasp.object_id} can be put down in no way in which the tool points "
            "downwards: take it by another grasp."
        )
        raise NoPlanError(message, cause="tool_direction")
    return found
