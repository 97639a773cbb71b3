"""Two pictures of one view: how alike they are, by every metric, and depth beside it.

LPIPS (Zhang et al. 2018, version 0.1) is the network's own, in ``lpips_torch``; no torch is loaded
here. Papers on 3D Gaussian splatting feed its VGG images in 0..1, where the definition has -1..1,
and crop no border of SSIM. Each number says which it is.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8

from bridge.media import image_quality
from bridge.media.image_quality import ALIGNMENTS, PADDINGS, SIGMA, WINDOW, Padding, SsimMaps
from evaluator.errors import EvaluatorError, UndefinedStatisticError


@dataclass(frozen=True, kw_only=True)
class ImageMetric:
    """One named number about a pair of images."""

    id: str
    """Part of the ids in ``results.json``."""
    column: str
    """Head of its column in a table."""
    unit: str = "1"
    definition: str
    """With its source."""
    higher_is_better: bool = True
    raw_only: bool = False
    """Only of whole images as they are stored: not after a gain, not in a mask."""

    def named(self, variant: str) -> str:
        """Return the id of this metric for one variant: ``psnr_gain_db`` for psnr_db and gain."""
        if variant == RAW:
            return self.id
        if self.id.endswith("_db"):
            return f"{self.id.removesuffix('_db')}_{variant}_db"
        return f"{self.id}_{variant}"


RAW, GAIN = "raw", "gain"
"""Variants: as stored; after one gain per image and channel. Others are names of masks."""
_SSIM = (
    f"SSIM (Wang 2004), gaussian {WINDOW} x {WINDOW} sigma {SIGMA}, C1 1e-4, C2 9e-4, population "
    "covariance, per channel then mean, sRGB, data range 1, "
)
METRICS: dict[str, ImageMetric] = {
    metric.id: metric
    for metric in (
        ImageMetric(
            id="psnr_db",
            column="PSNR (dB)",
            unit="dB",
            definition="PSNR, sRGB, data range 1, one mean squared error over all pixels and "
            "channels",
        ),
        ImageMetric(
            id="ssim",
            column="SSIM",
            definition=f"{_SSIM}{PADDINGS['valid']} (as scikit-image crops)",
        ),
        ImageMetric(
            id="ssim_zero",
            column="SSIM (zero)",
            definition=f"{_SSIM}{PADDINGS['zero']} (as papers on 3D Gaussian splatting)",
            raw_only=True,
        ),
        ImageMetric(
            id="lpips_vgg_01",
            column="LPIPS (vgg, 0..1)",
            definition="LPIPS 0.1 (Zhang 2018), VGG16, images fed in 0..1, not scaled (as 3D "
            "Gaussian splatting papers)",
            higher_is_better=False,
            raw_only=True,
        ),
    )
}
"""Every image metric by its id, in the order of a table's columns."""
LPIPS = "lpips_vgg_01"
_NO_WEIGHTS = "its weights are not shipped and nothing is downloaded"
LPIPS_NOT_COMPUTED = f"not computed: no backbone ({_NO_WEIGHTS})"


@runtime_checkable
class PerceptualNet(Protocol):
    """What scoring needs of a network; the one there is stands in ``lpips_torch``."""

    @property
    def weights(self) -> str:
        """Content hashes of backbone and heads."""

    def distance(
        self,
        recorded: Float[np.ndarray, "height width 3"],
        replayed: Float[np.ndarray, "height width 3"],
    ) -> float:
        """Return the distance of a pair in 0..1; undefined for one that is too small."""


def variant_words(variant: str) -> str:
    """Say what was done to a pair before it was scored."""
    if variant in (RAW, GAIN):
        return f"full frame, no mask; {ALIGNMENTS['raw' if variant == RAW else 'gain']}"
    return f"only the pixels of the mask {variant!r}; {ALIGNMENTS['raw']}"


@dataclass(frozen=True, kw_only=True)
class ImageScore:
    """How one replayed image differs from the recorded one."""

    values: Mapping[str, float] = field(default_factory=dict)
    """By metric id; what is undefined is not in it."""
    reasons: Mapping[str, str] = field(default_factory=dict)
    """Why a metric is undefined."""


