"""Lay a known shape onto points and outlines by Gauss-Newton: x, y, z and yaw.

Seen from outside, the outline of a box, open or not, is the convex hull of its eight projected
corners. Outlines do not depend on the depth scale, and cover the edges that depth blurs.

Each view also gets a shift and a turn of its own, with a prior: cameras disagree by more than
their pixels' noise, and a nearby camera sees more of the truth. Objects stand upright: roll and
pitch are not estimated, and their share of the covariance is a given prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from bridge.task.task_file import ObjectModel
from twin.scene.frames.downscaled import pixels_of
from twin.scene.least_squares import normal_equations, tukey_weights
from twin.scene.localise.points import CameraView, Cluster, likeness
from twin.scene.shape.known import pose_of, starts, surface_distances

EDGE_LIKENESS = 0.5
"""Half object, half background."""
OCCLUDER_M = 0.012
"""Something this much nearer than the edge hides the object's true outline."""
BESIDE_PX = 3.0


@dataclass(frozen=True, kw_only=True)
class Outline:
    """Edge points of an object's colour in one view."""

    view_id: int
    view: CameraView
    edge_px: Float[np.ndarray, "num_edges 2"]
    sigma_m: float
    """Standard error of one edge point, at the object's distance."""
    px_m: float
    """Size of a pixel at the object's distance."""


def corners(model: ObjectModel) -> Float[np.ndarray, "8 3"]:
    """Outer corners in the object frame [m]."""
    size = np.array(model.size_m)
    lift_m = 0.0 if model.origin_at_centre else size[2] / 2
    return np.asarray(box_corners(size) + np.array([0.0, 0.0, lift_m]))


def find_outlines(
    views: Sequence[CameraView],
    model: ObjectModel,
    T_base_object: Float[np.ndarray, "4 4"],
    window_m: float,
) -> list[Outline]:
    """Collect the edge points near the nominal pose of the object.

    Points at the image border and points beside something nearer are left out: there the object
    goes on.
    """
    outlines = []
    for view_id, view in enumerate(views):
        p_camera = se3.apply(se3.invert(view.T_base_color) @ T_base_object, corners(model))
        if np.any(p_camera[:, 2] < 0.05):
            continue
        uv, z = view.color_camera.project(p_camera)
        px_m = float(z.mean()) / view.color_camera.fx
        margin_px, (height, width) = window_m / px_m, view.image_linear.shape[:2]
        low = np.maximum(np.floor(uv.min(axis=0) - margin_px).astype(int), 0)
        high = np.minimum(np.ceil(uv.max(axis=0) + margin_px).astype(int), (width, height))
        if np.any(high - low < 3):
            continue
        rows, columns = slice(low[1], high[1]), slice(low[0], high[0])
        score = likeness(view.image_linear[rows, columns], model.color_srgb)
        edge, outward = _crossings(np.minimum(score, 1.0))
        edge = edge + np.array([columns.start, rows.start])
        free = ~_occluded(view, edge + BESIDE_PX * outward, float(z.min()))
        if free.any():
            outlines.append(
                Outline(
                    view_id=view_id,
                    view=view,
                    edge_px=edge[free],
                    sigma_m=OUTLINE_SIGMA_PX * px_m,
                    px_m=px_m,
                )
            )
    return outlines


def _crossings(
    score: Float[np.ndarray, "height width"],
) -> tuple[Float[np.ndarray, "num_edges 2"], Float[np.ndarray, "num_edges 2"]]:
    """Sub-pixel places (x, y) where neighbouring pixels pass the edge level, and the way out."""
    edges, outwards = [], []
    for axis in (0, 1):
        first = score[:-1] if axis == 0 else score[:, :-1]
        second = score[1:] if axis == 0 else score[:, 1:]
        row, column = np.nonzero((first >= EDGE_LIKENESS) != (second >= EDGE_LIKENESS))
        a, b = first[row, column], second[row, column]
        fraction = (EDGE_LIKENESS - a) / (b - a)
        step = np.array([0.0, 1.0]) if axis == 0 else np.array([1.0, 0.0])
        centre = np.stack([column, row], axis=1) + 0.5
        edges.append(centre + fraction[:, None] * step)
        outwards.append(np.where((a > b)[:, None], step, -step))
    return np.concatenate(edges), np.concatenate(outwards)


