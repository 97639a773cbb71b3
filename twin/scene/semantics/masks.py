"""One thing, many masks: lift the masks of all frames, group them, and decide each Gaussian.

Ids of masks differ from frame to frame, masks bleed, shift, are missing or carry a wrong name.
Whether two masks mean the same thing is decided on the Gaussians that both frames show.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt16
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from twin.naming.things import Instance, Mask
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.semantics.lift import Viewpoint, lifted

MIN_WEIGHT = 0.05
"""A Gaussian that gives a frame less than this share of one pixel is not seen in it."""
INSIDE = 0.5
"""A Gaussian belongs to a mask that covers more than this of what it shows."""
MIN_IOU = 0.25
"""Of the masks of one thing on average, over the Gaussians that both frames show."""
VISIBLE = 0.2
"""A frame sees a thing when it shows at least this share of its Gaussians."""
MIN_HITS = 0.4
"""Frames with a mask of a thing, of those that see it."""
MIN_SUPPORT = 3
"""Frames with a mask of a thing."""
MIN_SPLATS = 10
"""A mask or a thing of fewer Gaussians is none."""


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What the masks of one frame say about the Gaussians it shows."""

    splat_ids: Int[np.ndarray, " num_visible"]
    weight: Float32[np.ndarray, " num_visible"]
    """Pixels' worth of the image that each gives."""
    inside: Float32[np.ndarray, "num_visible num_masks"]
    """Share of that within each mask, 0..1."""
    labels: tuple[str, ...]
    scores: tuple[float, ...]


def observe(
    rasteriser: Rasteriser, cloud: GaussianCloud, viewpoint: Viewpoint, masks: Sequence[Mask]
) -> Observation:
    """Carry the masks of one frame to the Gaussians."""
    camera = viewpoint.camera
    whole = np.ones((camera.height, camera.width), dtype=bool)
    stack = np.stack([whole, *(mask.image for mask in masks)]).astype(np.float32)
    shown = lifted(rasteriser, cloud, viewpoint, stack)
    ids = np.flatnonzero(shown[:, 0] > MIN_WEIGHT)
    weight = shown[ids, 0]
    return Observation(
        splat_ids=ids,
        weight=weight,
        inside=as_float32(np.clip(shown[ids, 1:] / weight[:, None], 0.0, 1.0)),
        labels=tuple(mask.label for mask in masks),
        scores=tuple(float(mask.score) for mask in masks),
    )


def associate(
    observations: Sequence[Observation], num_splats: int, source: str = ""
) -> tuple[tuple[Instance, ...], UInt16[np.ndarray, " num_splats"]]:
    """Find the things that the masks of many frames agree on, the largest first.

    Masks are clustered by the mean of their IoU. A Gaussian goes to the thing with the largest
    share of its light inside the thing's masks, if that is more than the background's share.
    Frames whose mask of the thing is missing do not count against it: a dropped mask says nothing
    about the edge.
    """
    masks = [
        (frame, int(column))
        for frame, item in enumerate(observations)
        for column in np.flatnonzero((item.inside > INSIDE).sum(axis=0) >= MIN_SPLATS)
    ]
    groups: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for pair, group in zip(masks, _clusters(observations, num_splats, masks), strict=True):
        groups[int(group)].append(pair)
    kept, share = [], [np.zeros(num_splats, dtype=np.float32)]
    for members in groups.values():
        of_thing = _share(observations, members, num_splats)
        support, seen = _counts(observations, members, of_thing > INSIDE)
        if support >= MIN_SUPPORT and support > MIN_HITS * seen:
            kept.append(members)
            share.append(of_thing)
    best = np.max(share, axis=0)
    owner = np.where(best > 1.0 - best, np.argmax(share, axis=0), 0)
    things = [
        Instance(id=0, mask=owner == number, source=source, **_named(observations, members))
        for number, members in enumerate(kept, start=1)
        if int((owner == number).sum()) >= MIN_SPLATS
    ]
    things.sort(key=lambda item: (-int(item.mask.sum()), item.label, int(item.mask.argmax())))
    labels = np.zeros(num_splats, dtype=np.uint16)
    for number, thing in enumerate(things, start=1):
        labels[thing.mask] = number
    return tuple(replace(thing, id=n) for n, thing in enumerate(things, start=1)), labels


def _clusters(
    observations: Sequence[Observation], num_splats: int, masks: Sequence[tuple[int, int]]
) -> Int[np.ndarray, " num_masks"]:
    """A number for each mask; those of one thing have the same."""
    if len(masks) < 2:
        return np.arange(len(masks))
    sets = np.zeros((len(masks), num_splats), dtype=np.float32)
    shown = np.zeros((len(masks), num_splats), dtype=np.float32)
    for row, (frame, column) in enumerate(masks):
        item = observations[frame]
        shown[row, item.splat_ids] = 1.0
        sets[row, item.splat_ids] = item.inside[:, column] > INSIDE
    both, common = sets @ sets.T, sets @ shown.T
    iou = both / np.maximum(common + common.T - both, 1.0)
    distance = squareform(1.0 - np.clip((iou + iou.T) / 2, 0.0, 1.0), checks=False)
    return np.asarray(fcluster(linkage(distance, "average"), 1.0 - MIN_IOU, "distance"))


def _share(
    observations: Sequence[Observation], members: Sequence[tuple[int, int]], num_splats: int
) -> Float32[np.ndarray, " num_splats"]:
    """Share of each Gaussian's light within the masks of a thing, over frames with a mask."""
    inside, total = np.zeros((2, num_splats), dtype=np.float32)
    for frame in {frame for frame, _ in members}:
        item = observations[frame]
        columns = [column for owner, column in members if owner == frame]
        total[item.splat_ids] += item.weight
        inside[item.splat_ids] += item.weight * item.inside[:, columns].max(axis=1)
    return inside / np.maximum(total, 1e-9)


def _counts(
    observations: Sequence[Observation],
    members: Sequence[tuple[int, int]],
    of_thing: Bool[np.ndarray, " num_splats"],
) -> tuple[int, int]:
    """Frames with a mask of a thing, and frames that see it."""
    hit, least = {frame for frame, _ in members}, VISIBLE * max(int(of_thing.sum()), 1)
    shown = {k for k, item in enumerate(observations) if of_thing[item.splat_ids].sum() >= least}
    return len(hit), len(hit | shown)


def _named(
    observations: Sequence[Observation], members: Sequence[tuple[int, int]]
) -> dict[str, Any]:
    """What most of its masks are called, and how sure they are."""
    names: dict[str, float] = defaultdict(float)
    scores = [observations[frame].scores[column] for frame, column in members]
    for (frame, column), score in zip(members, scores, strict=True):
        names[observations[frame].labels[column]] += score
    label = max(sorted(names), key=lambda name: names[name])
    return {"label": label, "score": float(np.mean(scores))}
