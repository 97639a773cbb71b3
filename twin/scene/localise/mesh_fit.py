"""Lay a known surface onto points: multi-start ICP with one camera error per view.

Point to plane (Chen and Medioni 1992) with Tukey weights against those parts of the surface that
face the camera of each point. Of several starts the one wins that explains the points and does not
claim surface where a camera saw through; boxes are then laid onto their outlines as well. Surfaces
come from the task, or from the scene where an object's shape is only known from a scan.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.geometry.mesh import sample_triangles
from bridge.task.task_file import SCANNED, ObjectModel, Task
from twin.scene.frames.downscaled import pixels_of
from twin.scene.least_squares import normal_equations, tukey_weights
from twin.scene.localise.outline import Outline, find_outlines, outline_distances
from twin.scene.localise.points import CameraView, Cluster
from twin.scene.shape.known import pose_of, shape_mesh, yaw_period_rad
from twin.scene.shape.mesh import face_normals, read_mesh
from twin.scene.store.folder import UnreadableSceneError, read_record
from twin.scene.store.library import MESH, TASK_SHAPE, Library

NUM_SAMPLES = 2500
"""Points on the surface of a mesh."""
BOX_SAMPLES = 7500
"""The same of a box: its walls are thin."""
FACING = 0.15
"""Cosine below which a camera hardly sees a surface."""


@dataclass(frozen=True, kw_only=True)
class MeshSurface:
    """Points spread evenly over a mesh, in the object frame."""

    p_m: Float[np.ndarray, "num_samples 3"]
    normals: Float[np.ndarray, "num_samples 3"]


def mesh_surface(
    vertices_m: Float[np.ndarray, "num_vertices 3"],
    triangles: Int[np.ndarray, "num_faces 3"],
    num_samples: int = NUM_SAMPLES,
) -> MeshSurface:
    """Spread points over a mesh, each triangle by its area; the same each time.

    Args:
        triangles: Counter-clockwise seen from outside.
    """
    a, b, c = (vertices_m[triangles[:, k]] for k in range(3))
    normals, areas = face_normals(vertices_m, triangles)
    chosen, u, v = sample_triangles(areas, num_samples, np.random.default_rng(0), in_order=True)
    p = a[chosen] * (1 - u - v) + b[chosen] * u + c[chosen] * v
    return MeshSurface(p_m=p, normals=normals[chosen])


@cache
def known_surface(model: ObjectModel, num_samples: int = NUM_SAMPLES) -> MeshSurface:
    """Surface of the shape that the task file states."""
    return mesh_surface(*shape_mesh(model), num_samples)


def facing(
    T_object_base: Float[np.ndarray, "4 4"], view: CameraView, surface: MeshSurface
) -> Bool[np.ndarray, " num_samples"]:
    """Tell which samples turn their outside to a view's camera."""
    ray = se3.apply(T_object_base, view.T_base_depth[None, :3, 3])[0] - surface.p_m
    along = np.einsum("ij,ij->i", ray, surface.normals)
    return np.asarray(along > FACING * lengths(ray))


def lengths(rows: Float[np.ndarray, "num_rows 3"]) -> Float[np.ndarray, " num_rows"]:
    """Norms; five times as fast as a sum along so short an axis, and the same bits."""
    square = rows * rows
    return np.asarray(np.sqrt(square[:, 0] + square[:, 1] + square[:, 2]))


def seen_through(
    T: Float[np.ndarray, "4 4"],
    surface: MeshSurface,
    views: Sequence[CameraView],
    margin_m: float,
    shifts_m: Float[np.ndarray, "num_views 2"] | None = None,
) -> float:
    """Share of the mesh's facing surface behind which cameras measured something.

    Args:
        shifts_m: Of the object in each view, x and y; None: where ``T`` says.
    """
    looked = []
    for view, shift in zip(
        views, np.zeros((len(views), 2)) if shifts_m is None else shifts_m, strict=True
    ):
        moved = T.copy()
        moved[:2, 3] += shift
        looked.append(_looked_at(moved, se3.invert(moved), surface, view))
    through = sum(int((measured > z + margin_m).sum()) for measured, z in looked)
    return _share(through, sum(int((measured > 0).sum()) for measured, _ in looked))


