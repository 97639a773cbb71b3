"""Scores of rendered views as the cache keeps them: plain records without images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from evaluator.compare.cache import SummaryCache
from evaluator.compare.variants import AFFINE, GAIN, POSE_GAIN, RAW, masked
from evaluator.compare.view_images import Images, ViewScore, score_views
from evaluator.metrics.depth import DepthScore
from evaluator.metrics.lpips import PerceptualNet
from evaluator.metrics.scores import ImageScore


@dataclass(frozen=True, kw_only=True)
class ViewSummary:
    """One view that was scored, or the reason why it could not be."""

    reason: str = ""
    camera_id: str = ""
    stamp_ns: int = 0
    size: tuple[int, ...] = ()
    masks: tuple[str, ...] = ()
    scores: Mapping[str, ImageScore]
    """By the name of the variant."""
    depth: DepthScore | None = None
    jpeg: bool = False


def scored_views(
    images: Images, key: str, cache: SummaryCache, *, nets: Sequence[PerceptualNet] = ()
) -> tuple[list[ViewScore], list[str]]:
    """Score the views of one episode as ``score_views`` does, or take what is kept of them.

    Args:
        images: Of the episode.
        key: Names every file the scores follow from by its content.
        cache: Of this evaluation.
        nets: For LPIPS; their weights belong to the key, which names them here.
    """
    key = " ".join([key, *(net.weights for net in nets)])

    def make() -> tuple[ViewSummary, ...]:
        scores, reasons = score_views(images, nets=nets)
        gone = (ViewSummary(reason=reason, scores={}) for reason in reasons)
        return (*map(_summary_of, scores), *gone)

    kept = cache.kept_or_made(ViewSummary, key, make)
    scores = [_score_of(view) for view in kept if not view.reason]
    return scores, [view.reason for view in kept if view.reason]


def _summary_of(score: ViewScore) -> ViewSummary:
    return ViewSummary(
        camera_id=score.camera_id,
        stamp_ns=score.stamp_ns,
        size=score.size,
        masks=tuple(dict.fromkeys(variant.mask for variant in score.scores if variant.mask)),
        scores={variant.name: found for variant, found in score.scores.items()},
        depth=score.depth,
        jpeg=score.jpeg,
    )


def _score_of(view: ViewSummary) -> ViewScore:
    variants = [RAW, GAIN, AFFINE, POSE_GAIN]
    variants += [variant for name in view.masks for variant in masked(name)]
    named = {variant.name: variant for variant in variants}
    height, width = view.size
    return ViewScore(
        camera_id=view.camera_id,
        stamp_ns=view.stamp_ns,
        size=(height, width),
        scores={named[name]: found for name, found in view.scores.items()},
        depth=view.depth,
        jpeg=view.jpeg,
    )
