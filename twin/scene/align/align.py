"""Align scene and robot: search, refine, judge; accepted only when the images determine it.

Every yaw and position on a level surface is tried. A hypothesis is judged by looking: points of the
posed robot are carried into the depth image and compared with what was measured there. That needs
no idea which points of the scene are robot, counts what hides the robot as neutral, and what is
seen through it against the hypothesis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.errors import TwinError
from twin.robot.model import RobotModel
from twin.robot.surface import PosedSurface, sample_surface
from twin.scene.align.refine import COARSE, FINE, Equations, ScenePose, refine
from twin.scene.align.view import RobotView, find_levels

STRIDE_PX = 3
ERROR_CAP_M = 0.05
FITS_M = 0.015


@dataclass(frozen=True, kw_only=True)
class DepthErrors:
    """What the pixels say that should show the robot."""

    errors_m: Float[np.ndarray, " num_pixels"]
    """Measured against expected depth where both are known, at most ``ERROR_CAP_M``."""

    @property
    def fitness(self) -> float:
        """Share of the pixels that show the robot within 15 mm of where it should be."""
        return float((self.errors_m < FITS_M).mean()) if len(self.errors_m) else 0.0

    def cost_m(self, least_pixels: int) -> float:
        """Mean capped error; too few pixels are filled up with the cap.

        A place that puts the robot out of sight must not win by showing little.
        """
        missing = max(least_pixels - len(self.errors_m), 0)
        total = float(self.errors_m.sum()) + missing * ERROR_CAP_M
        return total / max(len(self.errors_m) + missing, 1)


def depth_errors(
    views: Sequence[RobotView], surfaces: Sequence[PosedSurface], pose: ScenePose
) -> DepthErrors:
    """Compare every third pixel of each view with the depth at which it should see the robot."""
    errors = [np.zeros(0)]
    for view, surface in zip(views, surfaces, strict=True):
        rays = view.camera.rays()[::STRIDE_PX, ::STRIDE_PX]
        expected = surface.depth_along(rays, pose.T_base_source @ view.T_source_camera)
        measured = view.depth_m[::STRIDE_PX, ::STRIDE_PX] * pose.depth_scale
        both = np.isfinite(expected) & (measured > 0)
        errors.append(np.minimum(np.abs(measured[both] - expected[both]), ERROR_CAP_M))
    return DepthErrors(errors_m=np.concatenate(errors).astype(np.float64))


NUM_SAMPLES = 250
MAX_VIEWS = 3
SECTORS = np.arange(60).reshape(6, 10) * 2 * np.pi / 60
"""All yaws, in six sectors: the best of each is followed."""
WIDE_M = np.linspace(-0.9, 0.9, 21)
"""Shifts from the middle of a level surface, along either side."""
NEAR_RAD, NEAR_M = np.linspace(-0.1, 0.1, 7), np.linspace(-0.09, 0.09, 7)
"""Finer steps around a pose."""
CAP_M, FINE_CAP_M = 0.08, 0.04
"""Depth differences beyond are worth nothing; the first on the whole table, then around a pose."""
SEEN_THROUGH = 0.3
"""What a point costs that the camera looks through, in units of a point that fits."""
APART_RAD = 0.35
APART_M = 0.12
"""Hypotheses nearer to each other than half of both of these are one."""


def _starts(
    views: Sequence[RobotView], robot: RobotModel, start: Float[np.ndarray, "4 4"] | None
) -> list[Float[np.ndarray, "4 4"]]:
    """A known pose and the best around it; else the best of the whole table, best first.

    The base frame's z = 0 is taken to lie in a level surface; refinement corrects that by some
    centimetres.
    """
    used = list(views[:: max(1, -(-len(views) // MAX_VIEWS))])
    samples = [sample_surface(robot, v.posture, NUM_SAMPLES, seed=i) for i, v in enumerate(used)]
    if start is not None:  # nearest points alone get stuck beside the start
        return [start, _best(used, samples, start, NEAR_RAD, NEAR_M, FINE_CAP_M)[1]]
    found = []
    for T_level_source in find_levels(views):
        for yaws_rad in SECTORS:
            _, T = _best(used, samples, T_level_source, yaws_rad, WIDE_M, CAP_M)
            found.append(_best(used, samples, T, NEAR_RAD, NEAR_M, FINE_CAP_M))
    if not found:
        raise RobotNotAlignedError(
            found="the depth images show no level surface for the robot to stand on",
            hint="Turn the camera so that it sees the table around the robot.",
        )
    found.sort(key=lambda item: -item[0])
    return [T for _, T in found[:MAX_COARSE]]


def _best(
    views: Sequence[RobotView],
    samples: Sequence[np.ndarray],
    T_level_source: Float[np.ndarray, "4 4"],
    yaws_rad: Float[np.ndarray, " num_yaws"],
    shifts_m: Float[np.ndarray, " num_shifts"],
    cap_m: float,
) -> tuple[float, Float[np.ndarray, "4 4"]]:
    """The best place of the base on a level, and its score: ``T_base_source``."""
    x, y = np.meshgrid(shifts_m, shifts_m)
    places = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    scores = np.zeros((len(yaws_rad), len(places)))
    for view, p_base in zip(views, samples, strict=True):
        T_camera_level = se3.invert(T_level_source @ view.T_source_camera)
        shifts = places @ T_camera_level[:3, :3].T
        for index, yaw in enumerate(yaws_rad):
            turned = p_base @ se3.rotation_from_vector(np.array([0.0, 0.0, yaw])).T
            scores[index] += _credit(view, se3.apply(T_camera_level, turned), shifts, cap_m)
    i, k = np.unravel_index(int(np.argmax(scores)), scores.shape)
    T_level_base = se3.small_motion(np.array([0.0, 0.0, yaws_rad[i], *places[k]]))
    return float(scores[i, k]), se3.invert(T_level_base) @ T_level_source


def _credit(
    view: RobotView,
    p_camera: Float[np.ndarray, "num_points 3"],
    shifts_m: Float[np.ndarray, "num_places 3"],
    cap_m: float,
) -> Float[np.ndarray, " num_places"]:
    """Mean credit of the points, moved by each shift."""
    camera = view.camera
    p = (p_camera[None] + shifts_m[:, None]).astype(np.float32)
    z = p[..., 2]
    front = z > 0.1
    inverse = 1.0 / np.where(front, z, 1.0)
    column = np.floor(p[..., 0] * inverse * np.float32(camera.fx) + np.float32(camera.cx))
    row = np.floor(p[..., 1] * inverse * np.float32(camera.fy) + np.float32(camera.cy))
    inside = front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    index = np.where(inside, row * camera.width + column, 0).astype(np.int64)
    behind = view.depth_m.astype(np.float32).ravel()[index] - z
    known = inside & (behind > -z)  # depth 0 is unknown
    credit = np.maximum(0.0, 1.0 - np.abs(behind) / cap_m) - SEEN_THROUGH * (behind > cap_m)
    return np.asarray(np.where(known, credit, 0.0).mean(axis=1), dtype=np.float64)


COARSE_POINTS = 1000
MAX_COARSE = 6
MIN_FITNESS = 0.8
"""Share of the robot's pixels that must show it within 15 mm."""
MAX_RESIDUAL_M = 0.006
"""Root mean square distance of matched points to the surface."""
MAX_SCALE_ERROR = 0.05
"""No depth camera is that wrong; a scale farther from 1 hides a wrong place."""
MIN_MARGIN = 1.3
"""The second-best place must cost this many times as much as the best."""
MIN_POINTS, NUM_POINTS = 300, 6000
"""Points that must match, and points used, of all views together."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Where the scene lies in the robot's base frame, and how sure that is."""

    T_base_source: Float[np.ndarray, "4 4"]
    depth_scale: float
    fitness: float
    residual_m: float
    margin: float | None
    """Cost of the second-best place over the best; None where the search was not needed."""
    num_points: int
    num_views: int

    def to_record(self) -> dict[str, Any]:
        """Return plain numbers."""
        return {
            "depth_scale": self.depth_scale,
            "fitness": self.fitness,
            "residual_m": {"value": self.residual_m},
            "yaw_margin": self.margin,
            "num_points": self.num_points,
            "num_postures": self.num_views,
        }


