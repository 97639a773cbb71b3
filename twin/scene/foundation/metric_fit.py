"""Lay a shape of unknown size and place onto measured points: rotation, translation and scale.

A generated shape is only roughly as large and only roughly where it seems. Depth is metric, so the
last word is a robust registration with seven degrees of freedom against it: point to plane (Chen
and Medioni 1992), Tukey's weights, one scale, and the lowest point set on what it stands on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bridge.geometry.mesh import sample_triangles
from twin.errors import TwinError
from twin.scene.least_squares import tukey_weights


class MetricFitError(TwinError):
    """The shape does not lie on the measured points, whatever its size and place."""


def sample_surface(
    vertices: Float[np.ndarray, "num_vertices 3"],
    faces: Int[np.ndarray, "num_faces 3"],
    num_samples: int,
    seed: int,
) -> tuple[Float[np.ndarray, "num_samples 3"], Float[np.ndarray, "num_samples 3"]]:
    """Points spread evenly over triangles, and the unit normals there.

    Args:
        vertices: In any unit.
        faces: Vertex indices of each triangle.
        num_samples: How many points.
        seed: Of the draw.

    Raises:
        MetricFitError: When the triangles have no area.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    if not len(faces) or not area.sum() > 0.0 or not np.isfinite(area).all():
        message = f"the shape's {len(faces)} triangles have no area; generate it again."
        raise MetricFitError(message)
    chosen, u, v = sample_triangles(area, num_samples, np.random.default_rng(seed))
    a, b, c = np.moveaxis(corners[chosen], 1, 0)
    points = a + u * (b - a) + v * (c - a)
    return points, normals[chosen] / area[chosen][:, None]


def visible_mask(
    points_m: Float[np.ndarray, "num_samples 3"],
    normals: Float[np.ndarray, "num_samples 3"],
    camera_centres_m: Float[np.ndarray, "num_views 3"],
    cell_m: float,
) -> Bool[np.ndarray, " num_samples"]:
    """Which samples of a surface some camera sees: the nearest in their direction, within a cell.

    Directions are sorted into cells as wide as ``cell_m`` at the object's distance.

    Args:
        points_m: Points on the surface, in the frame of the cameras.
        normals: Unit length, outwards.
        camera_centres_m: Where the cameras are.
        cell_m: Width of the cells that the directions are sorted into.
    """
    seen = np.zeros(len(points_m), dtype=bool)
    for centre in camera_centres_m:
        ray = points_m - centre
        distance = np.linalg.norm(ray, axis=1)
        forward = ray.mean(axis=0) / np.linalg.norm(ray.mean(axis=0))
        helper = np.eye(3)[np.argmin(np.abs(forward))]
        right = np.cross(forward, helper)
        right /= np.linalg.norm(right)
        plane = ray @ np.stack([right, np.cross(forward, right)], axis=1)
        along = np.maximum(ray @ forward, 1e-9)
        cells = np.floor(plane / along[:, None] * (distance.mean() / cell_m)).astype(np.int64)
        cells -= cells.min(axis=0)
        key = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
        _, key = np.unique(key, return_inverse=True)
        nearest = np.full(key.max() + 1, np.inf)
        np.minimum.at(nearest, key, distance)
        # A slanted surface is deeper across one cell than a frontal one.
        slant = np.abs((ray * normals).sum(axis=1)) / distance
        allowed = 1.5 * cell_m / np.maximum(slant, 0.3)
        seen |= distance <= nearest[key] + allowed
    return seen


def surface_area(
    vertices: Float[np.ndarray, "num_vertices 3"], faces: Int[np.ndarray, "num_faces 3"]
) -> float:
    """Of all triangles, in squared units of the vertices.

    Args:
        vertices: In any unit.
        faces: Vertex indices of each triangle.
    """
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


