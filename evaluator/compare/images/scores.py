"""Pair the images of a ``views`` episode, and score each pair in every way its topics allow.

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
from jaxtyping import Bool, Float, UInt8

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, DepthImage
from bridge.episode.reader import Episode
from bridge.episode.topics import (
    MASK_TOPIC,
    RECORDED_DEPTH_TOPIC,
    RECORDED_TOPIC,
    RENDERED_DEPTH_TOPIC,
    RENDERED_TOPIC,
)
from bridge.errors import GstError, MissingDependencyError
from bridge.media.color import JPEG_MAGIC, decode_color
from bridge.media.image_quality import ALIGNMENTS, Alignment, as_float
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.image import DepthScore, refuse_swapped, score_depth
from evaluator.metrics.image_protocol import MASK_MODES, MaskMode, NetName
from evaluator.metrics.image_scores import ImageScore, score_image
from evaluator.metrics.lpips import PerceptualNet


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to score a pair."""

    name: str
    """Part of the ids in ``results.json``."""
    alignment: Alignment = "raw"
    mode: MaskMode = "full"
    mask: str = ""
    """Name of the mask, where there is one."""
    learned: bool = False
    """Whether LPIPS is computed for it too; a network takes seconds for each image."""

    @property
    def mask_words(self) -> str:
        """What the mask does, for a stamp."""
        words = MASK_MODES[self.mode]
        return f"{words} {self.mask!r}" if self.mask else words

    @property
    def alignment_words(self) -> str:
        """What was fitted to the recorded image, for a stamp."""
        return ALIGNMENTS[self.alignment]

    @property
    def clamp_words(self) -> str:
        """What became of values outside 0..1."""
        return "no value outside 0..1" if self.alignment == "raw" else "to 0..1 after alignment"


RAW = Variant(name="raw", learned=True)
GAIN = Variant(name="gain", alignment="gain", learned=True)
_TAKEN = {variant.name for variant in (RAW, GAIN)}


def masked(name: str) -> Variant:
    """Return the way to score the pixels of a mask alone."""
    own = f"mask_{name}" if name in _TAKEN else name
    return Variant(name=own, mode="mask-pixels", mask=name)


def score_variants(
    recorded: UInt8[np.ndarray, "height width 3"] | Float[np.ndarray, "height width 3"],
    rendered: (
        UInt8[np.ndarray, "rendered_height rendered_width 3"]
        | Float[np.ndarray, "rendered_height rendered_width 3"]
    ),
    masks: Mapping[str, Bool[np.ndarray, "height width"]],
    *,
    nets: Sequence[PerceptualNet] = (),
) -> dict[Variant, ImageScore]:
    """Score one pair in every way."""
    ways: list[tuple[Variant, np.ndarray | None]] = [(RAW, None), (GAIN, None)]
    ways += [(masked(name), mask) for name, mask in masks.items()]
    return {
        variant: score_image(
            recorded,
            rendered,
            mask=mask,
            alignment=variant.alignment,
            nets=nets if variant.learned else (),
        )
        for variant, mask in ways
    }


def open_nets(backbones: Mapping[NetName, Path]) -> tuple[PerceptualNet, ...]:
    """Load the networks of LPIPS that were asked for; without one, torch stays out."""
    if not backbones:
        return ()
    try:
        from evaluator.metrics.lpips_torch import LpipsNet  # noqa: PLC0415  # loads torch
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise MissingDependencyError(package="torch", extra="lpips", purpose="LPIPS") from error
    return tuple(LpipsNet.open(net, path) for net, path in backbones.items())


Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_THREADS = 8
"""More only cost memory: each holds the images it works on."""


def spread(
    work: Callable[[Item], Result], items: Iterable[Item], *, threads: int | None = None
) -> list[Result]:
    """Call ``work`` on each item and return the results in the order of the items.

    Args:
        work: Must not share anything that changes.
        threads: How many at once; as many as there are cores without it.
    """
    count = min(MAX_THREADS, os.cpu_count() or 1) if threads is None else threads
    if count <= 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(max_workers=count) as pool:
        return list(pool.map(work, items))