def agreeing(
    T: Float[np.ndarray, "4 4"], surface: MeshSurface, views: Sequence[CameraView], margin_m: float
) -> float:
    """Share of the mesh's facing surface that the camera which sees most of it measured there."""
    T_object_base = se3.invert(T)
    share = 0.0
    for view in views:
        measured, z = _looked_at(T, T_object_base, surface, view)
        looked = int((measured > 0).sum())
        # Behind the nearer bound, but not behind the farther one.
        near, far = (int((measured > z + bound).sum()) for bound in (-margin_m, margin_m))
        share = max(share, _share(near, looked) - _share(far, looked))
    return share


def _looked_at(
    T: Float[np.ndarray, "4 4"],
    T_object_base: Float[np.ndarray, "4 4"],
    surface: MeshSurface,
    view: CameraView,
) -> tuple[Float[np.ndarray, " num_seen"], Float[np.ndarray, " num_seen"]]:
    """Depth that a camera measured (0: none) and has, where it looks at the facing surface [m]."""
    p = se3.apply(T, surface.p_m[facing(T_object_base, view, surface)])
    p = se3.apply(se3.invert(view.T_base_depth), p)
    row, column, inside = pixels_of(view.depth_camera, p)
    return view.depth_m[row[inside], column[inside]], p[inside, 2]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0


@dataclass(frozen=True, kw_only=True)
class ScannedSurfaces:
    """What the scene adds to a task's shapes."""

    surfaces: dict[str, MeshSurface] = field(default_factory=dict)
    """By object, in its own frame."""
    hashes: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the mesh each was read from."""


def scanned_surfaces(run: RunFolder, task: Task) -> ScannedSurfaces:
    """Read the meshes of a task's scanned objects, as far as the scene has reconstructed them."""
    found, library = ScannedSurfaces(), Library.of(run, read_record(run))
    for key in library.scanned(task):
        folder = library.folder / key
        about = folder / "object.json"
        if task.objects[key].shape != SCANNED or not about.is_file():
            continue
        try:
            source = json.loads(about.read_text())["shape_source"]
        except (ValueError, KeyError, TypeError) as error:
            found_ = f"does not say where its shape comes from ({error!r})"
            raise UnreadableSceneError(path=about, found=found_) from error
        if source == TASK_SHAPE:
            continue
        found.surfaces[key] = mesh_surface(*read_mesh(folder / MESH))
        found.hashes[key] = provenance.hash_file(folder / MESH)
    return found


POINT_SIGMA_M = 0.002
"""Standard error of one voxel-averaged point."""
TUKEY_M = 0.008
"""Residuals beyond this have no say."""
ITERATIONS = 12
MIN_EXPLAINED = 0.6
"""Share of an object's points that its shape must explain."""
SHARED_ERROR = 9.0
"""Neighbouring pixels share their error: this many count as one."""
CAMERA_SIGMA_M = 0.002
"""Prior of a camera's position error, per axis."""
CAMERA_SIGMA_RAD = 0.004
"""Prior of a camera's rotation error, per axis; it acts through the distance."""
UPRIGHT_SIGMA_RAD = 0.02
"""Prior of roll and pitch of what stands."""
MAX_POINTS = 1500
"""Enough for the fit; more are thinned out evenly."""
OUTLINE_WINDOW_M = 0.012
"""Edges farther than this from the nominal outline belong to something else."""
LEVEL_RAD = 1e-5
"""Prior of roll and pitch of a box: they are not estimated."""

_POSE = 6
_PER_VIEW = 2
_STEPS = (1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3)
"""For the derivatives of outlines: metres, then radians."""
_SIDES = [
    Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    for angles in ((0, 0, 0), (90, 0, 0), (-90, 0, 0), (180, 0, 0), (0, 90, 0), (0, -90, 0))
]


START_STEP_RAD = np.radians(30)
"""Between turns about the vertical that are tried."""
NUM_REFINED = 3
"""Of them, the best are followed to the end."""
COARSE_POINTS = 150
"""Points of the first steps."""
SEE_THROUGH_M = 0.012
"""A camera that measures this much behind the mesh sees through it."""
AMBIGUOUS = 1.2
"""A second pose whose score, cameras put right, is within this factor of the best is as good:
the covariance then covers both."""


