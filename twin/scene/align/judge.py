"""How well a place of the robot explains the depth images, and how sure it is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from twin.robot.surface import PosedSurface
from twin.scene.align.refine import Equations, Place
from twin.scene.align.view import RobotView

STRIDE_PX = 3
CAP_M = 0.05
FITS_M = 0.015
NUM_RESAMPLES = 500


@dataclass(frozen=True, kw_only=True)
class Looked:
    """What the pixels say that should show the robot."""

    errors_m: Float[np.ndarray, " num_pixels"]
    """Measured against expected depth where both are known, at most ``CAP_M``."""

    @property
    def fitness(self) -> float:
        """Share of the pixels that show the robot within 15 mm of where it should be."""
        return float((self.errors_m < FITS_M).mean()) if len(self.errors_m) else 0.0

    def cost_m(self, least_pixels: int) -> float:
        """Mean capped error; too few pixels are filled up with the cap.

        A place that puts the robot out of sight must not win by showing little.
        """
        missing = max(least_pixels - len(self.errors_m), 0)
        total = float(self.errors_m.sum()) + missing * CAP_M
        return total / max(len(self.errors_m) + missing, 1)


@dataclass(frozen=True, kw_only=True)
class Sureness:
    """95 % intervals from resampling blocks of points."""

    displacement_m: float
    """With 95 % probability the robot's surface lies this near to where it was put, on average;
    says nothing of errors that all points share."""
    depth_scale_sigma: float
    residual_low_m: float
    residual_high_m: float


def look(views: Sequence[RobotView], surfaces: Sequence[PosedSurface], place: Place) -> Looked:
    """Compare every third pixel of each view with the depth at which it should see the robot."""
    errors = [np.zeros(0)]
    for view, surface in zip(views, surfaces, strict=True):
        rays = view.camera.rays()[::STRIDE_PX, ::STRIDE_PX]
        expected = surface.depth_along(rays, place.T_base_source @ view.T_source_camera)
        measured = view.depth_m[::STRIDE_PX, ::STRIDE_PX] * place.depth_scale
        both = np.isfinite(expected) & (measured > 0)
        errors.append(np.minimum(np.abs(measured[both] - expected[both]), CAP_M))
    return Looked(errors_m=np.concatenate(errors).astype(np.float64))


def resample(
    equations: Equations, p_base: Float[np.ndarray, "num_points 3"], *, seed: int = 0
) -> Sureness:
    """Draw blocks of points with replacement and solve the linearised fit again (Efron, 1979).

    Args:
        equations: At the solution.
        p_base: Points of the robot's surface, to say how far it moves [m].
        seed: Of the draws.
    """
    rng = np.random.default_rng(seed)
    count = len(equations.weight)
    drawn = rng.multinomial(count, np.full(count, 1 / count), size=NUM_RESAMPLES)
    H = np.einsum("sb,bij->sij", drawn, equations.H) + 1e-9 * np.eye(7)
    g = drawn @ equations.g
    steps = -np.linalg.solve(H, g[..., None])[..., 0]
    steps -= steps.mean(axis=0)
    moved = steps[:, None, :3] + np.cross(steps[:, None, 3:6], p_base[None])
    far = np.linalg.norm(moved, axis=-1).mean(axis=1)
    residual = np.sqrt((drawn @ equations.square_m2) / np.maximum(drawn @ equations.weight, 1e-12))
    low, high = np.quantile(residual, [0.025, 0.975])
    return Sureness(
        displacement_m=float(np.quantile(far, 0.95)),
        depth_scale_sigma=float(steps[:, 6].std()),
        residual_low_m=float(low),
        residual_high_m=float(high),
    )
