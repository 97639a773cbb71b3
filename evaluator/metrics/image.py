"""Images that can be laid over each other: range, PSNR, brightness, and swapped colours."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.media.image_quality import ImageShapeError, check_same_shape
from evaluator.errors import EvaluatorError, UndefinedStatisticError

SWAP_MARGIN_DB = 3.0
"""A render whose PSNR rises by this when red and blue change places has them swapped ..."""
SWAP_LEAST_DB = 15.0
"""... if it then is a likeness at all."""


class SwappedColourError(EvaluatorError):
    """Red and blue of one of two images have changed places."""

    def __init__(self, *, as_it_is_db: float, swapped_db: float) -> None:
        """Remember both numbers."""
        super().__init__(
            f"red and blue look swapped (PSNR {as_it_is_db:.1f} dB as it is, {swapped_db:.1f} dB "
            "with the channels reversed). Write it as RGB; OpenCV writes and reads BGR."
        )


def refuse_swapped(
    recorded: Float[np.ndarray, "height width 3"],
    replayed: Float[np.ndarray, "replayed_height replayed_width 3"],
) -> None:
    """Refuse a pair that fits much better with red and blue exchanged.

    Grey images cannot tell, and are let through.

    Args:
        replayed: The image held against it, in the same order and range.
    """
    check_same_shape(recorded, replayed)
    as_it_is = float(np.square(recorded - replayed).mean())
    swapped = float(np.square(recorded - replayed[..., ::-1]).mean())
    limit = as_it_is * 10.0 ** (-SWAP_MARGIN_DB / 10.0)
    if as_it_is > 0 and swapped <= min(limit, 10.0 ** (-SWAP_LEAST_DB / 10.0)):
        # An exact likeness has no PSNR; 100 dB is far below what 8 bits can tell.
        decibel = [-10.0 * math.log10(max(error, 1e-10)) for error in (as_it_is, swapped)]
        raise SwappedColourError(as_it_is_db=decibel[0], swapped_db=decibel[1])


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
    """Compare two depth images [m]; 0 is "no measurement"."""
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
