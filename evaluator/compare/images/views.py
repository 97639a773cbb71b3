"""Score rendered views against the held-out recorded images they stand for.

``scores`` pairs and scores the images of one episode; here the newest views of each recorded
episode are found, and their scores become measurements, each with its protocol.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode.reader import Episode
from bridge.errors import GstError
from evaluator.cache import SummaryCache
from evaluator.compare.images.scores import (
    GAIN,
    RAW,
    Images,
    Variant,
    ViewScore,
    images_of,
    masked,
    score_views,
)
from evaluator.compare.images.tables import (
    Protocol,
    per_image_table,
    resolution_words,
    stamped_measurements,
)
from evaluator.compare.measure import measured
from evaluator.measurements import DEPTHS, LPIPS_MISSING, VIEWS, slug
from evaluator.metrics.image import DepthScore
from evaluator.metrics.image_protocol import UNSTATED
from evaluator.metrics.image_scores import ImageScore
from evaluator.metrics.lpips import LPIPS_NOT_COMPUTED, PerceptualNet
from evaluator.result import Exclusion, Measurement, Table
from evaluator.run_reader.episodes import DerivedFile


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
    """Score the views of one episode as ``score_views`` does, or take what is kept of them."""
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
    variants = [RAW, GAIN, *map(masked, view.masks)]
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


TWIN = "twin"
"""What the run's own renders are called beside other methods."""
Source = tuple[Path, str]
"""A recorded episode: its file, and the content hash of it."""


