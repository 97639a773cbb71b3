"""Align scene and robot: search, refine, judge; accepted only when the images determine it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.errors import TwinError
from twin.robot.model import RobotModel
from twin.robot.surface import PosedSurface, sample_surface
from twin.scene.align.judge import Looked, Sureness, look, resample
from twin.scene.align.plane import find_planes
from twin.scene.align.refine import COARSE, FINE, Equations, Place, refine
from twin.scene.align.search import APART_M, APART_RAD, search, search_near
from twin.scene.align.view import RobotView

COARSE_POINTS = 1000
MAX_COARSE = 6
NUM_SURFACE = 400


@dataclass(frozen=True, kw_only=True)
class AlignConfig:
    """When an alignment is accepted, and what it estimates."""

    min_fitness: float = 0.8
    """Share of the robot's pixels that must show it within 15 mm."""
    max_residual_m: float = 0.006
    """Root mean square distance of matched points to the surface."""
    max_scale_error: float = 0.05
    """No depth camera is that wrong; a scale farther from 1 hides a wrong place."""
    min_margin: float = 1.3
    """The second-best place must cost this many times as much as the best."""
    min_points: int = 300
    """Matched points."""
    num_points: int = 6000
    """Points used, of all views together."""
    with_scale: bool = True
    """Estimate the depth scale; off, the fit is rigid, for comparison."""
    seed: int = 0
    """Of sampling and resampling."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Where the scene lies in the robot's base frame, and how sure that is."""

    T_base_source: Float[np.ndarray, "4 4"]
    depth_scale: float
    fitness: float
    residual_m: float
    margin: float | None
    """Cost of the second-best place over the best; None where the search was not needed."""
    sureness: Sureness
    num_points: int
    num_views: int

    def to_record(self) -> dict[str, Any]:
        """Return plain numbers."""
        sure = self.sureness
        return {
            "depth_scale": self.depth_scale,
            "depth_scale_sigma": sure.depth_scale_sigma,
            "fitness": self.fitness,
            "residual_m": {
                "value": self.residual_m,
                "low": sure.residual_low_m,
                "high": sure.residual_high_m,
            },
            "displacement_m": sure.displacement_m,
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
    place: Place
    looked: Looked
    equations: Equations


def align_robot(
    views: Sequence[RobotView],
    robot: RobotModel,
    *,
    start: Float[np.ndarray, "4 4"] | None = None,
    config: AlignConfig = AlignConfig(),
) -> Alignment:
    """Find the pose ``T_base_source`` of a scene in which a robot stands, and the depth scale.

    Without a start: level planes give roll, pitch and height; every yaw and place on them is
    tried; the best are refined; the best must beat every other by a margin.

    Args:
        views: Depth images with the robot's posture, best of several postures.
        robot: Its description.
        start: A pose known to some centimetres; nothing else is then searched.
        config: Limits.

    Raises:
        RobotNotAlignedError: Nothing fits, or several places fit alike.
        RobotDescriptionError: The description has no usable shapes.
    """
    if not views:
        raise RobotNotAlignedError(
            found="there is no depth image", hint="Record the camera while the robot stands still."
        )
    surfaces = [PosedSurface(robot, view.posture) for view in views]
    starts = _starts(views, robot) if start is None else _near(views, robot, start)
    coarse = [_refined(views, surfaces, place, config, fine=False) for place in starts]
    best, others = _ranked(coarse)
    finals = [_refined(views, surfaces, item.place, config, fine=True) for item in (best, *others)]
    best, others = _ranked(finals)
    margin = None
    if start is None:
        margin = _costs(finals)[1] / max(_costs(finals)[0], 1e-9) if others else float("inf")
    _accept(best, margin, len(views), config)
    surface_m = np.concatenate(
        [sample_surface(robot, view.posture, NUM_SURFACE, seed=config.seed) for view in views]
    )
    return Alignment(
        T_base_source=best.place.T_base_source,
        depth_scale=best.place.depth_scale,
        fitness=best.looked.fitness,
        residual_m=best.equations.residual_m(),
        margin=margin,
        sureness=resample(best.equations, surface_m, seed=config.seed),
        num_points=best.equations.num_points,
        num_views=len(views),
    )


def _starts(views: Sequence[RobotView], robot: RobotModel) -> list[Place]:
    planes = find_planes(views)
    if not planes:
        raise RobotNotAlignedError(
            found="the depth images show no level surface for the robot to stand on",
            hint="Turn the camera so that it sees the table around the robot.",
        )
    found = search(views, robot, planes)
    return [Place(T_base_source=item.T_base_source) for item in found[:MAX_COARSE]]


def _near(
    views: Sequence[RobotView], robot: RobotModel, start: Float[np.ndarray, "4 4"]
) -> list[Place]:
    """The start, and the best of what lies around it: nearest points alone get stuck beside it."""
    polished = search_near(views, robot, start)
    return [Place(T_base_source=T) for T in (start, polished.T_base_source)]


def _refined(
    views: Sequence[RobotView],
    surfaces: Sequence[PosedSurface],
    place: Place,
    config: AlignConfig,
    *,
    fine: bool,
) -> _Candidate:
    """Coarse without the scale, which a wrong place would abuse; fine with it."""
    refined, equations = refine(
        views,
        surfaces,
        place,
        stages=FINE if fine else COARSE,
        num_points=config.num_points if fine else COARSE_POINTS,
        with_scale=fine and config.with_scale,
        seed=config.seed,
    )
    return _Candidate(place=refined, looked=look(views, surfaces, refined), equations=equations)


def _costs(candidates: Sequence[_Candidate]) -> list[float]:
    """Ascending; see ``Looked.cost_m``."""
    least = max(len(item.looked.errors_m) for item in candidates) // 2
    return sorted(item.looked.cost_m(least) for item in candidates)


def _ranked(candidates: Sequence[_Candidate]) -> tuple[_Candidate, list[_Candidate]]:
    """The best candidate, and the best of those that are another place."""
    least = max(len(item.looked.errors_m) for item in candidates) // 2
    ordered = sorted(candidates, key=lambda item: item.looked.cost_m(least))
    best = ordered[0]
    others = [item for item in ordered[1:] if _apart(item.place, best.place)]
    return best, others[:1]


def _apart(a: Place, b: Place) -> bool:
    change = se3.invert(a.T_base_source) @ b.T_base_source
    turn = float(se3.rotation_angle_rad(change[:3, :3]))
    base = se3.invert(a.T_base_source)[:3, 3] - se3.invert(b.T_base_source)[:3, 3]
    return turn > APART_RAD / 2 or float(np.linalg.norm(base)) > APART_M / 2


def _accept(best: _Candidate, margin: float | None, num_views: int, config: AlignConfig) -> None:
    fitness, residual = best.looked.fitness, best.equations.residual_m()
    more = "Record the robot in another posture, arm stretched out to one side, and use both."
    if best.equations.num_points < config.min_points or fitness < config.min_fitness:
        raise RobotNotAlignedError(
            found=f"at the best place found only {fitness:.0%} of the pixels that should show the "
            f"robot do ({best.equations.num_points} points match, {num_views} posture(s))",
            hint="Check that the camera sees the robot, that joints and depth were recorded "
            f"together, and that the description is this robot's. {more}",
        )
    if residual > config.max_residual_m:
        raise RobotNotAlignedError(
            found=f"the robot's surface is missed by {residual * 1e3:.1f} mm (at most "
            f"{config.max_residual_m * 1e3:.0f} mm)",
            hint="Check depth calibration, joint zero positions and the description's meshes.",
        )
    scale = best.place.depth_scale
    if abs(scale - 1.0) > config.max_scale_error:
        raise RobotNotAlignedError(
            found=f"the best place found needs the depth scaled by {scale:.3f}, more than the "
            f"{config.max_scale_error:.0%} a depth camera can be wrong",
            hint=f"Check that depth is in millimetres. {more}",
        )
    if margin is not None and margin < config.min_margin:
        raise RobotNotAlignedError(
            found=f"another place fits almost as well: it costs {margin:.2f} times the best, "
            f"{config.min_margin:g} times is needed",
            hint=more,
        )