def _occluded(
    view: CameraView, beside_px: Float[np.ndarray, "num_edges 2"], nearest_m: float
) -> Bool[np.ndarray, " num_edges"]:
    """Whether what lies just outside an edge is nearer than the object; True off the image."""
    camera = view.color_camera
    ray = np.column_stack(
        [
            (beside_px[:, 0] - camera.cx) / camera.fx,
            (beside_px[:, 1] - camera.cy) / camera.fy,
            np.ones(len(beside_px)),
        ]
    )
    T_depth_color = se3.invert(view.T_base_depth) @ view.T_base_color
    p_depth = se3.apply(T_depth_color, ray * nearest_m)
    row, column, inside = pixels_of(view.depth_camera, p_depth)
    inside &= np.all((beside_px >= 0) & (beside_px < (camera.width, camera.height)), axis=1)
    depth = view.depth_m[np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.asarray(~inside | ((depth > 0) & (depth < nearest_m - OCCLUDER_M)))


def outline_distances(
    outline: Outline, model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " num_edges"]:
    """Signed distance of each edge point to the predicted outline, positive outside [m]."""
    T_camera_object = se3.invert(outline.view.T_base_color) @ T_base_object
    uv, _ = outline.view.color_camera.project(se3.apply(T_camera_object, corners(model)))
    hull = ConvexHull(uv)
    normals, offsets = hull.equations[:, :2], hull.equations[:, 2]
    beyond = outline.edge_px @ normals.T + offsets
    # Outside, beyond a corner, the largest half-plane distance is a lower bound; close enough.
    return np.asarray(beyond.max(axis=1)) * outline.px_m


_POSE = 4
_PER_VIEW = 3
_STEPS = (1e-4, 1e-4, 1e-4, 1e-3)


POINT_SIGMA_M = 0.002
"""Standard error of one voxel-averaged point."""
OUTLINE_SIGMA_PX = 0.7
"""Standard error of one edge point."""
OUTLINE_WINDOW_M = 0.012
"""Edges farther than this from the nominal outline belong to something else."""
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
"""Prior of roll and pitch, which are not estimated."""
MAX_POINTS = 1500
"""Enough for the fit; more are thinned out evenly."""


@dataclass(frozen=True, kw_only=True)
class ShapeFit:
    """A shape laid onto what was seen."""

    T_base_object: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    """Of (x, y, z, rotation about x, y, z), base frame [m^2, m rad, rad^2]."""
    residual_m: float
    """Root mean square distance of the explained points to the surface."""
    explained: float
    """Share of points within the Tukey bound."""


@dataclass(frozen=True, kw_only=True)
class _Problem:
    """What the residuals are made of."""

    cluster: Cluster
    outlines: Sequence[Outline]
    model: ObjectModel
    prior_sigma: Float[np.ndarray, "num_views 3"]
    """Of each view's shift in x and y and of its turn."""


@dataclass(frozen=True, kw_only=True)
class _System:
    """Residuals at one state, with derivatives and standard errors; points come first."""

    r: Float[np.ndarray, " num_residuals"]
    J: Float[np.ndarray, "num_residuals num_unknowns"]
    sigma: Float[np.ndarray, " num_residuals"]
    num_points: int


def fit_shape(
    cluster: Cluster,
    views: Sequence[CameraView],
    model: ObjectModel,
) -> ShapeFit:
    """Find the pose whose surface and outline best agree with what was seen.

    Several starts (yaw from the smallest rectangle, centre from each visible side) are fitted to
    the points; the best one is refined with the outlines, looked for in a shrinking window.
    """
    cluster = cluster.thinned(MAX_POINTS)
    centre = cluster.p_base.mean(axis=0)
    distances = [float(np.linalg.norm(view.T_base_depth[:3, 3] - centre)) for view in views]
    sideways = [np.hypot(CAMERA_SIGMA_M, CAMERA_SIGMA_RAD * d) for d in distances]
    prior = np.array([[s, s, CAMERA_SIGMA_RAD] for s in sideways])
    problem = _Problem(cluster=cluster, outlines=(), model=model, prior_sigma=prior)
    free = np.zeros(_PER_VIEW * len(views))
    candidates = [
        _solve(np.concatenate([state, free]), problem) for state in starts(cluster.p_base, model)
    ]
    best = min(
        candidates,
        key=lambda state: np.minimum(np.abs(_system(state, problem).r), TUKEY_M).mean(),
    )
    for window_m in (2 * OUTLINE_WINDOW_M, OUTLINE_WINDOW_M):
        outlines = find_outlines(
            views,
            model,
            pose_of(best[:_POSE]),
            window_m,
        )
        problem = _Problem(cluster=cluster, outlines=outlines, model=model, prior_sigma=prior)
        best = _solve(best, problem)
    return _summary(best, problem)


def _in_view(state: Float[np.ndarray, " num_unknowns"], view_id: int) -> Float[np.ndarray, "4"]:
    """(x, y, z, yaw) as one view sees it."""
    first = _POSE + _PER_VIEW * view_id
    dx, dy, turn = state[first : first + _PER_VIEW]
    return np.asarray(state[:_POSE] + np.array([dx, dy, 0.0, turn]))


def _system(state: Float[np.ndarray, " num_unknowns"], problem: _Problem) -> _System:
    model, cluster = problem.model, problem.cluster
    blocks = []
    for view_id in range(len(problem.prior_sigma)):
        points = cluster.p_base[cluster.view_ids == view_id]
        own = _in_view(state, view_id)
        r, gradient = surface_distances(points, model, pose_of(own))
        offset = points - own[:3]
        # Moving the shape by d changes the distance by -gradient . d; yaw moves by z x offset.
        yaw = gradient[:, 0] * offset[:, 1] - gradient[:, 1] * offset[:, 0]
        J = np.column_stack([-gradient, yaw])
        blocks.append((view_id, r, J, POINT_SIGMA_M))
    num_points = sum(len(block[1]) for block in blocks)
    for outline in problem.outlines:
        own = _in_view(state, outline.view_id)
        r = outline_distances(outline, model, pose_of(own))
        columns = [
            (outline_distances(outline, model, pose_of(own + step)) - r) / step.sum()
            for step in np.diag(_STEPS)
        ]
        blocks.append((outline.view_id, r, np.column_stack(columns), outline.sigma_m))
    J = np.zeros((sum(len(block[1]) for block in blocks), len(state)))
    row = 0
    for view_id, r, J_block, _ in blocks:
        rows = slice(row, row + len(r))
        J[rows, :_POSE] = J_block
        first = _POSE + _PER_VIEW * view_id
        J[rows, first : first + _PER_VIEW] = J_block[:, [0, 1, 3]]
        row += len(r)
    return _System(
        r=np.concatenate([block[1] for block in blocks]),
        J=J,
        sigma=np.concatenate([np.full(len(block[1]), block[3]) for block in blocks]),
        num_points=num_points,
    )


def _pose_equations(
    state: Float[np.ndarray, " num_unknowns"],
    system: _System,
    weight: Float[np.ndarray, " num_residuals"],
    problem: _Problem,
    damping: Float[np.ndarray, "4"],
) -> tuple[Float[np.ndarray, "num_unknowns num_unknowns"], Float[np.ndarray, " num_unknowns"]]:
    """Return H and the gradient, with the views' priors and damping on the pose."""
    information = weight / system.sigma**2 / SHARED_ERROR
    prior = 1 / problem.prior_sigma.ravel() ** 2
    H, gradient = normal_equations(system.J, system.r, information)
    H += np.diag(np.concatenate([damping, prior]))
    gradient[_POSE:] += prior * state[_POSE:]
    return H, gradient


def _solve(
    state: Float[np.ndarray, " num_unknowns"], problem: _Problem
) -> Float[np.ndarray, " num_unknowns"]:
    """Gauss-Newton with Tukey weights whose bound shrinks to ``tukey_m``."""
    damping = 1 / np.array([0.05, 0.05, 0.05, 0.5]) ** 2
    for iteration in range(ITERATIONS):
        bound = TUKEY_M * max(1.0, 3.0 - 0.5 * iteration)
        system = _system(state, problem)
        weight = tukey_weights(system.r, bound)
        H, gradient = _pose_equations(state, system, weight, problem, damping)
        step = -np.linalg.solve(H, gradient)
        state = state + np.clip(step, -0.05, 0.05)
        if np.linalg.norm(step) < 1e-6:
            break
    return state


def _summary(state: Float[np.ndarray, " num_unknowns"], problem: _Problem) -> ShapeFit:
    system = _system(state, problem)
    near = np.abs(system.r) < TUKEY_M
    on_points = near[: system.num_points]
    weak = 1 / np.array([0.05, 0.05, 0.05, 1.0]) ** 2
    H, _ = _pose_equations(state, system, near.astype(np.float64), problem, weak)
    covariance = np.zeros((6, 6))
    pose_ids = [0, 1, 2, 5]
    covariance[np.ix_(pose_ids, pose_ids)] = np.linalg.inv(H)[:_POSE, :_POSE]
    covariance[2, 2] += CAMERA_SIGMA_M**2
    covariance[[3, 4], [3, 4]] = UPRIGHT_SIGMA_RAD**2
    points_r = system.r[: system.num_points][on_points]
    return ShapeFit(
        T_base_object=pose_of(state[:_POSE]),
        covariance=covariance,
        residual_m=float(np.sqrt(np.mean(points_r**2))) if len(points_r) else 0.0,
        explained=float(on_points.mean()),
    )