def score_pair(
    recorded_u8: UInt8[np.ndarray, "height width 3"] | Float[np.ndarray, "height width 3"],
    replayed_u8: (
        UInt8[np.ndarray, "replayed_height replayed_width 3"]
        | Float[np.ndarray, "replayed_height replayed_width 3"]
    ),
    *,
    masks: Mapping[str, Bool[np.ndarray, "height width"]] | None = None,
    net: PerceptualNet | None = None,
) -> dict[str, ImageScore]:
    """Score one pair in every way, by variant: as stored, after a gain, and inside each mask.

    Args:
        recorded_u8: 8 bits, or float in 0..1.
        replayed_u8: The same; its axes have their own names, so that a wrong size is explained.

    Raises:
        SwappedColourError: When the pair fits much better with red and blue exchanged.
    """
    recorded, replayed = image_quality.as_float(recorded_u8), image_quality.as_float(replayed_u8)
    refuse_swapped(recorded, replayed)
    brightened = image_quality.aligned(recorded_u8, replayed_u8, "gain")
    maps: SsimMaps | UndefinedStatisticError
    try:
        maps = image_quality.ssim_maps(recorded, replayed)
    except UndefinedStatisticError as error:
        maps = error
    found = {
        RAW: _scored(recorded, replayed, maps, paddings=("valid", "zero")),
        GAIN: _scored(recorded, brightened, maps, paddings=()),
    }
    for name, mask in (masks or {}).items():
        own = f"mask_{name}" if name in (RAW, GAIN) else name
        found[own] = _scored(recorded, replayed, maps, mask=mask)
    if net is not None:
        values, reasons = dict(found[RAW].values), dict(found[RAW].reasons)
        try:
            values[LPIPS] = net.distance(recorded, replayed)
        except UndefinedStatisticError as error:
            reasons[LPIPS] = error.reason
        found[RAW] = ImageScore(values=values, reasons=reasons)
    return found


_SSIM_OF: dict[Padding, str] = {"valid": "ssim", "zero": "ssim_zero"}


def _scored(
    recorded: Float[np.ndarray, "height width 3"],
    replayed: Float[np.ndarray, "height width 3"],
    maps: SsimMaps | UndefinedStatisticError,
    *,
    mask: Bool[np.ndarray, "height width"] | None = None,
    paddings: Sequence[Padding] = ("valid",),
) -> ImageScore:
    values: dict[str, float] = {}
    reasons: dict[str, str] = {}
    try:
        values["psnr_db"] = image_quality.psnr_db(recorded, replayed, mask=mask)
    except UndefinedStatisticError as error:
        reasons["psnr_db"] = error.reason
    for padding in paddings:
        try:
            if isinstance(maps, UndefinedStatisticError):
                raise maps
            values[_SSIM_OF[padding]] = maps.mean(padding, mask=mask)
        except UndefinedStatisticError as error:
            reasons[_SSIM_OF[padding]] = error.reason
    return ImageScore(values=values, reasons=reasons)


SWAP_MARGIN_DB = 3.0
"""A render whose PSNR rises by this when red and blue change places has them swapped ..."""
SWAP_LEAST_DB = 15.0
"""... if it then is a likeness at all."""


class SwappedColourError(EvaluatorError):
    """Red and blue of one of two images have changed places."""


def refuse_swapped(
    recorded: Float[np.ndarray, "height width 3"],
    replayed: Float[np.ndarray, "replayed_height replayed_width 3"],
) -> None:
    """Refuse a pair that fits much better with red and blue exchanged; grey ones cannot tell."""
    image_quality.check_same_shape(recorded, replayed)
    as_it_is = float(np.square(recorded - replayed).mean())
    swapped = float(np.square(recorded - replayed[..., ::-1]).mean())
    limit = as_it_is * 10.0 ** (-SWAP_MARGIN_DB / 10.0)
    if as_it_is > 0 and swapped <= min(limit, 10.0 ** (-SWAP_LEAST_DB / 10.0)):
        # An exact likeness has no PSNR; 100 dB is far below what 8 bits can tell.
        now, then = (-10.0 * math.log10(max(error, 1e-10)) for error in (as_it_is, swapped))
        raise SwappedColourError(
            f"red and blue look swapped (PSNR {now:.1f} dB as it is, {then:.1f} dB with the "
            "channels reversed). Write it as RGB; OpenCV writes and reads BGR."
        )


DEPTH_PROTOCOL = (
    "rendered against recorded depth along the optical axis, over pixels where both exist"
)


@dataclass(frozen=True, kw_only=True)
class DepthScore:
    """Errors of one depth image."""

    mean_abs_m: float
    median_abs_m: float
    """Hardly moved by silhouettes, where one of both has already reached what lies behind."""


def score_depth(
    recorded_m: Float[np.ndarray, "height width"],
    rendered_m: Float[np.ndarray, "rendered_height rendered_width"],
) -> DepthScore:
    """Compare two depth images [m]; 0 is "no measurement"."""
    if recorded_m.shape != rendered_m.shape:
        found = f"the recorded depth is {recorded_m.shape}, the rendered one {rendered_m.shape}"
        raise image_quality.ImageShapeError(found=found)
    both = (recorded_m > 0) & (rendered_m > 0)
    if not both.any():
        raise UndefinedStatisticError(statistic="depth error", reason="no pixel has both depths")
    error = np.abs(rendered_m[both].astype(np.float64) - recorded_m[both])
    return DepthScore(mean_abs_m=float(error.mean()), median_abs_m=float(np.median(error)))