@dataclass(frozen=True, kw_only=True)
class MeshFit:
    """A surface laid onto what was seen."""

    T_base_object: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    """Of (x, y, z, rotation about x, y, z), base frame [m^2, m rad, rad^2]."""
    residual_m: float
    """Root mean square distance of the explained points to the surface."""
    explained: float
    """Share of points within the Tukey bound."""
    seen_through: float
    """Share of the facing surface that cameras saw through."""
    score: float
    """Lower is better."""


@dataclass(frozen=True, kw_only=True)
class _Problem:
    surface: MeshSurface
    cluster: Cluster
    points: Sequence[Float[np.ndarray, "_ 3"]]
    """Those of the cluster that each view saw."""
    views: Sequence[CameraView]
    tilt_sigma_rad: float
    prior: Float[np.ndarray, " num_shifts"]
    """Information of each view's shift in x and y."""
    outlines: Sequence[Outline] = ()


def fit_mesh(
    cluster: Cluster,
    views: Sequence[CameraView],
    surface: MeshSurface,
    *,
    tilt_sigma_rad: float,
    yaw_period_rad: float = 2 * np.pi,
    lying: bool = False,
    box: ObjectModel | None = None,
) -> MeshFit:
    """Find the pose at which a surface best agrees with what was seen.

    It starts upright in turns about the vertical, the middle over that of the points, the tops at
    one height.

    Args:
        views: What the cameras saw, in the order of the cluster's ``view_ids``.
        tilt_sigma_rad: Prior of roll and pitch: small for what stands, large for what may lie.
        lying: Try all six sides, each in half as many turns.
        box: It is laid onto its outlines, too, in a shrinking window.
    """
    cluster = cluster.thinned(MAX_POINTS)
    centre = cluster.p_base.mean(axis=0)
    prior = []
    for view in views:
        distance = float(np.linalg.norm(view.T_base_depth[:3, 3] - centre))
        sigma = np.hypot(CAMERA_SIGMA_M, CAMERA_SIGMA_RAD * distance)
        prior += [1 / sigma**2] * _PER_VIEW
    few = cluster.thinned(COARSE_POINTS)
    problem = _Problem(
        surface=surface,
        cluster=cluster,
        points=cluster.by_view(len(views)),
        views=views,
        tilt_sigma_rad=tilt_sigma_rad,
        prior=np.array(prior),
    )
    coarse = replace(
        problem,
        surface=MeshSurface(p_m=surface.p_m[::3], normals=surface.normals[::3]),
        cluster=few,
        points=few.by_view(len(views)),
    )
    sides, step_rad = (_SIDES, 2 * START_STEP_RAD) if lying else (_SIDES[:1], START_STEP_RAD)
    yaws = np.arange(0.0, yaw_period_rad - 1e-9, step_rad)
    first = [T for side in sides for T in _starts(problem, yaws, side)]
    unshifted = np.zeros((len(views), _PER_VIEW))
    tried = [_icp(T, unshifted, coarse, iterations=6, wide=4.0)[0] for T in first]
    scores = [_score(T, unshifted, coarse)[0] for T in tried]
    best = [tried[index] for index in np.argsort(scores)[:NUM_REFINED]]
    ends = [_icp(T, unshifted, problem, iterations=ITERATIONS, wide=2.0) for T in best]
    # With each camera where the fit found it: what cameras are off by makes every pose look bad,
    # the right one too. With it, one that is turned by 50 degrees scores within a tenth of the
    # right one; without, four times as high.
    compared = [(_score(T, shifts, problem)[0], T, shifts) for T, shifts in ends]
    compared.sort(key=lambda item: item[0])
    least, T, shifts = compared[0]
    rivals = [R for score, R, _ in compared[1:] if score < AMBIGUOUS * least]
    if box is not None:
        for window_m in (2 * OUTLINE_WINDOW_M, OUTLINE_WINDOW_M):
            problem = replace(problem, outlines=find_outlines(views, box, T, window_m))
            T, shifts = _icp(T, shifts, problem, iterations=ITERATIONS, wide=2.0)
    return _summary(T, shifts, rivals, problem, yaw_period_rad)


def fit_box(cluster: Cluster, views: Sequence[CameraView], model: ObjectModel) -> MeshFit:
    """Find the pose of a box that stands, open or not, by its points and outlines."""
    fit = fit_mesh(
        cluster,
        views,
        known_surface(model, BOX_SAMPLES),
        tilt_sigma_rad=LEVEL_RAD,
        yaw_period_rad=yaw_period_rad(model),
        box=model,
    )
    T, covariance = fit.T_base_object, fit.covariance
    covariance[[3, 4], [3, 4]] = UPRIGHT_SIGMA_RAD**2
    level = pose_of(np.array([*T[:3, 3], np.arctan2(T[1, 0], T[0, 0])]))
    return replace(fit, T_base_object=level, covariance=covariance)


