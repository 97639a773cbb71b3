"""Pair the images of a ``views`` episode, score each pair, and measure means with their protocol.

Topics end in ``/cam/<id>/`` and ``rendered/image``, ``recorded/image`` (or, in the source episode,
``color/image``), ``mask/<name>/image`` or ``mask/<name>`` (white inside),
``rendered/depth``, ``recorded/depth`` and ``recorded/depth_in_color``. Images are worked on by a
few threads, as NumPy and the image decoders let go of the interpreter.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from bridge.episode import schema, streams, topics
from bridge.episode.cdr.messages import CompressedColor, DepthImage
from bridge.episode.reader import Episode
from bridge.errors import GstError, MissingDependencyError
from bridge.media.color import JPEG_MAGIC, decode_color, encode_png
from evaluator.compare.measure import mean_of, measured
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import Quantity
from evaluator.metrics import image as image_metrics
from evaluator.metrics.image import RAW, DepthScore, ImageMetric, ImageScore, PerceptualNet
from evaluator.result import Measurement


def open_net(backbone: Path | None) -> PerceptualNet | None:
    """Load the network of LPIPS where it was asked for; without it, torch stays out."""
    if backbone is None:
        return None
    try:
        from evaluator.metrics.lpips_torch import LpipsNet  # noqa: PLC0415  # loads torch

        return LpipsNet(backbone)
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors"):
            raise
        raise MissingDependencyError(
            package=str(error.name), extra="lpips", purpose="LPIPS"
        ) from error


Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_THREADS = 8
"""More only cost memory: each holds the images it works on."""


def spread(
    work: Callable[[Item], Result], items: Iterable[Item], *, threads: int | None = None
) -> list[Result]:
    """Call ``work``, which shares nothing that changes, on each item; results keep their order."""
    count = min(MAX_THREADS, os.cpu_count() or 1) if threads is None else threads
    if count <= 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(max_workers=count) as pool:
        return list(pool.map(work, items))


RENDERED, RECORDED = "rendered", "recorded"
_COLOR_TOPICS = ((RENDERED, topics.RENDERED_TOPIC), (RECORDED, topics.RECORDED_TOPIC))
_DEPTH_TOPICS = ((RENDERED, topics.RENDERED_DEPTH_TOPIC), (RECORDED, topics.RECORDED_DEPTH_TOPIC))

Key = tuple[str, int]
"""Camera id and stamp [ns]."""


@dataclass(frozen=True, kw_only=True)
class ViewScore:
    """One held-out image: its scores, or the reason why there are none."""

    reason: str = ""
    camera_id: str = ""
    stamp_ns: int = 0
    size: tuple[int, int] = (0, 0)
    """Height and width [px]."""
    scores: Mapping[str, ImageScore] = field(default_factory=dict)
    """By variant; at least raw and gain, and one of each mask where there are any."""
    depth: DepthScore | None = None
    jpeg: bool = False
    """The rendered image was stored lossily."""

    def value(self, metric: str, variant: str = RAW) -> float | None:
        """None where the variant is not there, or the metric is undefined."""
        return None if variant not in self.scores else self.scores[variant].values.get(metric)


@dataclass(kw_only=True)
class Images:
    """Undecoded images of one views episode."""

    color: dict[str, dict[Key, bytes]] = field(default_factory=lambda: {RENDERED: {}, RECORDED: {}})
    masks: dict[str, dict[Key, bytes]] = field(default_factory=dict)
    depth: dict[str, dict[Key, bytes]] = field(default_factory=lambda: {RENDERED: {}, RECORDED: {}})

    def masks_of(self, key: Key) -> dict[str, np.ndarray]:
        """Decode the masks of one view; empty ones say nothing and are left out."""
        stored = {name: of[key] for name, of in sorted(self.masks.items()) if key in of}
        found = {name: decode_color(data)[..., 0] > 127 for name, data in stored.items()}
        return {name: mask for name, mask in found.items() if mask.any()}


def score_views(images: Images, *, net: PerceptualNet | None = None) -> tuple[ViewScore, ...]:
    """Score every rendered image of a views episode; what cannot be scored has its reason."""
    rendered = sorted(images.color[RENDERED])
    if not rendered:
        return (ViewScore(reason="no topic .../cam/<id>/rendered/image in it"),)
    # A network uses all cores and much memory by itself.
    return tuple(spread(partial(_score, images, net), rendered, threads=1 if net else None))


def images_of(views: Episode, source: Episode | None) -> Images:
    """Collect the images of a views episode; recorded ones of its source where it has none."""
    images = read_images(views)
    if source is not None and not images.color[RECORDED]:
        for name in {camera_id for camera_id, _ in images.color[RENDERED]}:
            for image in streams.color_images(source, name):
                if (key := (name, image.stamp_ns)) in images.color[RENDERED]:
                    images.color[RECORDED][key] = image.as_file(encode_png)
    return images


def read_images(episode: Episode) -> Images:
    """Collect the images of an episode by camera and stamp, still compressed."""
    images = Images()
    put: dict[str, Callable[[bytes], None]] = {}
    for topic in episode.topics_of_type(schema.COMPRESSED_IMAGE):
        for name, pattern in _COLOR_TOPICS:
            if match := pattern.search(topic):
                put[topic] = partial(_put_color, images.color[name], match.group(1))
                break
        else:
            if match := topics.MASK_TOPIC.search(topic):
                masks = images.masks.setdefault(match.group(2), {})
                put[topic] = partial(_put_color, masks, match.group(1))
    for topic in episode.topics_of_type(schema.IMAGE):
        for name, pattern in _DEPTH_TOPICS:
            if match := pattern.search(topic):
                put[topic] = partial(_put_depth, images.depth[name], match.group(1))
    for message in episode.messages(put):
        put[message.topic](message.data)
    return images


def _put_color(into: dict[Key, bytes], camera_id: str, data: bytes) -> None:
    image = CompressedColor.from_cdr(data)
    into[camera_id, image.stamp_ns] = image.data


def _put_depth(into: dict[Key, bytes], camera_id: str, data: bytes) -> None:
    into[camera_id, DepthImage.from_cdr(data).stamp_ns] = data


def _score(images: Images, net: PerceptualNet | None, key: Key) -> ViewScore:
    where = f"camera {key[0]} at {key[1]} ns"
    rendered, recorded = images.color[RENDERED][key], images.color[RECORDED].get(key)
    if recorded is None:
        return ViewScore(reason=f"{where}: no recorded image with this stamp")
    try:
        recorded_u8 = decode_color(recorded)
        scores = image_metrics.score_pair(
            recorded_u8, decode_color(rendered), masks=images.masks_of(key), net=net
        )
        depth = _score_depth(images, key)
    except GstError as error:
        return ViewScore(reason=f"{where}: {error}")
    return ViewScore(
        camera_id=key[0],
        stamp_ns=key[1],
        size=(recorded_u8.shape[0], recorded_u8.shape[1]),
        scores=scores,
        depth=depth,
        jpeg=rendered.startswith(JPEG_MAGIC),
    )


def _score_depth(images: Images, key: Key) -> DepthScore | None:
    pair = [of[key] for name in (RECORDED, RENDERED) if key in (of := images.depth[name])]
    if len(pair) < 2:
        return None
    try:
        recorded_m, rendered_m = (DepthImage.from_cdr(data).depth_m() for data in pair)
        return image_metrics.score_depth(recorded_m, rendered_m)
    except UndefinedStatisticError:
        return None


NOT_A_SAMPLE = "views of one scene are no random sample of views; each image is in the table"


def size_words(sizes: Iterable[tuple[int, int]]) -> str:
    """Write the sizes of images, given as (height, width) [px]."""
    found = sorted(set(sizes))
    if not found:
        return "no image"
    words = ", ".join(f"{width} x {height}" for height, width in found[:3])
    return words if len(found) <= 3 else f"{words} and {len(found) - 3} other sizes"


def measure_images(
    quantities: Mapping[tuple[str, bool], Quantity],
    scores: Sequence[Mapping[str, ImageScore]],
    protocol: str,
    *,
    net: PerceptualNet | None = None,
    episodes: Sequence[str] = (),
    **part: str,
) -> list[Measurement]:
    """Measure the mean of every metric that each variant can have; no number without its protocol.

    ``quantities``: by the metric, and whether the images were compared as they are stored.
    """
    variants = {variant: None for score in scores for variant in score} or {RAW: None}
    found = []
    for variant in variants:
        of_variant = [score[variant] for score in scores if variant in score]
        asked = {name for score in of_variant for name in (*score.values, *score.reasons)}
        for metric in image_metrics.METRICS.values():
            if metric.id == image_metrics.LPIPS and net is None:
                continue
            if variant != RAW and metric.id not in asked:
                continue
            told = [image_metrics.variant_words(variant), protocol, _lacking(metric, of_variant)]
            if net is not None and metric.id == image_metrics.LPIPS:
                told.append(f"weights {net.weights}")
            words = "".join(f"; {each}" for each in told if each)
            values = [s.values[metric.id] for s in of_variant if metric.id in s.values]
            quantity = quantities[metric.id, variant == RAW]
            found.append(
                measured(
                    quantity.of(variant=variant, protocol=words, **part),
                    partial(mean_of, values, metric.column, _first_reason(metric, of_variant)),
                    n=len(values),
                    counted="image",
                    reason_without_interval=NOT_A_SAMPLE,
                    episodes=episodes,
                )
            )
    return found


def _first_reason(metric: ImageMetric, scores: Sequence[ImageScore]) -> str:
    found = (score.reasons[metric.id] for score in scores if metric.id in score.reasons)
    return next(found, "no pair of images has it")


def _lacking(metric: ImageMetric, scores: Sequence[ImageScore]) -> str:
    """Count the images that the mean leaves out, with the first reason."""
    without = sum(metric.id in score.reasons for score in scores)
    if not 0 < without < len(scores):
        return ""
    return f"not in the mean: {without} of {len(scores)} images ({_first_reason(metric, scores)})"
