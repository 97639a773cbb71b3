"""How a rendered depth image differs from the recorded one."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.image import ImageShapeError

DEPTH_PROTOCOL = (
    "rendered against recorded depth along the optical axis, over pixels where both exist"
)


@dataclass(frozen=True, kw_only=True)
class DepthScore:
    """Errors of one depth image."""

    mean_abs_m: float
    median_abs_m: float
    """Hardly moved by silhouettes, where one of both has already reached what lies behind."""
    rmse_m: float
    num_pixels: int


def score_depth(
    recorded_m: Float[np.ndarray, "height width"],
    rendered_m: Float[np.ndarray, "rendered_height rendered_width"],
) -> DepthScore:
    """Compare two depth images [m]; 0 is "no measurement".

    Raises:
        ImageShapeError: When the sizes differ.
        UndefinedStatisticError: When no pixel has both.
    """
    if recorded_m.shape != rendered_m.shape:
        raise ImageShapeError(
            found=f"the recorded depth is {recorded_m.shape}, the rendered one {rendered_m.shape}"
        )
    both = (recorded_m > 0) & (rendered_m > 0)
    if not both.any():
        raise UndefinedStatisticError(statistic="depth error", reason="no pixel has both depths")
    error = rendered_m[both].astype(np.float64) - recorded_m[both]
    return DepthScore(
        mean_abs_m=float(np.abs(error).mean()),
        median_abs_m=float(np.median(np.abs(error))),
        rmse_m=float(np.sqrt(np.square(error).mean())),
        num_pixels=int(both.sum()),
    )
