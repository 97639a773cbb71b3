"""Move views that disagree by millimetres onto what all of them saw, and onto the plane."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from bridge.geometry import se3
from twin.scene.shape.masked_view import MaskedView

MAX_POINTS = 500
"""Points of one view that are compared."""
MAX_HEIGHTS = 400
"""Points of the plane that one view contributes."""
NORMAL_PX = 2
"""Normals come from pixels this far to each side."""
FLAT_M = 0.015
"""Pixels whose neighbours differ by more have no normal."""
NORMAL_M = 0.02
"""A normal turned by one radian counts like this distance: two sides of a wall do not meet."""
NEIGHBOURS = 24
MIN_NEIGHBOURS = 3
"""Points of other views that a point is compared with, at most and at least."""
REACH_M = 0.012
"""Points farther from what others saw, or from the plane, are not asked."""
PLANE_AROUND_M = 0.08
"""How far around the object the plane is looked at."""
POINT_SIGMA_M = 0.001
SHARED_ERROR = 9.0
"""Standard error of a point, and how many neighbouring points share one error."""
SHIFT_SIGMA_M, TURN_SIGMA_RAD = 0.006, 0.002
"""How far a view may be moved; holds what the points leave open. The plane says most of the turns,
and a small object says little about them."""
OFFSET_SIGMA_M = 0.0005
"""How wrong a sensor's depth may be beyond what shifts explain."""
CONVERGED = 2e-5
"""Smaller steps, in metres and radians, change nothing."""


@dataclass(frozen=True)
class _Surface:
    """Oriented points of one view, and points of the plane around, each with its ray."""

    points: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    rays: Float[np.ndarray, "num_points 3"]
    """How a point moves when depth grows."""
    plane: Float[np.ndarray, "num_plane 3"]
    plane_rays: Float[np.ndarray, "num_plane 3"]


