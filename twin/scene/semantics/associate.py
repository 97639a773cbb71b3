"""One thing, many masks: match the masks of all frames and decide each Gaussian.

Ids of masks differ from frame to frame, masks bleed, shift, are missing or carry a wrong name.
Whether two masks mean the same thing is decided on the Gaussians that both frames show.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt16
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from twin.naming.colours import lab_from_srgb, without_shading
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.semantics.lift import Observation


@dataclass(frozen=True, kw_only=True)
class SmoothConfig:
    """How far and across what shares spread."""

    num_neighbours: int = 12
    """Of each Gaussian."""
    num_steps: int = 8
    """Of diffusion; an edge moves by about the square root of it in spacings."""
    colour_gap: float = 9.0
    """Lab distance across which nothing spreads."""
    keep: float = 0.1
    """What a Gaussian was told weighs at least against its neighbours, each step."""
    lightness_weight: float = 0.3
    """Shading is no edge."""


def smooth_shares(
    share: Float32[np.ndarray, "num_things num_splats"], cloud: GaussianCloud, config: SmoothConfig
) -> Float32[np.ndarray, "num_things num_splats"]:
    """Let neighbours of one colour agree whose they are.

    Masks bleed and shrink at random; the edge of a colour is where a thing ends. Gaussians near
    any mask take part, all others keep their share of zero.

    Args:
        share: How much of each Gaussian the masks give to each thing, 0..1.
    """
    told = np.flatnonzero(share.max(axis=0, initial=0.0) > 0.01)
    if len(told) <= config.num_neighbours:
        return share
    lab = lab_from_srgb(cloud.colors)
    colour = without_shading(lab, config.lightness_weight)
    p = cloud.means_m.astype(np.float64)
    gap, near = cKDTree(p).query(p[told], k=config.num_neighbours + 1)
    reach = np.median(gap[:, -1])
    different = np.linalg.norm(colour[told][:, None] - colour[near], axis=2)
    weight = np.exp(-0.5 * (gap / reach) ** 2 - 0.5 * (different / config.colour_gap) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(told)), near.shape[1])
    spread = csr_matrix((weight.ravel(), (rows, near.ravel())), shape=(len(told), len(p)))
    state = share.astype(np.float64).T
    first = state[told].copy()
    # Frames that agree decide; where they do not, the neighbours decide.
    agreed = np.abs(2.0 * first.max(axis=1, keepdims=True) - 1.0) ** 2
    keep = np.maximum(config.keep, agreed)
    for _ in range(config.num_steps):
        state[told] = keep * first + (1.0 - keep) * (spread @ state)
    return as_float32(state.T)


Smooth = Callable[[np.ndarray], np.ndarray]
"""Takes and gives shares, one row for each thing, one column for each Gaussian."""


@dataclass(frozen=True, kw_only=True)
class AssociateConfig:
    """When masks mean the same thing, and when a thing exists."""

    inside_fraction: float = 0.5
    """A Gaussian belongs to a mask that covers more than this of what it shows."""
    min_iou: float = 0.25
    """Of two sets of Gaussians, over those both could show."""
    visible_fraction: float = 0.2
    """A frame sees a thing when it shows at least this share of its Gaussians."""
    min_hit_fraction: float = 0.4
    """Frames with a matching mask, of those that see the thing."""
    min_support: int = 3
    """Frames with a matching mask."""
    min_splats: int = 10
    """A thing of fewer Gaussians is none."""
    background_bias: float = 0.0
    """Added to the background's share: positive where masks bleed, negative where they shrink."""


@dataclass(frozen=True, kw_only=True)
class Track:
    """One thing found in several frames."""

    label: str
    """What most of its masks are called, weighted by their scores."""
    score: float
    """Mean score of its masks."""
    support: int
    """Frames with a mask of it."""
    seen: int
    """Frames that show it."""
    mask: Bool[np.ndarray, " num_splats"]


@dataclass(frozen=True, kw_only=True)
class Association:
    """Things, and whose each Gaussian is."""

    tracks: tuple[Track, ...]
    """Largest first."""
    labels: UInt16[np.ndarray, " num_splats"]
    """Index of the track plus one; 0 is the background."""


def associate(
    observations: Sequence[Observation],
    num_splats: int,
    config: AssociateConfig,
    smooth: Smooth | None = None,
) -> Association:
    """Match masks across frames and decide each Gaussian by the frames that had a mask.

    First the frames in turn vote candidates together; then every frame is matched once more
    against the finished candidates, so that the order of frames hardly matters. A Gaussian goes
    to the thing with the largest share of its light inside matching masks, if that is more than
    the background's share plus ``background_bias``. Frames whose mask of the thing is missing
    do not count against it: a dropped mask says nothing about the edge.
    """
    candidates = _candidates(observations, num_splats, config)
    sets = [votes > 0 for votes in candidates]
    matches = [_match(item, sets, config) for item in observations]
    hits = np.zeros(len(sets), dtype=np.int64)
    seen = np.zeros(len(sets), dtype=np.int64)
    for item, matched in zip(observations, matches, strict=True):
        shown = _shown(item, sets, config)
        shown[list(matched)] = True
        seen += shown
        hits[list(matched)] += 1
    firm = (hits >= config.min_support) & (hits > config.min_hit_fraction * seen)
    kept = [int(index) for index in np.flatnonzero(firm)]
    share = _shares(observations, matches, kept, num_splats)
    labels = _decide(share if smooth is None else smooth(share), config)
    return _association(observations, matches, kept, labels, hits, seen, config)