@dataclass(frozen=True, kw_only=True)
class MetricFitConfig:
    """How a shape is laid onto points, and when the result counts."""

    num_samples: int = 8000
    """Points spread over the shape's surface; the coarse rounds use a quarter of them."""
    max_points: int = 3000
    """Measured points that take part, spread evenly over those given."""
    rounds: tuple[tuple[float, float], ...] = (
        (0.5, 0.2),
        (0.2, 0.2),
        (0.08, 0.05),
        (0.03, 0.0),
        (0.015, 0.0),
    )
    """Of each round: Tukey's cut in extents of the measured points, and the weight of the pull of
    the visible surface towards the points. That pull fixes the size roughly and is a little off
    wherever visibility is, so it fades."""
    num_coarse_rounds: int = 2
    """Rounds that every start goes through; only the best goes on."""
    iterations: int = 15
    """Steps of each round."""
    yaw_starts_rad: tuple[float, ...] = (0.0, 0.35, -0.35, 0.8, -0.8)
    """Turns about the vertical that the fit is started from."""
    max_scale_change: float = 5.0
    """The size may change by this factor at most, up or down."""
    max_snap_m: float = 0.015
    """A larger gap between the shape and its support is left alone and reported."""
    min_inlier_fraction: float = 0.7
    """Share of measured points that must lie on the shape."""
    inlier_fraction_of_extent: float = 0.05
    """A point lies on the shape when it is nearer than this share of the extent, or 3 mm."""
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class MetricFit:
    """Where the shape is and how large: ``p_base = scale R p_shape + t``."""

    T_base_shape: Float[np.ndarray, "4 4"]
    """Rotation and translation; scale first."""
    scale: float
    """Metres per unit of the shape."""
    residual_m: float
    """Median distance of the measured points on the shape."""
    inlier_fraction: float
    """Share of measured points on the shape."""
    support_gap_m: float | None
    """Lowest point above the support before it was set down; None without a support."""
    is_snapped: bool
    """Whether it was set on its support."""

    def apply(self, vertices: Float[np.ndarray, "num_vertices 3"]) -> np.ndarray:
        """Carry points of the shape to the root frame [m]."""
        R, t = self.T_base_shape[:3, :3], self.T_base_shape[:3, 3]
        return np.asarray(self.scale * vertices @ R.T + t)