class RobotNotAlignedError(TwinError):
    """The depth images do not say where the robot is."""

    def __init__(self, *, found: str, hint: str) -> None:
        """Remember what was found."""
        self.found = found
        super().__init__(f"scene and robot cannot be aligned: {found}. {hint}")


@dataclass(frozen=True, kw_only=True)
class _Candidate:
    pose: ScenePose
    looked: DepthErrors
    equations: Equations


def align_robot(
    views: Sequence[RobotView], robot: RobotModel, *, start: Float[np.ndarray, "4 4"] | None = None
) -> Alignment:
    """Find the pose ``T_base_source`` of a scene in which a robot stands, and the depth scale.

    Without a start: level planes give roll, pitch and height; every yaw and place on them is
    tried; the best are refined; the best must beat every other by a margin.

    Args:
        start: A pose known to some centimetres; nothing else is then searched.
    """
    if not views:
        raise RobotNotAlignedError(
            found="there is no depth image", hint="Record the camera while the robot stands still."
        )
    surfaces = [PosedSurface(robot, view.posture) for view in views]
    starts = [ScenePose(T_base_source=T) for T in _starts(views, robot, start)]
    coarse = [_refined(views, surfaces, pose, fine=False) for pose in starts]
    best, others = _ranked(coarse)
    finals = [_refined(views, surfaces, item.pose, fine=True) for item in (best, *others)]
    best, others = _ranked(finals)
    margin = None
    if start is None:
        least = max(len(item.looked.errors_m) for item in finals) // 2
        costs = sorted(item.looked.cost_m(least) for item in finals)
        margin = costs[1] / max(costs[0], 1e-9) if others else float("inf")
    _accept(best, margin, len(views))
    return Alignment(
        T_base_source=best.pose.T_base_source,
        depth_scale=best.pose.depth_scale,
        fitness=best.looked.fitness,
        residual_m=best.equations.residual_m,
        margin=margin,
        num_points=best.equations.num_points,
        num_views=len(views),
    )


