"""Pair the images of a ``views`` episode, and score each pair in every way its topics allow.

Topics end in ``/cam/<id>/`` and ``rendered/image``, ``recorded/image`` (or, in the source episode,
``color/image``), ``pose_aligned/image``, ``mask/<name>/image`` or ``mask/<name>`` (white inside),
``rendered/depth``, ``recorded/depth`` and ``recorded/depth_in_color``.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from bridge.episode import schema
from bridge.episode.reader import Episode
from bridge.episode.records import CompressedColor, DepthImage
from bridge.errors import GstError
from bridge.media.color import decode_color
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.depth import DepthScore, score_depth
from evaluator.metrics.image import ALIGNMENTS, ImageScore, score_image

RENDERED, RECORDED, POSED = "rendered", "recorded", "pose_aligned"
POSE_GAIN = "pose_gain"
"""Variant: rendered where pose and brightness were fitted to the recorded image."""
VARIANTS = {
    **{str(name): f"full frame, no mask, {text}" for name, text in ALIGNMENTS.items()},
    POSE_GAIN: (
        "full frame, no mask, camera pose and one gain per channel fitted to the recorded image: "
        "not strictly held out"
    ),
}
"""What each variant that any view may have stands for; masked ones are named by their mask."""
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
    scores: Mapping[str, ImageScore]
    """By variant: raw, gain, affine, pose_gain, and each mask's name."""
    depth: DepthScore | None
    jpeg: bool
    """The rendered image was stored lossily."""


@dataclass(kw_only=True)
class Images:
    """Undecoded images of one views episode."""

    color: dict[str, dict[Key, bytes]] = field(
        default_factory=lambda: {RENDERED: {}, RECORDED: {}, POSED: {}}
    )
    masks: dict[str, dict[Key, bytes]] = field(default_factory=dict)
    depth: dict[str, dict[Key, bytes]] = field(default_factory=lambda: {RENDERED: {}, RECORDED: {}})


def score_views(views: Episode, source: Episode | None) -> tuple[list[ViewScore], list[str]]:
    """Score every rendered image of a views episode; what cannot be scored is a reason.

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
    scores, reasons = [], []
    for key, rendered in sorted(images.color[RENDERED].items()):
        where = f"camera {key[0]} at {key[1]} ns"
        recorded = images.color[RECORDED].get(key)
        if recorded is None:
            reasons.append(f"{where}: no recorded image with this stamp")
            continue
        try:
            scores.append(_score(images, key, recorded, rendered))
        except GstError as error:
            reasons.append(f"{where}: {error}")
    if not images.color[RENDERED]:
        reasons.append("no topic .../cam/<id>/rendered/image in it")
    return scores, reasons


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


def _score(images: Images, key: Key, recorded: bytes, rendered: bytes) -> ViewScore:
    recorded_u8, rendered_u8 = decode_color(recorded), decode_color(rendered)
    scores = {
        str(alignment): score_image(recorded_u8, rendered_u8, alignment=alignment)
        for alignment in ALIGNMENTS
    }
    posed = images.color[POSED].get(key)
    if posed is not None:
        scores[POSE_GAIN] = score_image(recorded_u8, decode_color(posed), alignment="gain")
    for name, mask in _masks(images, key):
        scores[name] = score_image(recorded_u8, rendered_u8, mask=mask)
    return ViewScore(
        camera_id=key[0],
        stamp_ns=key[1],
        scores=scores,
        depth=_score_depth(images, key),
        jpeg=rendered.startswith(b"\xff\xd8"),
    )


def _masks(images: Images, key: Key) -> Iterator[tuple[str, np.ndarray]]:
    for name, found in sorted(images.masks.items()):
        if key in found:
            mask = decode_color(found[key])[..., 0] > 127
            if mask.any():
                yield name, mask


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