@dataclass(frozen=True)
class _State:
    """What is being found."""

    moves: Float[np.ndarray, "num_views 6"]
    """Of each view: its shift [m], then its turn about the pivot [rad]."""
    offsets_m: Float[np.ndarray, " num_sensors"]
    """Added to the depth of each sensor."""
    sensors: Int[np.ndarray, " num_views"]
    """Number of each view's sensor."""
    pivot: Float[np.ndarray, "3"]

    def motion(self, view: int) -> Float[np.ndarray, "4 4"]:
        """Turn about the pivot, then shift."""
        T = np.eye(4)
        T[:3, :3] = se3.rotation_from_vector(self.moves[view, 3:])
        T[:3, 3] = self.pivot - T[:3, :3] @ self.pivot + self.moves[view, :3]
        return T

    def placed(self, view: int, points: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Points of a view where they are now thought to be."""
        deeper = points + self.offsets_m[self.sensors[view]] * rays
        return np.asarray(se3.apply(self.motion(view), deeper))


def laid_together(
    views: Sequence[MaskedView], support_z_m: float | None, rounds: int
) -> tuple[list[MaskedView], float]:
    """Move each view so that its points lie on those of the others, and its plane on the plane.

    Robust point-to-plane steps for all views at once. Together is essential: views from around an
    object that all stand a little too far out agree with their neighbours to a fraction of the
    error, so moving one after the other hardly undoes what makes the whole too thin or too thick.
    Each sensor's depth gets one offset: an error along the rays widens what it sees of near things
    across, which no motion undoes. Compared with the mean of points that face the same way, not
    with a carved shape: where views disagree carving takes away more than it leaves. What nothing
    but the poses says (where the object is on the plane) stays as it was on average.

    Args:
        views: What a shape will be made from.
        support_z_m: Height of the plane; None without one.
        rounds: How many steps at most; 0 changes nothing.

    Returns:
        The moved views, and the root mean square of the shifts [m].
    """
    if rounds == 0:
        return list(views), 0.0
    surfaces = [_surface(view, support_z_m) for view in views]
    seen = [surface.points for surface in surfaces if len(surface.points)]
    if not seen:
        return list(views), 0.0
    names, sensors = np.unique([view.sensor for view in views], return_inverse=True)
    state = _State(
        moves=np.zeros((len(views), 6)),
        offsets_m=np.zeros(len(names)),
        sensors=sensors,
        pivot=np.concatenate(seen).mean(axis=0),
    )
    for _ in range(rounds):
        step = _step(surfaces, state, support_z_m)
        split = state.moves.size
        state = replace(
            state,
            moves=state.moves + step[:split].reshape(state.moves.shape),
            offsets_m=state.offsets_m + step[split:],
        )
        if np.abs(step).max() < CONVERGED:
            break
    moved = [
        replace(
            view,
            T_base_camera=state.motion(index) @ view.T_base_camera,
            depth_m=_deeper(view, float(state.offsets_m[sensors[index]])),
        )
        for index, view in enumerate(views)
    ]
    return moved, float(np.sqrt(np.square(state.moves[:, :3]).sum(axis=1).mean()))


def _deeper(view: MaskedView, offset_m: float) -> Float[np.ndarray, "height width"]:
    depth = view.known_depth_m()
    return np.where(depth > 0, np.maximum(depth + np.float32(offset_m), 0.0), depth)


def _step(
    surfaces: Sequence[_Surface], state: _State, support_z_m: float | None
) -> Float[np.ndarray, " num_unknowns"]:
    """One Gauss-Newton step on the moves of all views, then the offsets of all sensors."""
    H, gradient = _agreement(surfaces, state)
    if support_z_m is not None:
        for index, surface in enumerate(surfaces):
            H_plane, g_plane = _on_plane(surface, index, state, support_z_m)
            own = np.append(np.arange(6 * index, 6 * index + 6), _column(state, index))
            H[np.ix_(own, own)] += H_plane
            gradient[own] += g_plane
    sigma = np.concatenate(
        [
            np.tile(np.repeat([SHIFT_SIGMA_M, TURN_SIGMA_RAD], 3), len(surfaces)),
            np.full(len(state.offsets_m), OFFSET_SIGMA_M),
        ]
    )
    gradient += np.concatenate([state.moves.ravel(), state.offsets_m]) / sigma**2
    step = -np.linalg.solve(H + np.diag(1 / sigma**2), gradient)
    return np.asarray(np.clip(step, -REACH_M, REACH_M))


def _column(state: _State, view: int) -> int:
    return int(state.moves.size + state.sensors[view])


def _agreement(surfaces: Sequence[_Surface], state: _State) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of "my point lies in the plane through the mean of the others'"."""
    each = list(enumerate(surfaces))
    points = np.concatenate([state.placed(k, s.points, s.rays) for k, s in each])
    normals = np.concatenate([s.normals @ state.motion(k)[:3, :3].T for k, s in each])
    rays = np.concatenate([s.rays for s in surfaces])
    owner = np.repeat(np.arange(len(surfaces)), [len(s.points) for s in surfaces])
    places = np.concatenate([points, NORMAL_M * normals], axis=1)
    count = min(NEIGHBOURS, len(points))
    away, index = cKDTree(places).query(places, k=count, distance_upper_bound=REACH_M)
    away, index = away.reshape(len(points), -1), index.reshape(len(points), -1)
    index = np.minimum(index, len(points) - 1)
    others = np.isfinite(away) & (owner[index] != owner[:, None])
    rows = np.flatnonzero(others.sum(axis=1) >= MIN_NEIGHBOURS)
    others, index = others[rows], index[rows]
    weight = others / np.maximum(others.sum(axis=1, keepdims=True), 1)
    middle = np.einsum("nk,nki->ni", weight, points[index])
    slope = np.einsum("nk,nki->ni", weight, normals[index])
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
    distance = np.einsum("ni,ni->n", slope, points[rows] - middle)
    # The others move too, each by its share of the mean; they are near enough for one lever.
    line = np.arange(len(rows))
    share = np.zeros((len(rows), len(surfaces)))
    np.add.at(share, (line[:, None], owner[index]), -weight)
    share[line, owner[rows]] += 1.0
    lever = np.concatenate([slope, np.cross(points[rows] - state.pivot, slope)], axis=1)
    J = np.zeros((len(rows), state.moves.size + len(state.offsets_m)))
    J[:, : state.moves.size] = (share[:, :, None] * lever[:, None, :]).reshape(len(rows), -1)
    sensor = state.moves.size + state.sensors[owner]
    along = np.einsum("ni,nki->nk", slope, rays[index])
    np.add.at(J, (line[:, None], sensor[index]), -weight * along)
    J[line, sensor[rows]] += np.einsum("ni,ni->n", slope, rays[rows])
    return _normal_equations(J, distance)


def _on_plane(
    surface: _Surface, view: int, state: _State, support_z_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of "my plane is the plane" for one view and its sensor."""
    p = state.placed(view, surface.plane, surface.plane_rays)
    height = p[:, 2] - support_z_m
    near = np.abs(height) < REACH_M
    arm = p[near] - state.pivot
    up = np.tile([0.0, 0.0, 1.0], (len(arm), 1))
    J = np.concatenate([up, np.cross(arm, up), surface.plane_rays[near, 2:]], axis=1)
    return _normal_equations(J, height[near])


def _normal_equations(J: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Robustly weighted (Cauchy) sums over rows."""
    if len(distance) == 0:
        return np.zeros((J.shape[1], J.shape[1])), np.zeros(J.shape[1])
    scale = max(float(np.median(np.abs(distance))), 1e-4)
    weight = 1.0 / (1.0 + (distance / (2 * scale)) ** 2) / (POINT_SIGMA_M**2 * SHARED_ERROR)
    weighted = J * weight[:, None]
    return weighted.T @ J, weighted.T @ distance


def _surface(view: MaskedView, support_z_m: float | None) -> _Surface:
    """Oriented points of the object, evenly picked, and points of what lies around it."""
    camera, depth = view.camera, view.known_depth_m().astype(np.float64)
    p = camera.unproject(depth)
    n = NORMAL_PX
    inner = (slice(n, -n), slice(n, -n))
    ok = view.mask[inner] & (depth[inner] > 0)
    ends = []
    for rows, columns in ((0, n), (0, -n), (n, 0), (-n, 0)):
        part = (
            slice(n + rows, camera.height - n + rows),
            slice(n + columns, camera.width - n + columns),
        )
        ok &= view.mask[part] & (np.abs(depth[part] - depth[inner]) < FLAT_M)
        ends.append(p[part])
    row, column = np.nonzero(ok)
    step = max(1, len(row) // MAX_POINTS)
    row, column = row[::step], column[::step]
    right, left, below, above = (end[row, column] for end in ends)
    normals = np.cross(below - above, right - left)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points = p[inner][row, column]
    away = np.einsum("ni,ni->n", normals, points) > 0
    normals[away] *= -1
    T, R = view.T_base_camera, view.T_base_camera[:3, :3]
    rays = points / np.maximum(points[:, 2:], 1e-9)
    points = se3.apply(T, points)
    plane = np.zeros((0, 3))
    if support_z_m is not None and len(points):
        plane = _around(view, p, points)
    plane_rays = plane / np.maximum(plane[:, 2:], 1e-9)
    return _Surface(points, normals @ R.T, rays @ R.T, se3.apply(T, plane), plane_rays @ R.T)


def _around(
    view: MaskedView,
    p_camera: Float[np.ndarray, "height width 3"],
    points: Float[np.ndarray, "num_points 3"],
) -> Float[np.ndarray, "num_around 3"]:
    """Measured points around the object that are not the object's, in the camera's frame."""
    row, column = np.nonzero(~view.mask & (p_camera[..., 2] > 0))
    around = p_camera[row, column]
    xy = se3.apply(view.T_base_camera, around)[:, :2]
    low, high = points.min(axis=0) - PLANE_AROUND_M, points.max(axis=0) + PLANE_AROUND_M
    around = around[np.all((xy > low[:2]) & (xy < high[:2]), axis=1)]
    return np.asarray(around[:: max(1, len(around) // MAX_HEIGHTS)])