@dataclass(frozen=True, kw_only=True)
class _Similarity:
    """x' = scale R x + t."""

    R: np.ndarray
    t: np.ndarray
    scale: float

    def apply(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(self.scale * points @ self.R.T + self.t)

    def after(
        self, omega: np.ndarray, tau: np.ndarray, log_scale: float, pivot: np.ndarray
    ) -> "_Similarity":
        """Turn, shift and grow about a pivot."""
        turn, grow = Rotation.from_rotvec(omega).as_matrix(), float(np.exp(log_scale))
        t = grow * turn @ (self.t - pivot) + pivot + tau
        return _Similarity(R=turn @ self.R, t=t, scale=self.scale * grow)


@dataclass(frozen=True, kw_only=True)
class _Problem:
    """What stays the same through all starts."""

    samples: np.ndarray
    normals: np.ndarray
    spacing: float
    """Between neighbouring samples, in units of the shape."""
    vertices: np.ndarray
    points: np.ndarray
    points_tree: cKDTree
    centres_m: np.ndarray
    support_z_m: float | None
    extent_m: float
    config: MetricFitConfig


def fit_metric(
    vertices: Float[np.ndarray, "num_vertices 3"],
    faces: Int[np.ndarray, "num_faces 3"],
    points_m: Float[np.ndarray, "num_points 3"],
    camera_centres_m: Sequence[Float[np.ndarray, "3"]],
    T_base_shape: Float[np.ndarray, "4 4"],
    scale: float,
    support_z_m: float | None,
    config: MetricFitConfig | None = None,
) -> MetricFit:
    """Find size and place of a shape from points measured on it.

    Measured points pull the surface along its normals; the visible part of the surface pulls
    towards the points, which fixes size where a flat side leaves it open; the support holds from
    below. The best of several starts is kept. Deterministic.

    Args:
        vertices: Of the shape, in its own units and frame.
        faces: Triangles of the shape; their winding does not matter.
        points_m: Measured on the object in the root frame, from any number of views.
        camera_centres_m: Where it was seen from, in the root frame.
        T_base_shape: First guess of the pose.
        scale: First guess of the size, metres per unit.
        support_z_m: Height of what it stands on, in the root frame with z up; None: in the air.
        config: Settings; the defaults when None.

    Raises:
        MetricFitError: When too little was measured, the shape is degenerate, or the points do not
            lie on it in the end.
    """
    config = config or MetricFitConfig()
    problem = _problem(vertices, faces, points_m, camera_centres_m, support_z_m, config)
    guess = _Similarity(R=T_base_shape[:3, :3], t=T_base_shape[:3, 3], scale=scale)
    pivot = guess.apply(problem.samples).mean(axis=0)
    few = len(problem.samples) // 4  # they stand in random order
    rough = replace(
        problem,
        samples=problem.samples[:few],
        normals=problem.normals[:few],
        spacing=problem.spacing * 2.0,
    )
    coarse = []
    for yaw in config.yaw_starts_rad:
        start = guess.after(np.array([0.0, 0.0, yaw]), np.zeros(3), 0.0, pivot)
        found = _solve(_adapt(start, rough), rough, config.rounds[: config.num_coarse_rounds])
        coarse.append((_cost(found, rough), found))
    best = min(coarse, key=lambda pair: pair[0])[1]
    best = _solve(best, problem, config.rounds[config.num_coarse_rounds :])
    return _judge(best, guess, problem)


def _problem(
    vertices: np.ndarray,
    faces: np.ndarray,
    points_m: np.ndarray,
    camera_centres_m: Sequence[np.ndarray],
    support_z_m: float | None,
    config: MetricFitConfig,
) -> _Problem:
    points = points_m[np.isfinite(points_m).all(axis=1)]
    if len(points) < 50 or not camera_centres_m:
        message = (
            f"{len(points)} measured points from {len(camera_centres_m)} views are too few to give "
            "a shape its size; at least 50 points from 1 view are needed."
        )
        raise MetricFitError(message)
    samples, normals = sample_surface(vertices, faces, config.num_samples, config.seed)
    chosen = np.linspace(0, len(points) - 1, min(len(points), config.max_points)).astype(int)
    points = points[chosen].astype(np.float64)
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    return _Problem(
        samples=samples,
        normals=normals,
        spacing=float(np.sqrt(surface_area(vertices, faces) / config.num_samples)),
        vertices=vertices[np.unique(faces)],
        points=points,
        points_tree=cKDTree(points),
        centres_m=np.stack(camera_centres_m),
        support_z_m=support_z_m,
        extent_m=float(np.linalg.norm(high - low)),
        config=config,
    )


def _adapt(start: _Similarity, problem: _Problem) -> _Similarity:
    """Bring the visible part to the size and centre of what was measured."""
    current = start
    for _ in range(3):  # what is visible changes a little with the size
        moved = current.apply(problem.samples)
        seen = moved[_visible(current, problem)]
        spread = np.linalg.norm(seen - seen.mean(axis=0), axis=1).mean()
        wanted = np.linalg.norm(problem.points - problem.points.mean(axis=0), axis=1).mean()
        shift = problem.points.mean(axis=0) - seen.mean(axis=0)
        grow = float(np.log(wanted / max(spread, 1e-12)))
        current = current.after(np.zeros(3), shift, grow, seen.mean(axis=0))
    return current


def _visible(current: _Similarity, problem: _Problem) -> np.ndarray:
    moved = current.apply(problem.samples)
    normals = problem.normals @ current.R.T
    size = float(np.linalg.norm(np.ptp(moved, axis=0)))
    return visible_mask(moved, normals, problem.centres_m, max(size, 1e-6) / 40.0)


def _solve(
    start: _Similarity, problem: _Problem, rounds: Sequence[tuple[float, float]]
) -> _Similarity:
    current = start
    for fraction, pull in rounds:
        reach = max(fraction * problem.extent_m, 0.002)
        seen = _visible(current, problem)
        for _ in range(problem.config.iterations):
            step = _step(current, seen, reach, pull, problem)
            if step is None:
                break
            current = step[0]
            if step[1] < 1e-5 * problem.extent_m:
                break
    return current


def _step(
    current: _Similarity, seen: np.ndarray, reach: float, pull: float, problem: _Problem
) -> tuple[_Similarity, float] | None:
    """One Gauss-Newton step on (turn, shift, log scale) about the centre of what is visible."""
    surface = current.apply(problem.samples[seen])
    normals = problem.normals[seen] @ current.R.T
    if len(surface) < 20:
        return None
    pivot = surface.mean(axis=0)
    H, g = np.zeros((7, 7)), np.zeros(7)
    distance, near = cKDTree(surface).query(problem.points)
    gap = ((surface[near] - problem.points) * normals[near]).sum(axis=1)
    # Between samples a point lies on the surface all the same: only the gap counts.
    is_near = distance < reach + 2.0 * problem.spacing * current.scale
    weight = tukey_weights(gap, reach) * is_near / len(problem.points)
    _add(H, g, surface[near] - pivot, normals[near], gap, weight)
    distance, near = problem.points_tree.query(surface)
    weight = tukey_weights(distance, reach) / len(surface)
    for axis in np.eye(3):  # point to point: the outline holds the size
        gap = (surface - problem.points[near]) @ axis
        _add(H, g, surface - pivot, np.broadcast_to(axis, surface.shape), gap, pull * weight)
    if problem.support_z_m is not None:
        lowest = _lowest(current.apply(problem.samples))
        up = np.array([[0.0, 0.0, 1.0]])
        gap = np.array([lowest[2] - problem.support_z_m])
        _add(
            H,
            g,
            (lowest - pivot)[None],
            up,
            gap,
            tukey_weights(np.abs(gap), 2 * problem.config.max_snap_m),
        )
    # Angles count in radians, shifts in metres: the extent makes them alike.
    unit = np.array([1.0] * 3 + [problem.extent_m] * 3 + [1.0])
    scaled = H * unit[:, None] * unit[None, :]
    damping = 1e-4 * np.trace(scaled) / 7.0
    if not damping > 0.0:
        return None
    step = -unit * np.linalg.solve(scaled + damping * np.eye(7), g * unit)
    step[:3] *= min(1.0, 0.3 / max(float(np.linalg.norm(step[:3])), 1e-12))
    step[6] = float(np.clip(step[6], -0.2, 0.2))
    moved = float(np.abs(step / unit).max() * problem.extent_m)
    return current.after(step[:3], step[3:6], float(step[6]), pivot), moved


def _add(
    H: np.ndarray,
    g: np.ndarray,
    arm: np.ndarray,
    direction: np.ndarray,
    gap: np.ndarray,
    weight: np.ndarray,
) -> None:
    """Add rows with residual ``gap`` along ``direction`` of surface points at ``arm``."""
    along = (arm * direction).sum(axis=1, keepdims=True)
    J = np.concatenate([np.cross(arm, direction), direction, along], axis=1)
    H += J.T @ (J * weight[:, None])
    g += J.T @ (gap * weight)


def _lowest(moved: np.ndarray) -> np.ndarray:
    """Centre of the lowest hundredth of the points: one spike does not carry the shape."""
    count = max(1, len(moved) // 100)
    return np.asarray(moved[np.argpartition(moved[:, 2], count - 1)[:count]].mean(axis=0))


def _distances(current: _Similarity, problem: _Problem) -> np.ndarray:
    """Of the measured points from the surface along its normals, or to the next sample if far."""
    moved = current.apply(problem.samples)
    distance, near = cKDTree(moved).query(problem.points)
    normals = problem.normals[near] @ current.R.T
    along = np.abs(((moved[near] - problem.points) * normals).sum(axis=1))
    is_between = distance < 2.0 * problem.spacing * current.scale
    return np.asarray(np.where(is_between, along, distance))


def _cost(current: _Similarity, problem: _Problem) -> float:
    """Mean capped distance both ways, relative to the extent."""
    cap = 0.1 * problem.extent_m
    there = np.minimum(_distances(current, problem), cap).mean()
    surface = current.apply(problem.samples[_visible(current, problem)])
    back = np.minimum(problem.points_tree.query(surface)[0], cap).mean()
    return float(there + 0.5 * back) / problem.extent_m


def _judge(best: _Similarity, guess: _Similarity, problem: _Problem) -> MetricFit:
    config = problem.config
    gap_m, is_snapped = None, False
    if problem.support_z_m is not None:
        gap_m = float(_lowest(best.apply(problem.vertices))[2] - problem.support_z_m)
        if abs(gap_m) <= config.max_snap_m:
            shift = np.array([0.0, 0.0, -gap_m])
            best = best.after(np.zeros(3), shift, 0.0, np.zeros(3))
            is_snapped = True
    near_m = max(0.003, config.inlier_fraction_of_extent * problem.extent_m)
    distance = _distances(best, problem)
    inlier_fraction = float((distance < near_m).mean())
    change = best.scale / guess.scale
    if not 1.0 / config.max_scale_change <= change <= config.max_scale_change:
        message = (
            f"the shape would have to be {change:.2g} times as large as it was said to be; "
            "check the mask and the depth it was generated from."
        )
        raise MetricFitError(message)
    if inlier_fraction < config.min_inlier_fraction:
        message = (
            f"only {inlier_fraction:.0%} of the measured points lie within {near_m * 1e3:.1f} mm "
            f"of the shape, {config.min_inlier_fraction:.0%} are needed. The shape is not that of "
            "this object; generate it again from another view."
        )
        raise MetricFitError(message)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = best.R, best.t
    return MetricFit(
        T_base_shape=T,
        scale=float(best.scale),
        residual_m=float(np.median(distance[distance < near_m])),
        inlier_fraction=inlier_fraction,
        support_gap_m=gap_m,
        is_snapped=is_snapped,
    )