def _starts(
    problem: _Problem, yaws_rad: Float[np.ndarray, " num_yaws"], side: Float[np.ndarray, "3 3"]
) -> list[Float[np.ndarray, "4 4"]]:
    """Standing on one side, turned about the vertical, the middle over that of the points."""
    p = problem.cluster.p_base
    low, high = np.percentile(p, [2, 98], axis=0)
    top = float((problem.surface.p_m @ side[2]).max())
    standing = se3.from_rotation(side, np.zeros(3))
    state = np.array([*(low + high)[:2] / 2, high[2] - top, 0.0])
    return [pose_of(state + np.array([0, 0, 0, yaw])) @ standing for yaw in yaws_rad]


def _residuals(
    T: Float[np.ndarray, "4 4"], shifts: Float[np.ndarray, "num_views 2"], problem: _Problem
) -> tuple[Float[np.ndarray, " num_points"], Float[np.ndarray, "num_points 8"], np.ndarray]:
    """Signed distances, derivatives by pose and by the own view's shift, and view ids."""
    rows, jacobians, ids = [], [], []
    T_object_base = se3.invert(T)
    for view_id, (view, p) in enumerate(zip(problem.views, problem.points, strict=True)):
        seen = facing(T_object_base, view, problem.surface)
        if len(p) == 0 or seen.sum() < 10:
            continue
        moved = T.copy()
        moved[:2, 3] += shifts[view_id]
        q, n = problem.surface.p_m[seen], problem.surface.normals[seen]
        local = se3.apply(se3.invert(moved), p)
        # Each tree is asked once: one that is made quickly beats one that answers quickly.
        _, nearest = cKDTree(q, balanced_tree=False, compact_nodes=False).query(local)
        n = n[nearest]
        gap = local - q[nearest]
        r = np.einsum("ij,ij->i", gap, n)
        # Beside the mesh the plane is no surface: the plain distance counts there.
        far = lengths(gap)
        r = np.where(far > 2 * np.abs(r) + TUKEY_M, far, r)
        rows.append(r)
        normal = n @ T[:3, :3].T
        turning = np.cross(p - moved[:3, 3], normal)
        jacobians.append(-np.concatenate([normal, turning, normal[:, :2]], axis=1))
        ids.append(np.full(len(r), view_id))
    if not rows:
        return np.zeros(0), np.zeros((0, _POSE + _PER_VIEW)), np.zeros(0, dtype=np.int64)
    return np.concatenate(rows), np.concatenate(jacobians), np.concatenate(ids)


