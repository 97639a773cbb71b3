"""Move views that disagree by millimetres onto what all of them saw, and onto the plane."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from bridge.geometry import se3
from twin.scene.frames.rgbd import NORMAL_REACH_PX, oriented
from twin.scene.least_squares import normal_equations
from twin.scene.shape.carve import MaskedView

MAX_POINTS = 500
"""Points of one view that are compared."""
MAX_HEIGHTS = 400
"""Points of the plane that one view contributes."""
FLAT_M = 0.015
"""Pixels whose neighbours differ by more have no normal."""
BENT_M = 0.004
"""Across an edge depth bends by more, and a normal would be that of neither side."""
PLANE_AROUND_M = 0.08
"""How far around the object the plane is looked at."""


@dataclass(frozen=True)
class SeenSurface:
    """Oriented points of one view, and points of the plane around, all in the camera's frame."""

    T_base_camera: Float[np.ndarray, "4 4"]
    points: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    """Unit length, towards the camera."""
    plane: Float[np.ndarray, "num_plane 3"]


def seen_surface(view: MaskedView, *, with_plane: bool) -> SeenSurface:
    """Pick the object's oriented points evenly, and what was measured around it."""
    depth = view.known_depth_m().astype(np.float64)
    p = view.camera.unproject(depth)
    seen = view.mask & (depth > 0)
    row, column, towards = oriented(np.moveaxis(p, -1, 0), seen, seen)
    n, own = NORMAL_REACH_PX, depth[row, column]
    ok = np.ones(len(row), dtype=bool)
    for down, right in ((0, n), (n, 0)):
        ends = [depth[row + sign * down, column + sign * right] - own for sign in (-1, 1)]
        ok &= (np.abs(ends) < FLAT_M).all(axis=0) & (np.abs(ends[0] + ends[1]) < BENT_M)
    chosen = np.flatnonzero(ok)
    chosen = chosen[:: max(1, len(chosen) // MAX_POINTS)]
    points, normals = p[row[chosen], column[chosen]], towards[:, chosen].T
    plane = np.zeros((0, 3))
    if with_plane and len(points):
        plane = _around(view, p, points)
    return SeenSurface(view.T_base_camera, points, normals, plane)


def _around(
    view: MaskedView,
    p_camera: Float[np.ndarray, "height width 3"],
    points: Float[np.ndarray, "num_points 3"],
) -> Float[np.ndarray, "num_around 3"]:
    """Measured points around the object that are not the object's, in the camera's frame."""
    row, column = np.nonzero(~view.mask & (p_camera[..., 2] > 0))
    around = p_camera[row, column]
    xy = se3.apply(view.T_base_camera, around)[:, :2]
    own = se3.apply(view.T_base_camera, points)[:, :2]
    low, high = own.min(axis=0) - PLANE_AROUND_M, own.max(axis=0) + PLANE_AROUND_M
    around = around[np.all((xy > low) & (xy < high), axis=1)]
    return np.asarray(around[:: max(1, len(around) // MAX_HEIGHTS)])


NORMAL_M = 0.02
"""A normal turned by one radian counts like this distance: two sides of a wall do not meet."""
NEIGHBOURS = 24
MIN_NEIGHBOURS = 3
"""Points of other views that a point is compared with, at most and at least."""
REACH_M = 0.012
"""Points farther from what others saw, or from the plane, are not asked."""
POINT_SIGMA_M = 0.001
SHARED_ERROR = 9.0
"""Standard error of a point, and how many neighbouring points share one error."""
SHIFT_SIGMA_M, TURN_SIGMA_RAD = 0.002, 0.002
"""How far one view may be moved by itself; holds what the points leave open."""
MOUNT_SHIFT_SIGMA_M, MOUNT_TURN_SIGMA_RAD = 0.005, 0.006
"""How wrong a sensor's place on what carries it may be: all its views share that."""
OFFSET_SIGMA_M, SCALE_SIGMA = 0.003, 0.005
"""How wrong a sensor's depth may be, at any distance and per metre."""
CONVERGED = 2e-5
"""Smaller steps, in metres and radians, change nothing."""
OWN, SHARED = 6, 8
"""Unknowns of a view (shift, turn) and of a sensor (shift, turn, offset, scale)."""


@dataclass(frozen=True)
class _State:
    """What is being found."""

    moves: Float[np.ndarray, "num_views 6"]
    """Of each view in base: its shift [m], then its turn about the pivot [rad]."""
    errors: Float[np.ndarray, "num_sensors 8"]
    """Of each sensor in its own frame: shift [m], turn [rad], depth offset [m], depth scale."""
    sensors: Int[np.ndarray, " num_views"]
    """Number of each view's sensor."""
    pivot: Float[np.ndarray, "3"]

    def pose(self, view: int, T_base_camera: Float[np.ndarray, "4 4"]) -> np.ndarray:
        """Where a view's camera is now thought to be."""
        shift_m, turn = np.split(self.moves[view], 2)
        R, mount = se3.rotation_from_vector(turn), self.errors[self.sensors[view]]
        T = se3.from_rotation(R, self.pivot - R @ self.pivot + shift_m)
        return np.asarray(T @ T_base_camera @ se3.small_motion(np.r_[mount[3:6], mount[:3]]))

    def deeper(self, view: int, points: Float[np.ndarray, "num_points 3"]) -> np.ndarray:
        """Points of a view, in its camera's frame, with the depth as it is now thought to be."""
        offset, scale = self.errors[self.sensors[view], 6:]
        return np.asarray(points * (1 + scale + offset / np.maximum(points[:, 2:], 1e-9)))

    def columns(self, sensor: int) -> slice:
        """Where a sensor's unknowns are."""
        first = self.moves.size + SHARED * sensor
        return slice(first, first + SHARED)


@dataclass(frozen=True)
class _Placed:
    """All points of all views where they are now thought to be."""

    owner: Int[np.ndarray, " num_points"]
    """View of each point."""
    p_camera: Float[np.ndarray, "num_points 3"]
    p_base: Float[np.ndarray, "num_points 3"]
    normals: Float[np.ndarray, "num_points 3"]
    """In base."""
    Rs: Float[np.ndarray, "num_views 3 3"]
    """Rotations camera to base."""


def laid_together(
    views: Sequence[MaskedView], support_z_m: float | None, rounds: int
) -> list[MaskedView]:
    """Move each view so that its points lie on those of the others, and its plane on the plane.

    Robust point-to-plane steps for all views at once. Together is essential: views from around an
    object that all stand a little too far out agree with their neighbours to a fraction of the
    error, so moving one after the other hardly undoes what makes the whole too thin or too thick.
    What one sensor gets wrong in every view (where it sits on what carries it, its depth by an
    offset and by a factor) is one set of unknowns; a single view is moved little beyond that.
    Compared with the mean of points that face the same way, not with a carved shape: where views
    disagree carving takes away more than it leaves. On average the object stays where the poses as
    given have it.
    """
    if rounds == 0:
        return list(views)
    surfaces = [seen_surface(view, with_plane=support_z_m is not None) for view in views]
    seen = [se3.apply(s.T_base_camera, s.points) for s in surfaces if len(s.points)]
    if not seen:
        return list(views)
    names, sensors = np.unique([view.sensor for view in views], return_inverse=True)
    state = _State(
        moves=np.zeros((len(views), OWN)),
        errors=np.zeros((len(names), SHARED)),
        sensors=sensors,
        pivot=np.concatenate(seen).mean(axis=0),
    )
    for _ in range(rounds):
        step = _step(surfaces, state, support_z_m)
        split = state.moves.size
        state = replace(
            state,
            moves=state.moves + step[:split].reshape(state.moves.shape),
            errors=state.errors + step[split:].reshape(state.errors.shape),
        )
        if np.abs(step).max() < CONVERGED:
            break
    before, after = np.concatenate(seen), _placed(surfaces, state).p_base
    T_back = _back(before, after, on_plane=support_z_m is not None)
    return [_moved(view, index, state, T_back) for index, view in enumerate(views)]


def _back(
    before: Float[np.ndarray, "num_points 3"],
    after: Float[np.ndarray, "num_points 3"],
    *,
    on_plane: bool,
) -> Float[np.ndarray, "4 4"]:
    """Undo what only the poses as given can say: where the object is, and which way it looks.

    On the plane that is a shift along it and a turn about its normal, in the air a shift.
    """
    T = np.eye(4)
    middles = before.mean(axis=0), after.mean(axis=0)
    if on_plane:
        a, b = (p[:, :2] - middle[:2] for p, middle in zip((before, after), middles, strict=True))
        yaw = np.arctan2(np.sum(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]), np.sum(a * b))
        T[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, yaw]))
    T[:3, 3] = middles[0] - T[:3, :3] @ middles[1]
    if on_plane:
        T[2, 3] = 0.0
    return T


def _moved(
    view: MaskedView, index: int, state: _State, T_back: Float[np.ndarray, "4 4"]
) -> MaskedView:
    offset, scale = state.errors[state.sensors[index], 6:].astype(np.float32)
    depth = view.known_depth_m()
    return replace(
        view,
        T_base_camera=T_back @ state.pose(index, view.T_base_camera),
        depth_m=np.where(depth > 0, np.maximum(depth * (1 + scale) + offset, 0.0), depth),
    )


def _step(
    surfaces: Sequence[SeenSurface], state: _State, support_z_m: float | None
) -> Float[np.ndarray, " num_unknowns"]:
    """One Gauss-Newton step on the moves of all views, then the errors of all sensors."""
    H, gradient = _agreement(surfaces, state)
    if support_z_m is not None:
        for view, surface in enumerate(surfaces):
            H_plane, g_plane = _on_plane(surface, view, state, support_z_m)
            shared = state.columns(int(state.sensors[view]))
            own = np.r_[OWN * view : OWN * view + OWN, shared]
            H[np.ix_(own, own)] += H_plane
            gradient[own] += g_plane
    own_sigma = np.repeat([SHIFT_SIGMA_M, TURN_SIGMA_RAD], 3)
    mount_sigma = np.repeat([MOUNT_SHIFT_SIGMA_M, MOUNT_TURN_SIGMA_RAD], 3)
    sensor_sigma = np.concatenate([mount_sigma, [OFFSET_SIGMA_M, SCALE_SIGMA]])
    sigma = np.concatenate(
        [np.tile(own_sigma, len(state.moves)), np.tile(sensor_sigma, len(state.errors))]
    )
    gradient += np.concatenate([state.moves.ravel(), state.errors.ravel()]) / sigma**2
    step = -np.linalg.solve(H + np.diag(1 / sigma**2), gradient)
    return np.asarray(np.clip(step, -REACH_M, REACH_M))


def _placed(surfaces: Sequence[SeenSurface], state: _State) -> _Placed:
    Ts = [state.pose(k, s.T_base_camera) for k, s in enumerate(surfaces)]
    p_camera = [state.deeper(k, s.points) for k, s in enumerate(surfaces)]
    pairs = list(zip(Ts, surfaces, strict=True))
    return _Placed(
        owner=np.repeat(np.arange(len(surfaces)), [len(s.points) for s in surfaces]),
        p_camera=np.concatenate(p_camera),
        p_base=np.concatenate([se3.apply(T, p) for T, p in zip(Ts, p_camera, strict=True)]),
        normals=np.concatenate([s.normals @ T[:3, :3].T for T, s in pairs]),
        Rs=np.stack([T[:3, :3] for T in Ts]),
    )


def _agreement(surfaces: Sequence[SeenSurface], state: _State) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of "my point lies in the plane through the mean of the others'"."""
    placed = _placed(surfaces, state)
    p, normals, owner = placed.p_base, placed.normals, placed.owner
    places = np.concatenate([p, NORMAL_M * normals], axis=1)
    count = min(NEIGHBOURS, len(p))
    away, index = cKDTree(places).query(places, k=count, distance_upper_bound=REACH_M)
    away, index = away.reshape(len(p), -1), index.reshape(len(p), -1)
    index = np.minimum(index, len(p) - 1)
    others = np.isfinite(away) & (owner[index] != owner[:, None])
    rows = np.flatnonzero(others.sum(axis=1) >= MIN_NEIGHBOURS)
    others, index = others[rows], index[rows]
    weight = others / np.maximum(others.sum(axis=1, keepdims=True), 1)
    middle = np.einsum("nk,nki->ni", weight, p[index])
    slope = np.einsum("nk,nki->ni", weight, normals[index])
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
    distance = np.einsum("ni,ni->n", slope, p[rows] - middle)
    # The others move too, each by its share of the mean; they are near enough for one lever.
    line = np.arange(len(rows))
    share = np.zeros((len(rows), len(surfaces)))
    np.add.at(share, (line[:, None], owner[index]), -weight)
    share[line, owner[rows]] += 1.0
    lever = np.concatenate([slope, np.cross(p[rows] - state.pivot, slope)], axis=1)
    J = np.zeros((len(rows), state.moves.size + state.errors.size))
    J[:, : state.moves.size] = (share[:, :, None] * lever[:, None, :]).reshape(
        len(rows), state.moves.size
    )
    own = np.einsum("ni,nij->nj", slope, placed.Rs[owner[rows]])
    mine = slope_by_sensor(own, placed.p_camera[rows])
    turned = np.einsum("ni,nkij->nkj", slope, placed.Rs[owner[index]])
    theirs = slope_by_sensor(turned, placed.p_camera[index])
    for sensor in range(len(state.errors)):
        same = (state.sensors[owner[rows]] == sensor).astype(np.float64)
        part = weight * (state.sensors[owner[index]] == sensor)
        J[:, state.columns(sensor)] = same[:, None] * mine - np.einsum("nk,nkc->nc", part, theirs)
    return _robust_equations(J, distance)


def slope_by_sensor(
    slope: Float[np.ndarray, "*batch 3"], p: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 8"]:
    """Derivative of a point's distance along a slope by the errors of its sensor."""
    along = np.sum(slope * p, axis=-1, keepdims=True)
    offset = along / np.maximum(p[..., 2:], 1e-9)
    return np.concatenate([slope, np.cross(p, slope), offset, along], axis=-1)


def _on_plane(
    surface: SeenSurface, view: int, state: _State, support_z_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of "my plane is the plane" for one view and its sensor."""
    T = state.pose(view, surface.T_base_camera)
    p_camera = state.deeper(view, surface.plane)
    p = se3.apply(T, p_camera)
    height = p[:, 2] - support_z_m
    near = np.abs(height) < REACH_M
    arm = p[near] - state.pivot
    up = np.tile([0.0, 0.0, 1.0], (len(arm), 1))
    shared = slope_by_sensor(up @ T[:3, :3], p_camera[near])
    J = np.concatenate([up, np.cross(arm, up), shared], axis=1)
    return _robust_equations(J, height[near])


def _robust_equations(J: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Robustly weighted (Cauchy) sums over rows."""
    if len(distance) == 0:
        return np.zeros((J.shape[1], J.shape[1])), np.zeros(J.shape[1])
    scale = max(float(np.median(np.abs(distance))), 1e-4)
    weight = 1.0 / (1.0 + (distance / (2 * scale)) ** 2) / (POINT_SIGMA_M**2 * SHARED_ERROR)
    return normal_equations(J, distance, weight)
