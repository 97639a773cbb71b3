"""How held-out views came out, in numbers for ``scene.json``; the evaluator's are official."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bridge.episode.streams import RgbdFrame
from twin.scene.frames.training_view import TrainingView
from twin.scene.raster.losses import psnr_db
from twin.scene.raster.rasteriser import View, load_native

VIEWS_NOTE = (
    "held out from initialisation, poses, exposure, fit and objects; means of the images' values; "
    "native resolution; raw: no colour alignment; gain_: one factor per image and channel, fitted "
    "to the recorded image; static_: without pixels that show something that moved; the "
    "evaluator computes the official numbers from the views episode"
)
MOST_DB = 100.0
AVERAGED = (
    *("psnr_db", "static_psnr_db", "gain_psnr_db", "ssim"),
    *("depth_mean_abs_m", "depth_median_abs_m"),
)


@dataclass(frozen=True, kw_only=True)
class ViewNumbers:
    """How one held-out view came out."""

    episode: str
    camera_id: str
    stamp_ns: int
    still_camera: bool
    """The camera does not move, so training frames show the same view."""
    psnr_db: float
    """Over the whole image, as recorded: a robot in view counts as error."""
    static_psnr_db: float | None
    """Over the pixels that show nothing that moved; None when there are none."""
    static_fraction: float
    """Share of those pixels."""
    gain_psnr_db: float
    """Over the whole image, each channel brightened by the factor that fits best."""
    ssim: float
    """Structural similarity of the whole image, as the fit sees it (zero padding)."""
    depth_mean_abs_m: float | None
    """Against the recorded depth where nothing moved and both exist."""
    depth_median_abs_m: float | None
    """The same; most of the mean are silhouettes."""
    coverage_fraction: float
    """Mean alpha of the rendered image."""


def rate_view(
    frame: RgbdFrame,
    recorded: TrainingView,
    view: View,
    static_mask: Bool[np.ndarray, "height width"],
    *,
    episode: str,
    still: bool,
) -> ViewNumbers:
    """Compare one rendered view with its recorded frame."""
    rendered = view.image_u8().astype(np.float32) / 255.0
    wanted = frame.image_u8.astype(np.float32) / 255.0
    squared = np.square((rendered - wanted).astype(np.float64))
    both = (recorded.full.depth_m > 0) & (view.depth_m > 0)
    difference = np.abs(recorded.full.depth_m - view.depth_m)[both]
    return ViewNumbers(
        episode=episode,
        camera_id=frame.camera_id,
        stamp_ns=frame.stamp_ns,
        still_camera=still,
        psnr_db=finite_psnr_db(float(squared.mean())),
        static_psnr_db=finite_psnr_db(float(squared[static_mask].mean()))
        if static_mask.any()
        else None,
        static_fraction=float(static_mask.mean()),
        gain_psnr_db=finite_psnr_db(float(np.square(brightened(rendered, wanted) - wanted).mean())),
        ssim=_similarity(rendered, wanted),
        depth_mean_abs_m=float(difference.mean()) if both.any() else None,
        depth_median_abs_m=float(np.median(difference)) if both.any() else None,
        coverage_fraction=float(view.alpha.mean()),
    )


def finite_psnr_db(mse: float) -> float:
    """Peak signal-to-noise ratio, at most 100 dB: JSON has no word for identical images."""
    return min(psnr_db(mse), MOST_DB)


def brightened(
    rendered: Float[np.ndarray, "height width 3"], wanted: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width 3"]:
    """Multiply each channel by the factor that brings it nearest to the recorded one."""
    a, b = rendered.astype(np.float64), wanted.astype(np.float64)
    power = np.maximum(np.square(a).sum(axis=(0, 1)), 1e-12)
    return np.asarray(np.clip(a * ((a * b).sum(axis=(0, 1)) / power), 0.0, 1.0))


def _similarity(rendered: np.ndarray, wanted: np.ndarray) -> float:
    planes = [np.ascontiguousarray(np.moveaxis(image, -1, 0)) for image in (rendered, wanted)]
    value, _ = load_native().Similarity(0, "auto").mean(*planes)
    return float(value)


def summarise_views(numbers: Sequence[ViewNumbers], files: Sequence[str]) -> dict[str, Any]:
    """Average the held-out views; cameras that stand still are kept apart."""
    moving = [item for item in numbers if not item.still_camera]
    still = [item for item in numbers if item.still_camera]
    averages = {
        f"{name}{ending}": _mean([getattr(item, name) for item in items])
        for ending, items in (("", moving), ("_still_cameras", still))
        for name in AVERAGED
    }
    return {
        "files": list(files),
        "note": VIEWS_NOTE,
        **averages,
        "num_images": len(moving),
        "num_images_still_cameras": len(still),
        "images": [asdict(item) for item in numbers],
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(float(np.mean(known)), 4) if known else None