def _outline_residuals(
    T: Float[np.ndarray, "4 4"], shifts: Float[np.ndarray, "num_views 2"], outline: Outline
) -> tuple[Float[np.ndarray, " num_edges"], Float[np.ndarray, "num_edges 8"], np.ndarray]:
    """The same for the edges of one outline; derivatives by small steps."""
    moved = T.copy()
    moved[:2, 3] += shifts[outline.view_id]
    r, columns = outline_distances(outline, moved), []
    for axis, step in enumerate(np.diag(_STEPS)):
        beside = moved.copy()
        beside[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ moved[:3, :3]
        beside[:3, 3] += step[:3]
        columns.append((outline_distances(outline, beside) - r) / _STEPS[axis])
    J = np.column_stack([*columns, *columns[:_PER_VIEW]])
    return r, J, np.full(len(r), outline.view_id)


def _pose_equations(
    T: Float[np.ndarray, "4 4"],
    shifts: Float[np.ndarray, "num_views 2"],
    problem: _Problem,
    bound_m: float,
    damping: Float[np.ndarray, "6"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return H, the gradient and the residuals of the points."""
    rows = [_residuals(T, shifts, problem)]
    rows += [_outline_residuals(T, shifts, outline) for outline in problem.outlines]
    r, J8, ids = (np.concatenate([row[k] for row in rows]) for k in range(3))
    sigmas_m = [POINT_SIGMA_M, *(outline.sigma_m for outline in problem.outlines)]
    sigma_m = np.repeat(sigmas_m, [len(row[0]) for row in rows])
    J = np.zeros((len(r), _POSE + shifts.size))
    J[:, :_POSE] = J8[:, :_POSE]
    for axis in range(_PER_VIEW):
        J[np.arange(len(r)), _POSE + _PER_VIEW * ids + axis] = J8[:, _POSE + axis]
    weight = tukey_weights(r, bound_m) / sigma_m**2 / SHARED_ERROR
    H, gradient = normal_equations(J, r, weight)
    H += np.diag(np.concatenate([damping, problem.prior]))
    gradient[_POSE:] += problem.prior * shifts.ravel()
    # Roll and pitch: the vertical of the object should stay near the base's.
    information = 1 / problem.tilt_sigma_rad**2
    up = T[:3, 2]
    H[[3, 4], [3, 4]] += information
    gradient[3:5] += information * np.array([-up[1], up[0]])
    return H, gradient, rows[0][0]


def _icp(
    T: Float[np.ndarray, "4 4"],
    shifts: Float[np.ndarray, "num_views 2"],
    problem: _Problem,
    *,
    iterations: int,
    wide: float,
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "num_views 2"]]:
    """Gauss-Newton with correspondences anew in each step and a bound that shrinks."""
    damping = 1 / np.array([0.03, 0.03, 0.03, 0.3, 0.3, 0.3]) ** 2
    for iteration in range(iterations):
        bound = TUKEY_M * max(1.0, wide * (1 - iteration / max(iterations - 2, 1)))
        H, gradient, _ = _pose_equations(T, shifts, problem, bound, damping)
        step = np.clip(-np.linalg.solve(H, gradient), -0.3, 0.3)
        T = T.copy()
        T[:3, :3] = Rotation.from_rotvec(step[3:6]).as_matrix() @ T[:3, :3]
        T[:3, 3] += np.clip(step[:3], -0.03, 0.03)
        shifts = shifts + step[_POSE:].reshape(shifts.shape)
        if np.abs(step).max() < 1e-5:
            break
    return T, shifts


def _score(
    T: Float[np.ndarray, "4 4"],
    shifts: Float[np.ndarray, "num_views 2"],
    problem: _Problem,
) -> tuple[float, float]:
    """Return the mean bounded distance in bounds plus the share seen through, and that share."""
    r, _, _ = _residuals(T, shifts, problem)
    misfit = float(np.minimum(np.abs(r) / TUKEY_M, 1.0).mean()) if len(r) else 1.0
    through = seen_through(T, problem.surface, problem.views, SEE_THROUGH_M, shifts)
    return misfit + through, through


def _summary(
    T: Float[np.ndarray, "4 4"],
    shifts: Float[np.ndarray, "num_views 2"],
    rivals: Sequence[Float[np.ndarray, "4 4"]],
    problem: _Problem,
    period_rad: float,
) -> MeshFit:
    # Limits on what is told were set with the cameras where they are said to be.
    score, through = _score(T, np.zeros_like(shifts), problem)
    turns_rad = [_turn(T[:3, :3].T @ R[:3, :3], period_rad) for R in rivals]
    weak = 1 / np.array([0.05, 0.05, 0.05, 1.0, 1.0, 1.0]) ** 2
    H, _, r = _pose_equations(T, shifts, problem, TUKEY_M, weak)
    covariance = np.linalg.inv(H)[:_POSE, :_POSE].copy()
    covariance[2, 2] += CAMERA_SIGMA_M**2
    covariance[5, 5] += sum((turn / 2) ** 2 for turn in turns_rad if turn > np.radians(30))
    near = np.abs(r) < TUKEY_M
    return MeshFit(
        T_base_object=T,
        covariance=(covariance + covariance.T) / 2,
        residual_m=float(np.sqrt(np.mean(r[near] ** 2))) if near.any() else 0.0,
        explained=float(near.mean()) if len(near) else 0.0,
        seen_through=through,
        score=score,
    )


def _turn(R: Float[np.ndarray, "3 3"], period_rad: float) -> float:
    """Smallest angle of a rotation among those that differ by the symmetry about z [rad]."""
    turns = np.arange(0.0, 2 * np.pi - 1e-9, period_rad)
    spun = [R @ Rotation.from_euler("z", turn).as_matrix() for turn in turns]
    return min(float(se3.rotation_angle_rad(rotation)) for rotation in spun)