RENDERED, RECORDED = "rendered", "recorded"
_COLOR_TOPICS = (
    (RENDERED, RENDERED_TOPIC),
    (RECORDED, RECORDED_TOPIC),
)
_DEPTH_TOPICS = (
    (RENDERED, RENDERED_DEPTH_TOPIC),
    (RECORDED, RECORDED_DEPTH_TOPIC),
)

Key = tuple[str, int]
"""Camera id and stamp [ns]."""


@dataclass(frozen=True, kw_only=True)
class ViewScore:
    """One held-out image."""

    camera_id: str
    stamp_ns: int
    size: tuple[int, int]
    """Height and width [px]."""
    scores: Mapping[Variant, ImageScore]
    """At least raw and gain; one of each mask where there are any."""
    depth: DepthScore | None
    jpeg: bool
    """The rendered image was stored lossily."""

    def psnr_db(self, variant: Variant = RAW) -> float | None:
        """None where the variant is not there or both images are identical."""
        score = self.scores.get(variant)
        return None if score is None else score.psnr_db


@dataclass(kw_only=True)
class Images:
    """Undecoded images of one views episode."""

    color: dict[str, dict[Key, bytes]] = field(default_factory=lambda: {RENDERED: {}, RECORDED: {}})
    masks: dict[str, dict[Key, bytes]] = field(default_factory=dict)
    depth: dict[str, dict[Key, bytes]] = field(default_factory=lambda: {RENDERED: {}, RECORDED: {}})

    def masks_of(self, key: Key) -> dict[str, np.ndarray]:
        """Decode the masks of one view; empty ones say nothing and are left out."""
        found = {
            name: decode_color(of[key])[..., 0] > 127
            for name, of in sorted(self.masks.items())
            if key in of
        }
        return {name: mask for name, mask in found.items() if mask.any()}


def score_views(
    images: Images, *, nets: Sequence[PerceptualNet] = ()
) -> tuple[list[ViewScore], list[str]]:
    """Score every rendered image of a views episode; what cannot be scored is a reason."""
    rendered = sorted(images.color[RENDERED])
    # A network uses all cores and much memory by itself.
    done = spread(partial(_score, images, nets), rendered, threads=1 if nets else None)
    scores = [found for found in done if isinstance(found, ViewScore)]
    reasons = [found for found in done if isinstance(found, str)]
    if not rendered:
        reasons.append("no topic .../cam/<id>/rendered/image in it")
    return scores, reasons


def images_of(views: Episode, source: Episode | None) -> Images:
    """Collect the images of a views episode."""
    images = read_images(views)
    if source is not None and not images.color[RECORDED]:
        wanted = {stamp for _, stamp in images.color[RENDERED]}
        images.color[RECORDED] = {
            key: data
            for key, data in read_images(source).color[RECORDED].items()
            if key[1] in wanted
        }
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
            if match := MASK_TOPIC.search(topic):
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


def _score(images: Images, nets: Sequence[PerceptualNet], key: Key) -> ViewScore | str:
    where = f"camera {key[0]} at {key[1]} ns"
    rendered, recorded = images.color[RENDERED][key], images.color[RECORDED].get(key)
    if recorded is None:
        return f"{where}: no recorded image with this stamp"
    try:
        recorded_u8, rendered_u8 = decode_color(recorded), decode_color(rendered)
        refuse_swapped(as_float(recorded_u8), as_float(rendered_u8))
        scores = score_variants(recorded_u8, rendered_u8, images.masks_of(key), nets=nets)
        depth = _score_depth(images, key)
    except GstError as error:
        return f"{where}: {error}"
    return ViewScore(
        camera_id=key[0],
        stamp_ns=key[1],
        size=(recorded_u8.shape[0], recorded_u8.shape[1]),
        scores=scores,
        depth=depth,
        jpeg=rendered.startswith(JPEG_MAGIC),
    )


def _score_depth(images: Images, key: Key) -> DepthScore | None:
    pair = [images.depth[name].get(key) for name in (RECORDED, RENDERED)]
    if pair[0] is None or pair[1] is None:
        return None
    try:
        return score_depth(
            DepthImage.from_cdr(pair[0]).depth_m(), DepthImage.from_cdr(pair[1]).depth_m()
        )
    except UndefinedStatisticError:
        return None
