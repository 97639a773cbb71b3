"""The robot's place to the millimetre: robust point-to-plane with the depth scale as an unknown.

Depth cameras measure one or two percent too long or too short. A rigid fit turns that into
centimetres, because it moves the robot towards or away from each camera. A seventh unknown, the
scale of the depth about each camera's centre, takes it up (design page on perception, section 5).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.robot.surface import PosedSurface
from twin.scene.align.view import RobotView, ViewCloud
from twin.scene.least_squares import normal_equations, tukey_weights

FACING = 0.5
"""Cosine between the measured normal and the description's, below which a match is none."""
MIN_PER_LINK = 200
TABLE_M = 0.012
"""Points this near to the plane of the base are the table, not the robot's foot."""
SCALE_SIGMA = 0.03
"""What is known of the depth scale beforehand."""
STOP = 5e-6
"""Metres, radians and share of the depth: steps below change nothing that can be measured."""


COARSE = ((0.08, 10), (0.03, 6))
FINE = ((0.03, 6), (0.02, 6), (0.012, 12))
"""Annealing of Tukey's loss: gate [m] and iterations of each stage."""


@dataclass(frozen=True, kw_only=True)
class ScenePose:
    """Where the scene lies in the robot's base frame."""

    T_base_source: Float[np.ndarray, "4 4"]
    depth_scale: float = 1.0
    """True depth divided by measured depth."""


@dataclass(frozen=True, kw_only=True)
class Equations:
    """Weighted normal equations of matched points."""

    H: Float[np.ndarray, "7 7"]
    g: Float[np.ndarray, "7"]
    residual_m: float
    """Weighted root mean square distance to the surface."""
    num_points: int


def refine(
    views: Sequence[RobotView],
    surfaces: Sequence[PosedSurface],
    start: ScenePose,
    *,
    stages: Sequence[tuple[float, int]],
    num_points: int,
    with_scale: bool = True,
) -> tuple[ScenePose, Equations]:
    """Lay measured points on the posed surface: Gauss-Newton with Tukey's weights.

    Args:
        num_points: At most this many points of all views, at least 200 of each visible link.
        with_scale: Whether the depth scale is estimated; otherwise the fit is rigid.
    """
    rng = np.random.default_rng(0)
    pose = start
    equations = None
    for gate_m, iterations in stages:
        clouds = [
            _choose(view, surface, pose, gate_m, num_points // len(views), rng)
            for view, surface in zip(views, surfaces, strict=True)
        ]
        for _ in range(iterations):
            equations = _equations(views, clouds, surfaces, pose, gate_m)
            pose, step = _stepped(pose, equations, with_scale)
            if np.abs(step).max() < STOP:
                break
    if equations is None:
        message = "refining needs at least one stage of one iteration"
        raise ValueError(message)
    return pose, equations


def _choose(
    view: RobotView,
    surface: PosedSurface,
    pose: ScenePose,
    gate_m: float,
    count: int,
    rng: np.random.Generator,
) -> ViewCloud:
    """Measured points near the robot: proportional to visible area, but enough of each link."""
    cloud = view.cloud
    p = se3.apply(pose.T_base_source @ view.T_source_camera, pose.depth_scale * cloud.p_m)
    near = surface.near_box(p, gate_m)
    near = near[rng.permutation(len(near))[: 4 * count]]
    found = surface.nearest(p[near])
    kept = found.distance_m < gate_m
    near, link_ids = near[kept], found.link_ids[kept]
    order = np.argsort(link_ids, kind="stable")
    first = np.searchsorted(link_ids[order], link_ids[order])
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - first
    sure = np.flatnonzero(rank < MIN_PER_LINK)
    others = np.flatnonzero(rank >= MIN_PER_LINK)[: max(count - len(sure), 0)]
    return cloud.take(near[np.concatenate([sure, others])])


def _equations(
    views: Sequence[RobotView],
    clouds: Sequence[ViewCloud],
    surfaces: Sequence[PosedSurface],
    pose: ScenePose,
    gate_m: float,
) -> Equations:
    rows = [
        _rows(view, cloud, surface, pose, gate_m)
        for view, cloud, surface in zip(views, clouds, surfaces, strict=True)
    ]
    J, r, w = (np.concatenate([row[k] for row in rows]) for k in range(3))
    H, g = normal_equations(J, r, w)
    residual_m = float(np.sqrt((w * r * r).sum() / max(w.sum(), 1e-12)))
    return Equations(H=H, g=g, residual_m=residual_m, num_points=int((w > 0).sum()))


def _rows(
    view: RobotView, cloud: ViewCloud, surface: PosedSurface, pose: ScenePose, gate_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Jacobian (shift, turn, scale), distance and weight of each point."""
    T = pose.T_base_source @ view.T_source_camera
    p = se3.apply(T, pose.depth_scale * cloud.p_m)
    found = surface.nearest(p)
    n = found.normals
    r = np.einsum("ij,ij->i", n, p - found.p_m)
    facing = np.abs(np.einsum("ij,ij->i", n, cloud.normals @ T[:3, :3].T))
    w = tukey_weights(found.distance_m, gate_m)
    w[(facing < FACING) | (np.abs(p[:, 2]) < TABLE_M)] = 0.0
    stretch = np.einsum("ij,ij->i", n, cloud.p_m @ T[:3, :3].T)
    J = np.concatenate([n, np.cross(p, n), stretch[:, None]], axis=1)
    return J, r, w


def _stepped(
    pose: ScenePose, equations: Equations, with_scale: bool
) -> tuple[ScenePose, Float[np.ndarray, "7"]]:
    H, g = equations.H.copy(), equations.g.copy()
    if with_scale:
        prior = max(equations.residual_m, 1e-4) ** 2 / SCALE_SIGMA**2
        H[6, 6] += prior
        g[6] += prior * (pose.depth_scale - 1.0)
    else:
        H[6], H[:, 6], g[6], H[6, 6] = 0.0, 0.0, 0.0, 1.0
    step = -np.linalg.lstsq(H, g, rcond=1e-12)[0]
    T = se3.small_motion(np.concatenate([step[3:6], step[:3]]))
    depth_scale = float(pose.depth_scale + step[6])
    return ScenePose(T_base_source=T @ pose.T_base_source, depth_scale=depth_scale), step
