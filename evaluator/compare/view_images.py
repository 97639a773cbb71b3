"""Pair the images of a ``views`` episode, and score each pair in every way its topics allow.

Topics end in ``/cam/<id>/`` and ``rendered/image``, ``recorded/image`` (or, in the source episode,
``color/image``), ``pose_aligned/image``, ``mask/<name>/image`` or ``mask/<name>`` (white inside),
``rendered/depth``, ``recorded/depth`` and ``recorded/depth_in_color``.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, DepthImage
from bridge.episode.reader import Episode
from bridge.errors import GstError
from bridge.media.color import JPEG_MAGIC, decode_color
from evaluator.compare.parallel import spread
from evaluator.compare.variants import POSE_GAIN, RAW, Variant, score_variants
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.depth import DepthScore, score_depth
from evaluator.metrics.image import as_float, refuse_swapped
from evaluator.metrics.lpips import PerceptualNet
from evaluator.metrics.scores import ImageScore, score_image

RENDERED, RECORDED, POSED = "rendered", "recorded", "pose_aligned"
_COLOR_TOPICS = (
    (RENDERED, re.compile(r"/cam/([^/]+)/(?:color/)?(?:rendered|replayed)(?:/image)?$")),
    (RECORDED, re.compile(r"/cam/([^/]+)/(?:color|recorded)(?:/image)?$")),
    (POSED, re.compile(r"/cam/([^/]+)/pose_aligned(?:/image)?$")),
)
_MASK_TOPIC = re.compile(r"/cam/([^/]+)/mask/([a-z_]+)(?:/image)?$")
_DEPTH_TOPICS = (
    (RENDERED, re.compile(r"/cam/([^/]+)/rendered/depth$")),
    (RECORDED, re.compile(r"/cam/([^/]+)/recorded/depth(?:_in_color)?$")),
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
    """At least raw, gain and affine; pose_gain and both ways of each mask where there are any."""
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

    color: dict[str, dict[Key, bytes]] = field(
        default_factory=lambda: {RENDERED: {}, RECORDED: {}, POSED: {}}
    )
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
    """Score every rendered image of a views episode; what cannot be scored is a reason.

    Args:
        images: As ``images_of`` collects them.
        nets: For LPIPS; none leaves it out.
    """
    rendered = sorted(images.color[RENDERED])
    # A network uses all cores and much memory by itself.
    done = spread(partial(_score, images, nets), rendered, threads=1 if nets else None)
    scores = [found for found in done if isinstance(found, ViewScore)]
    reasons = [found for found in done if isinstance(found, str)]
    if not rendered:
        reasons.append("no topic .../cam/<id>/rendered/image in it")
    return scores, reasons


def images_of(views: Episode, source: Episode | None) -> Images:
    """Collect the images of a views episode.

    Args:
        views: The derived episode.
        source: What it was made from; recorded images are looked for there if it has none.
    """
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
            if match := _MASK_TOPIC.search(topic):
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
        posed = images.color[POSED].get(key)
        if posed is not None:
            scores[POSE_GAIN] = score_image(recorded_u8, decode_color(posed), alignment="gain")
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
