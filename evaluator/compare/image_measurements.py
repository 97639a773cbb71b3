"""Turn the scores of many images into measurements, each with its protocol stamp."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from evaluator.compare.measure import measured
from evaluator.compare.variants import Variant
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.lpips import LPIPS_METRICS, LPIPS_NOT_COMPUTED, PerceptualNet, net_of
from evaluator.metrics.metric import ImageMetric
from evaluator.metrics.scores import PLAIN_METRICS, ImageScore
from evaluator.metrics.stamp import Stamp
from evaluator.result import Measurement

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
    remark: str = ""
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
    prefix: str,
    variant: Variant,
    scores: Sequence[ImageScore],
    protocol: Protocol,
    *,
    episodes: Sequence[str] = (),
) -> list[StampedMeasurement]:
    """Measure the mean of every metric that a variant can have.

    Args:
        prefix: Of the ids: ``views.all`` or ``image.<method>``.
        variant: How the images were scored.
        scores: One for each image.
        protocol: What goes onto every stamp.
        episodes: The recorded episodes the numbers rest on.
    """
    metrics = [*PLAIN_METRICS, *(LPIPS_METRICS if protocol.nets and variant.learned else ())]
    return [
        _stamped(prefix, metric, variant, scores, protocol, episodes)
        for metric in metrics
        if variant.mode != "mask-pixels" or metric.by_pixel
    ]


def _stamped(
    prefix: str,
    metric: ImageMetric,
    variant: Variant,
    scores: Sequence[ImageScore],
    protocol: Protocol,
    episodes: Sequence[str],
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
    parts = (metric.definition, stamp.text(), _lacking(metric, scores), protocol.remark)
    measurement = measured(
        f"{prefix}.{metric.named(variant.name)}",
        partial(_mean, metric.column, values, without or _first_reason(metric, scores)),
        unit=metric.unit,
        definition="; ".join(part for part in parts if part),
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
