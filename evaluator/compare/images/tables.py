"""Tables of image numbers: no row without the protocol it was measured by."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from evaluator.compare.images.scores import GAIN, RAW, Variant, ViewScore
from evaluator.compare.measure import measured
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import Quantity
from evaluator.metrics.image_protocol import ImageMetric, Stamp
from evaluator.metrics.image_scores import METRICS, PLAIN_METRICS, ImageScore
from evaluator.metrics.lpips import LPIPS_METRICS, LPIPS_NOT_COMPUTED, PerceptualNet, net_of
from evaluator.result import Cell, Measurement, Table

Quantities = Mapping[tuple[str, bool], Quantity]
"""By the metric, and whether the images were compared as they are stored."""
NOT_A_SAMPLE = (
    "views of one scene are no random sample of views; the per-image list is in the table"
)


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """What all numbers about one set of images have in common."""

    resolution: str
    split: str
    stored: str
    nets: Sequence[PerceptualNet] = ()
    note: str = ""
    """Said at the end of each definition."""


@dataclass(frozen=True, kw_only=True)
class StampedMeasurement:
    """A mean over images that cannot be had without its stamp."""

    metric: ImageMetric
    variant: Variant
    measurement: Measurement
    stamp: Stamp


def resolution_words(sizes: Sequence[tuple[int, int]]) -> str:
    """Write the sizes of images, given as (height, width) [px]."""
    found = sorted(set(sizes))
    if not found:
        return "no image"
    words = ", ".join(f"{width} x {height}" for height, width in found[:3])
    return words if len(found) <= 3 else f"{words} and {len(found) - 3} other sizes"


def stamped_measurements(
    quantities: Quantities,
    variant: Variant,
    scores: Sequence[ImageScore],
    protocol: Protocol,
    *,
    episodes: Sequence[str] = (),
    **part: str,
) -> list[StampedMeasurement]:
    """Measure the mean of every metric that a variant can have."""
    metrics = [*PLAIN_METRICS, *(LPIPS_METRICS if protocol.nets and variant.learned else ())]
    return [
        _stamped(quantities, metric, variant, scores, protocol, episodes, part)
        for metric in metrics
        if variant.mode != "mask-pixels" or metric.by_pixel
    ]


def _stamped(
    quantities: Quantities,
    metric: ImageMetric,
    variant: Variant,
    scores: Sequence[ImageScore],
    protocol: Protocol,
    episodes: Sequence[str],
    part: Mapping[str, str],
) -> StampedMeasurement:
    values = [s.values[metric.id] for s in scores if metric.id in s.values]
    net = net_of(metric, protocol.nets)
    stamp = Stamp(
        metric=metric.column,
        implementation=metric.implementation,
        values=metric.values,
        window=metric.window,
        padding=metric.padding,
        weights=net.weights if net is not None else "none",
        mask=variant.mask_words,
        resolution=protocol.resolution,
        alignment=variant.alignment_words,
        clamp=variant.clamp_words,
        split=protocol.split,
        stored=protocol.stored,
        n=len(values),
    )
    without = LPIPS_NOT_COMPUTED if metric in LPIPS_METRICS and net is None else ""
    parts = (stamp.text(), _lacking(metric, scores), protocol.note)
    protocol_words = "".join(f"; {part}" for part in parts if part)
    quantity = quantities[metric.id, variant == RAW]
    measurement = measured(
        quantity.of(variant=variant.name, protocol=protocol_words, **part),
        partial(_mean, metric.column, values, without or _first_reason(metric, scores)),
        n=len(values),
        counted="image",
        reason_without_interval=NOT_A_SAMPLE,
        episodes=episodes,
    )
    return StampedMeasurement(metric=metric, variant=variant, measurement=measurement, stamp=stamp)


def _mean(statistic: str, values: Sequence[float], reason: str) -> float:
    if not values:
        raise UndefinedStatisticError(statistic=statistic, reason=reason)
    return float(np.mean(values))


def _first_reason(metric: ImageMetric, scores: Sequence[ImageScore]) -> str:
    found = (score.reasons[metric.id] for score in scores if metric.id in score.reasons)
    return next(found, "no pair of images has it")


def _lacking(metric: ImageMetric, scores: Sequence[ImageScore]) -> str:
    """Count the images that the mean leaves out, with the first reason."""
    without = [score for score in scores if metric.id in score.reasons]
    if not without or len(without) == len(scores):
        return ""
    reason = without[0].reasons[metric.id]
    return f"not in the mean: {len(without)} of {len(scores)} images ({reason})"


def per_image_table(table_id: str, title: str, scores: Sequence[ViewScore]) -> Table:
    """List every view with its raw scores, and PSNR after a gain."""
    others = [metric for metric in PLAIN_METRICS if metric.id not in ("psnr_db", "ssim")]
    learned = [m for m in METRICS.values() if any(m.id in s.scores[RAW].values for s in scores)]
    others += [metric for metric in learned if metric not in PLAIN_METRICS]
    return Table(
        id=table_id,
        title=title,
        columns=(
            *("camera", "stamp_ns", "PSNR (dB)", "SSIM", "pixels"),
            *("PSNR gain (dB)", "depth (mm)", *(metric.column for metric in others)),
        ),
        rows=tuple(
            (
                s.camera_id,
                s.stamp_ns,
                _rounded(s.scores[RAW].psnr_db, 3),
                _rounded(s.scores[RAW].ssim, 4),
                s.scores[RAW].num_pixels,
                _rounded(s.psnr_db(GAIN), 3),
                None if s.depth is None else round(1e3 * s.depth.mean_abs_m, 2),
                *(_rounded(s.scores[RAW].values.get(metric.id), 4) for metric in others),
            )
            for s in scores
        ),
        note=_definitions((METRICS["psnr_db"], METRICS["ssim"], *others)),
    )


def _definitions(metrics: Iterable[ImageMetric]) -> str:
    definitions = ". ".join(metric.definition for metric in metrics)
    return f"{definitions}. LPIPS where a backbone is given. Full stamps: results.json."


def rounded(value: float | str | None) -> Cell:
    """Return a cell with four digits behind the point; words stay as they are."""
    return round(value, 4) if isinstance(value, float) else value


def _rounded(value: float | None, digits: int) -> Cell:
    return None if value is None else round(value, digits)