def _refined(
    views: Sequence[RobotView], surfaces: Sequence[PosedSurface], pose: ScenePose, *, fine: bool
) -> _Candidate:
    """Coarse without the scale, which a wrong place would abuse; fine with it."""
    refined, equations = refine(
        views,
        surfaces,
        pose,
        stages=FINE if fine else COARSE,
        num_points=NUM_POINTS if fine else COARSE_POINTS,
        with_scale=fine,
    )
    return _Candidate(
        pose=refined, looked=depth_errors(views, surfaces, refined), equations=equations
    )


def _ranked(candidates: Sequence[_Candidate]) -> tuple[_Candidate, list[_Candidate]]:
    """The best candidate, and the best of those that are another place."""
    least = max(len(item.looked.errors_m) for item in candidates) // 2
    ordered = sorted(candidates, key=lambda item: item.looked.cost_m(least))
    best = ordered[0]
    own = se3.invert(best.pose.T_base_source)
    for item in ordered[1:]:
        T = item.pose.T_base_source
        turn, base = se3.rotation_angle_rad((own @ T)[:3, :3]), se3.invert(T)[:3, 3] - own[:3, 3]
        if turn > APART_RAD / 2 or np.linalg.norm(base) > APART_M / 2:
            return best, [item]
    return best, []


def _accept(best: _Candidate, margin: float | None, num_views: int) -> None:
    fitness, residual = best.looked.fitness, best.equations.residual_m
    more = "Record the robot in another posture, arm stretched out to one side, and use both."
    if best.equations.num_points < MIN_POINTS or fitness < MIN_FITNESS:
        raise RobotNotAlignedError(
            found=f"at the best place found only {fitness:.0%} of the pixels that should show the "
            f"robot do ({best.equations.num_points} points match, {num_views} posture(s))",
            hint="Check that the camera sees the robot, that joints and depth were recorded "
            f"together, and that the description is this robot's. {more}",
        )
    if residual > MAX_RESIDUAL_M:
        raise RobotNotAlignedError(
            found=f"the robot's surface is missed by {residual * 1e3:.1f} mm (at most "
            f"{MAX_RESIDUAL_M * 1e3:.0f} mm)",
            hint="Check depth calibration, joint zero positions and the description's meshes.",
        )
    scale = best.pose.depth_scale
    if abs(scale - 1.0) > MAX_SCALE_ERROR:
        raise RobotNotAlignedError(
            found=f"the best place found needs the depth scaled by {scale:.3f}, more than the "
            f"{MAX_SCALE_ERROR:.0%} a depth camera can be wrong",
            hint=f"Check that depth is in millimetres. {more}",
        )
    if margin is not None and margin < MIN_MARGIN:
        raise RobotNotAlignedError(
            found=f"another place fits almost as well: it costs {margin:.2f} times the best, "
            f"{MIN_MARGIN:g} times is needed",
            hint=more,
        )