def _candidates(
    observations: Sequence[Observation], num_splats: int, config: AssociateConfig
) -> list[np.ndarray]:
    """Votes of the frames, for (+1) and against (-1) each Gaussian of each candidate."""
    votes: list[np.ndarray] = []
    for item in observations:
        inside = item.inside > config.inside_fraction
        matched = {
            mask: track for track, mask in _match(item, [v > 0 for v in votes], config).items()
        }
        for mask in range(inside.shape[1]):
            if int(inside[:, mask].sum()) < config.min_splats:
                continue
            if mask not in matched:
                votes.append(np.zeros(num_splats, dtype=np.int16))
                matched[mask] = len(votes) - 1
            votes[matched[mask]][item.splat_ids] += np.where(inside[:, mask], 1, -1).astype(
                np.int16
            )
    return votes


def _match(
    item: Observation, sets: Sequence[np.ndarray], config: AssociateConfig
) -> dict[int, int]:
    """Best pairs first, each track and each mask once: mask of each matched track."""
    if not sets or item.inside.shape[1] == 0:
        return {}
    inside = (item.inside > config.inside_fraction).astype(np.float32)
    tracks = np.stack([members[item.splat_ids] for members in sets]).astype(np.float32)
    both = tracks @ inside
    either = tracks.sum(axis=1)[:, None] + inside.sum(axis=0)[None] - both
    iou = both / np.maximum(either, 1.0)
    found: dict[int, int] = {}
    taken: set[int] = set()
    for flat in np.argsort(-iou, axis=None, kind="stable"):
        track, mask = divmod(int(flat), iou.shape[1])
        if iou[track, mask] < config.min_iou:
            break
        if track not in found and mask not in taken:
            found[track] = mask
            taken.add(mask)
    return found


def _shown(
    item: Observation, sets: Sequence[np.ndarray], config: AssociateConfig
) -> Bool[np.ndarray, " num_tracks"]:
    shown = [members[item.splat_ids].sum() for members in sets]
    whole = [max(int(members.sum()), 1) for members in sets]
    return np.array(shown) >= config.visible_fraction * np.array(whole)


def _shares(
    observations: Sequence[Observation],
    matches: Sequence[dict[int, int]],
    kept: Sequence[int],
    num_splats: int,
) -> Float32[np.ndarray, "num_kept num_splats"]:
    """Share of each Gaussian's light within the masks of each thing, over frames with a mask."""
    share = np.zeros((len(kept), num_splats), dtype=np.float32)
    for row, track in enumerate(kept):
        total = np.zeros(num_splats, dtype=np.float32)
        for item, matched in zip(observations, matches, strict=True):
            if track in matched:
                total[item.splat_ids] += item.weight
                share[row, item.splat_ids] += item.weight * item.inside[:, matched[track]]
        share[row] /= np.maximum(total, 1e-9)
    return share


def _decide(
    share: Float32[np.ndarray, "num_kept num_splats"], config: AssociateConfig
) -> UInt16[np.ndarray, " num_splats"]:
    if len(share) == 0:
        return np.zeros(share.shape[1], dtype=np.uint16)
    best = share.max(axis=0)
    wins = best > 1.0 - best + config.background_bias
    return np.where(wins, share.argmax(axis=0) + 1, 0).astype(np.uint16)


def _association(
    observations: Sequence[Observation],
    matches: Sequence[dict[int, int]],
    kept: Sequence[int],
    labels: UInt16[np.ndarray, " num_splats"],
    hits: np.ndarray,
    seen: np.ndarray,
    config: AssociateConfig,
) -> Association:
    tracks = []
    for row, track in enumerate(kept):
        mask = labels == row + 1
        if int(mask.sum()) < config.min_splats:
            continue
        names, scores = _names(observations, matches, track)
        tracks.append(
            Track(
                label=max(sorted(names), key=lambda name: names[name]),
                score=float(np.mean(scores)),
                support=int(hits[track]),
                seen=int(seen[track]),
                mask=mask,
            )
        )
    tracks.sort(key=lambda item: (-int(item.mask.sum()), item.label, int(item.mask.argmax())))
    final = np.zeros(len(labels), dtype=np.uint16)
    for number, item in enumerate(tracks):
        final[item.mask] = number + 1
    return Association(tracks=tuple(tracks), labels=final)


def _names(
    observations: Sequence[Observation], matches: Sequence[dict[int, int]], track: int
) -> tuple[dict[str, float], list[float]]:
    names: dict[str, float] = defaultdict(float)
    scores: list[float] = []
    for item, matched in zip(observations, matches, strict=True):
        if track in matched:
            score = item.scores[matched[track]]
            names[item.labels[matched[track]]] += score
            scores.append(score)
    return names, scores
