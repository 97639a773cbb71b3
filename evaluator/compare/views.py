"""Score rendered views against the held-out recorded images they stand for.

A ``views`` episode carries rendered images on ``.../cam/<id>/rendered/image`` and, beside them,
the recorded ones on ``.../cam/<id>/recorded/image`` (or, in its source episode,
``.../color/image``); equal stamps belong together.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from bridge.episode import schema
from bridge.episode.reader import Episode
from bridge.episode.records import CompressedColor
from bridge.errors import GstError
from bridge.media.color import decode_color
from evaluator.compare.measure import measured, slug
from evaluator.compare.replays import DerivedFile
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.image import (
    LPIPS_NOT_COMPUTED,
    PSNR_PROTOCOL,
    SSIM_PROTOCOL,
    ImageScore,
    score_image,
)
from evaluator.result import Exclusion, Measurement, Table

_RENDERED = re.compile(r"/cam/([^/]+)/(?:color/)?(?:rendered|replayed)(?:/image)?$")
_RECORDED = re.compile(r"/cam/([^/]+)/(?:color|recorded)(?:/image)?$")


@dataclass(frozen=True, kw_only=True)
class ViewScore:
    """One held-out image."""

    camera_id: str
    stamp_ns: int
    score: ImageScore
    jpeg: bool
    """The rendered image was stored lossily."""


@dataclass(frozen=True, kw_only=True)
class ViewReport:
    """What all ``views`` episodes of a run say."""

    measurements: tuple[Measurement, ...] = ()
    tables: tuple[Table, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    missing: tuple[str, ...] = ()


@dataclass(kw_only=True)
class _Images:
    """Undecoded images by camera and stamp."""

    rendered: dict[tuple[str, int], bytes] = field(default_factory=dict)
    recorded: dict[tuple[str, int], bytes] = field(default_factory=dict)


def compare_views(
    files: Sequence[DerivedFile], recorded: Sequence[Episode], hashes: Mapping[Path, str]
) -> ViewReport:
    """Compute PSNR and SSIM of every rendered view, per image and mean.

    Args:
        files: Every derived episode of the run.
        recorded: Every recorded episode.
        hashes: Content hash of each; views made from other bytes are stale and left out.
    """
    now = {episode.info.id: hashes[episode.path] for episode in recorded}
    views, stale = _current([file for file in files if file.derived.kind == "views"], now)
    views, left_out = _newest(views)
    left_out += stale
    if not views:
        return ViewReport(
            missing=("views: no rendered views (robot-gst rebuild makes them)",),
            exclusions=tuple(left_out),
        )
    sources = {episode.info.id: episode for episode in recorded}
    tables: list[Table] = []
    found: dict[str, list[ViewScore]] = {}
    for file in views:
        name = file.path.stem
        source = file.derived.source_episode
        try:
            scores, reasons = _scores(file, sources.get(source))
        except GstError as error:
            left_out.append(Exclusion(episode=file.path.name, scope="views", reason=str(error)))
            continue
        left_out += [Exclusion(episode=name, scope="views", reason=reason) for reason in reasons]
        found[source] = scores
        tables.append(_table(f"views_{len(tables)}", name, scores))
    everything = [score for scores in found.values() for score in scores]
    measurements = _measure("all", list(found), everything)
    for source, scores in found.items() if len(found) > 1 else ():
        measurements += _measure(slug(source), [source], scores)
    return ViewReport(
        measurements=tuple(measurements), tables=tuple(tables), exclusions=tuple(left_out)
    )


def _current(
    views: Sequence[DerivedFile], now: Mapping[str, str]
) -> tuple[list[DerivedFile], list[Exclusion]]:
    """Leave out views that were made from another version of their recorded episode."""
    stale = [
        file
        for file in views
        if file.derived.source_sha256 not in ("", now.get(file.derived.source_episode, ""))
        and file.derived.source_episode in now
    ]
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


def _scores(file: DerivedFile, source: Episode | None) -> tuple[list[ViewScore], list[str]]:
    images = _Images()
    _collect(file.episode, images)
    if source is not None and not images.recorded:
        _collect(source, images, wanted={stamp for _, stamp in images.rendered})
    scores, reasons = [], []
    for (camera_id, stamp_ns), rendered in sorted(images.rendered.items()):
        recorded = images.recorded.get((camera_id, stamp_ns))
        where = f"camera {camera_id} at {stamp_ns} ns"
        if recorded is None:
            reasons.append(f"{where}: no recorded image with this stamp")
            continue
        try:
            score = score_image(decode_color(recorded), decode_color(rendered))
        except GstError as error:
            reasons.append(f"{where}: {error}")
            continue
        scores.append(
            ViewScore(
                camera_id=camera_id,
                stamp_ns=stamp_ns,
                score=score,
                jpeg=rendered.startswith(b"\xff\xd8"),
            )
        )
    if not images.rendered:
        reasons.append("no topic .../cam/<id>/rendered/image in it")
    return scores, reasons


def _collect(episode: Episode, images: _Images, wanted: set[int] | None = None) -> None:
    topics: dict[str, tuple[dict[tuple[str, int], bytes], str]] = {}
    for topic in episode.topics_of_type(schema.COMPRESSED_IMAGE):
        for pattern, target in ((_RENDERED, images.rendered), (_RECORDED, images.recorded)):
            match = pattern.search(topic)
            if match and not (wanted is not None and target is images.rendered):
                topics[topic] = (target, match.group(1))
                break
    for message in episode.messages(topics):
        image = CompressedColor.from_cdr(message.data)
        if wanted is None or image.stamp_ns in wanted:
            target, camera_id = topics[message.topic]
            target[(camera_id, image.stamp_ns)] = image.data


def _measure(part: str, episodes: Sequence[str], scores: Sequence[ViewScore]) -> list[Measurement]:
    psnr = [s.score.psnr_db for s in scores if s.score.psnr_db is not None]
    ssim = [s.score.ssim for s in scores if s.score.ssim is not None]
    stored = "rendered images stored as JPEG" if any(s.jpeg for s in scores) else "stored lossless"
    stamp = f"full frame, no mask, no colour alignment, {stored}; mean of per-image values"
    return [
        *(
            measured(
                f"views.{part}.{name}",
                partial(_mean, statistic, values),
                unit=unit,
                definition=f"{protocol}; {stamp}",
                n=len(values),
                counted="image",
                reason_without_interval="the per-image list is in the table",
                episodes=episodes,
            )
            for name, statistic, unit, protocol, values in (
                ("psnr_db", "PSNR", "dB", PSNR_PROTOCOL, psnr),
                ("ssim", "SSIM", "1", SSIM_PROTOCOL, ssim),
            )
        ),
        Measurement(
            id=f"views.{part}.lpips",
            value=None,
            unit="1",
            definition="learned perceptual image patch similarity",
            reason_if_undefined=LPIPS_NOT_COMPUTED,
            episodes=tuple(episodes),
        ),
    ]


def _mean(statistic: str, values: Iterable[float]) -> float:
    found = list(values)
    if not found:
        raise UndefinedStatisticError(statistic=statistic, reason="no pair of images has it")
    return float(np.mean(found))


def _table(table_id: str, name: str, scores: Sequence[ViewScore]) -> Table:
    return Table(
        id=table_id,
        title=f"Held-out views: {name}",
        columns=("camera", "stamp_ns", "PSNR (dB)", "SSIM", "pixels"),
        rows=tuple(
            (
                s.camera_id,
                s.stamp_ns,
                None if s.score.psnr_db is None else round(s.score.psnr_db, 3),
                None if s.score.ssim is None else round(s.score.ssim, 4),
                s.score.num_pixels,
            )
            for s in scores
        ),
        note=f"{PSNR_PROTOCOL}. {SSIM_PROTOCOL}. LPIPS {LPIPS_NOT_COMPUTED}.",
    )