@dataclass(frozen=True, kw_only=True)
class ViewReport:
    """What all ``views`` episodes of a run say."""

    measurements: tuple[Measurement, ...] = ()
    tables: tuple[Table, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    missing: tuple[str, ...] = ()


def compare_views(
    files: Sequence[DerivedFile],
    sources: Mapping[str, Source],
    *,
    nets: Sequence[PerceptualNet] = (),
    cache: SummaryCache | None = None,
) -> ViewReport:
    """Compute every image metric of every rendered view, per image and mean."""
    cache = SummaryCache(None) if cache is None else cache
    views, left_out = newest_views(files, sources)
    if not views:
        return ViewReport(
            missing=("views: no rendered views (robot-gst rebuild makes them)",),
            exclusions=tuple(left_out),
        )
    tables: list[Table] = []
    found: dict[str, list[ViewScore]] = {}
    of: dict[str, DerivedFile] = {}
    for file in views:
        name = file.path.stem
        source = file.derived.source_episode
        try:
            recorded = sources.get(source)
            images = images_of(file.episode, opened(recorded))
            key = f"{file.sha256} {'-' if recorded is None else recorded[1]}"
            scores, reasons = scored_views(images, key, cache, nets=nets)
        except GstError as error:
            left_out.append(Exclusion(episode=file.path.name, scope="views", reason=str(error)))
            continue
        left_out += [Exclusion(episode=name, scope="views", reason=reason) for reason in reasons]
        found[source], of[source] = scores, file
        tables.append(per_image_table(f"views_{len(tables)}", f"Held-out views: {name}", scores))
    everything = [score for scores in found.values() for score in scores]
    measurements = _measure("all", list(found), everything, of.values(), nets)
    for source, scores in found.items() if len(found) > 1 else ():
        measurements += _measure(slug(source), [source], scores, [of[source]], nets)
    return ViewReport(
        measurements=tuple(measurements),
        tables=tuple(tables),
        exclusions=tuple(left_out),
    )


def newest_views(
    files: Sequence[DerivedFile], sources: Mapping[str, Source]
) -> tuple[list[DerivedFile], list[Exclusion]]:
    """Find the newest views of each recorded episode; stale and older ones are left out by name."""
    views, stale = _current([file for file in files if file.derived.kind == "views"], sources)
    views, older = _newest(views)
    return views, [*older, *stale]


def opened(source: Source | None) -> Episode | None:
    """Open a recorded episode, where there is one."""
    return None if source is None else Episode.open(source[0])


def _current(
    views: Sequence[DerivedFile], sources: Mapping[str, Source]
) -> tuple[list[DerivedFile], list[Exclusion]]:
    """Leave out views that were made from another version of their recorded episode."""
    stale = []
    for file in views:
        source = sources.get(file.derived.source_episode)
        if source is not None and file.derived.source_sha256 not in ("", source[1]):
            stale.append(file)
    reason = "made from another version of the episode (its hash differs); rebuild again"
    left_out = [Exclusion(episode=f.path.name, scope="views", reason=reason) for f in stale]
    return [file for file in views if file not in stale], left_out


def _newest(views: Sequence[DerivedFile]) -> tuple[list[DerivedFile], list[Exclusion]]:
    """Keep the newest views of each recorded episode; older scenes are named and left out."""
    newest: dict[str, DerivedFile] = {}
    for file in sorted(views, key=lambda item: (item.path.stat().st_mtime_ns, item.path.name)):
        newest[file.derived.source_episode] = file
    kept = [file for file in views if file is newest[file.derived.source_episode]]
    reason = "views of an older scene; there are newer ones of the same episode"
    left_out = [
        Exclusion(episode=file.path.name, scope="views", reason=reason)
        for file in views
        if file not in kept
    ]
    return kept, left_out


def _measure(
    part: str,
    episodes: Sequence[str],
    scores: Sequence[ViewScore],
    files: Iterable[DerivedFile],
    nets: Sequence[PerceptualNet],
) -> list[Measurement]:
    """All numbers about some views; the raw ones first."""
    settings: list[Mapping[str, Any]] = [file.derived.settings for file in files]
    described = _described(settings)
    stored = "rendered images stored as JPEG" if any(s.jpeg for s in scores) else "stored lossless"
    protocol = Protocol(
        resolution=resolution_words([score.size for score in scores]),
        split=agreed_setting(settings, "holdout") or UNSTATED,
        stored=stored,
        nets=nets,
        note=described,
    )
    variants: dict[Variant, None] = {}
    for score in scores:
        variants |= dict.fromkeys(score.scores)
    stamped = [
        number
        for variant in variants or {RAW: None}
        for number in stamped_measurements(
            VIEWS,
            variant,
            [s.scores[variant] for s in scores if variant in s.scores],
            protocol,
            episodes=episodes,
            part=part,
        )
    ]
    measurements = [number.measurement for number in stamped]
    after = "; ".join(part for part in (stored, "mean of per-image values", described) if part)
    measurements += _measure_depth(part, episodes, scores, after)
    if not nets:
        measurements.append(
            Measurement(
                **vars(LPIPS_MISSING.of(part=part)),
                value=None,
                reason_if_undefined=LPIPS_NOT_COMPUTED,
                episodes=tuple(episodes),
            )
        )
    return measurements


def _measure_depth(
    part: str, episodes: Sequence[str], scores: Sequence[ViewScore], after: str
) -> list[Measurement]:
    depths = [score.depth for score in scores if score.depth is not None]
    if not depths:
        return []
    return [
        measured(
            quantity.of(part=part, after=after),
            partial(_mean_depth_m, depths, name),
            n=len(depths),
            counted="image",
            reason_without_interval="the per-image list is in the table",
            episodes=episodes,
        )
        for name, quantity in DEPTHS.items()
    ]


def agreed_setting(settings: Sequence[Mapping[str, Any]], name: str) -> str:
    """Return what all views say of one setting, or nothing."""
    values = [each.get(name) for each in settings]
    if not values or values[0] is None or any(value != values[0] for value in values):
        return ""
    value = values[0]
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _described(settings: Sequence[Mapping[str, Any]]) -> str:
    """What the views say about how their scenes were made, where they agree."""
    parts = []
    for name, text in (
        ("holdout", "held out: {}"),
        ("training", "learnt from: {}"),
        ("train_frames", "{} training frames"),
        ("cameras_from", "cameras from {}"),
        ("num_splats", "{} Gaussians"),
        ("fit_cpu_seconds", "fitted in {} CPU seconds"),
        ("peak_memory_mb", "at most {} MB"),
    ):
        if agreed := agreed_setting(settings, name):
            parts.append(text.format(agreed))
    return "; ".join(parts)


def _mean_depth_m(depths: Sequence[DepthScore], name: str) -> float:
    return float(np.mean([getattr(depth, name) for depth in depths]))
