"""Every image metric by its id, and all of them on one pair of images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, UInt8

from bridge.media.image_quality import (
    PADDINGS,
    SIGMA,
    WINDOW,
    Alignment,
    Padding,
    SsimMaps,
    aligned,
    as_float,
    psnr_db,
    ssim_maps,
)
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.image_protocol import ImageMetric
from evaluator.metrics.lpips import LPIPS_METRICS, PerceptualNet

GAUSSIAN = f"gaussian {WINDOW} x {WINDOW} sigma {SIGMA}"
_SSIM = (
    f"SSIM (Wang 2004), {GAUSSIAN}, C1 1e-4, C2 9e-4, population covariance, per channel then "
    "mean, sRGB, data range 1, "
)
_IDS: dict[Padding, str] = {"valid": "ssim", "zero": "ssim_zero", "reflect": "ssim_reflect"}
_USERS: dict[Padding, str] = {
    "valid": "as scikit-image crops",
    "zero": "as papers on 3D Gaussian splatting",
    "reflect": "as torchmetrics",
}
"""Who computes it so."""
_COLUMNS: dict[Padding, str] = {"valid": "SSIM", "zero": "SSIM (zero)", "reflect": "SSIM (reflect)"}

PLAIN_METRICS: tuple[ImageMetric, ...] = (
    ImageMetric(
        id="psnr_db",
        column="PSNR (dB)",
        unit="dB",
        definition="PSNR, sRGB, data range 1, one mean squared error over all pixels and channels",
        implementation="bridge.media.image_quality 1",
    ),
    *(
        ImageMetric(
            id=_IDS[padding],
            column=_COLUMNS[padding],
            definition=f"{_SSIM}{words} ({_USERS[padding]})",
            implementation="bridge.media.image_quality 1",
            window=GAUSSIAN,
            padding=words,
        )
        for padding, words in PADDINGS.items()
    ),
)
"""What needs no learned weights, in the order of a table's columns."""
METRICS: dict[str, ImageMetric] = {m.id: m for m in (*PLAIN_METRICS, *LPIPS_METRICS)}
"""Every image metric by its id."""


@dataclass(frozen=True, kw_only=True)
class ImageScore:
    """How one replayed image differs from the recorded one."""

    values: Mapping[str, float]
    """By metric id; what is undefined is not in it."""
    reasons: Mapping[str, str] = field(default_factory=dict)
    """Why a metric is undefined."""
    num_pixels: int

    @property
    def psnr_db(self) -> float | None:
        """None when both images are identical (infinite)."""
        return self.values.get("psnr_db")

    @property
    def ssim(self) -> float | None:
        """Windows inside the image; None when it, or what the mask leaves, is too small."""
        return self.values.get("ssim")


def score_image(
    recorded_u8: UInt8[np.ndarray, "height width 3"] | Float[np.ndarray, "height width 3"],
    replayed_u8: (
        UInt8[np.ndarray, "replayed_height replayed_width 3"]
        | Float[np.ndarray, "replayed_height replayed_width 3"]
    ),
    *,
    mask: Bool[np.ndarray, "height width"] | None = None,
    alignment: Alignment = "raw",
    nets: Sequence[PerceptualNet] = (),
) -> ImageScore:
    """Return every score of one pair; what is undefined has its reason instead.

    Args:
        recorded_u8: 8 bits, or float in 0..1.
        replayed_u8: The same; its axes have their own names, so that a wrong size is explained.
        mask: Pixels that count; metrics of whole images are undefined over single ones.
        alignment: Brightening before the comparison; whole images decide it, whatever the mask.
    """
    replayed = aligned(recorded_u8, replayed_u8, alignment)
    recorded = as_float(recorded_u8)
    pixels = recorded.shape[0] * recorded.shape[1] if mask is None else int(mask.sum())
    values: dict[str, float] = {}
    reasons: dict[str, str] = {}
    maps: SsimMaps | None = None
    try:
        maps = ssim_maps(recorded, replayed)
    except UndefinedStatisticError as error:
        reasons |= dict.fromkeys(_IDS.values(), error.reason)
    attempts = {
        "psnr_db": partial(psnr_db, recorded, replayed, mask=mask),
    }
    if maps is not None:
        attempts |= {_IDS[p]: partial(maps.mean, p, mask=mask) for p in PADDINGS}
    for name, compute in attempts.items():
        try:
            values[name] = compute()
        except UndefinedStatisticError as error:
            reasons[name] = error.reason
    if mask is None:
        for net in nets:
            found = net.distances(recorded, replayed)
            values |= found.values
            reasons |= found.reasons
    return ImageScore(values=values, reasons=reasons, num_pixels=pixels)
