"""Score rendered views against the held-out recorded images they stand for.

``view_images`` pairs and scores the images of one episode; here the newest views of each recorded
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
from evaluator.compare.measure import measured, slug
from evaluator.compare.replays import DerivedFile
from evaluator.compare.view_images import VARIANTS, ViewScore, score_views
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.depth import DEPTH_PROTOCOL
from evaluator.metrics.image import LPIPS_NOT_COMPUTED, PSNR_PROTOCOL, SSIM_PROTOCOL
from evaluator.result import Cell, Exclusion, Measurement, Table

MASKED = "only the pixels of the views' own mask {name!r}, no colour alignment"


@dataclass(frozen=True, kw_only=True)
class ViewReport:
    """What all ``views`` episodes of a run say."""

    measurements: tuple[Measurement, ...] = ()
    tables: tuple[Table, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    missing: tuple[str, ...] = ()


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
    of: dict[str, DerivedFile] = {}
    for file in views:
        name = file.path.stem
        source = file.derived.source_episode
        try:
            scores, reasons = score_views(file.episode, sources.get(source))
        except GstError as error:
            left_out.append(Exclusion(episode=file.path.name, scope="views", reason=str(error)))
            continue
        left_out += [Exclusion(episode=name, scope="views", reason=reason) for reason in reasons]
        found[source], of[source] = scores, file
        tables.append(_table(f"views_{len(tables)}", name, scores))
    everything = [score for scores in found.values() for score in scores]
    measurements = _measure("all", list(found), everything, _protocol(of.values()))
    for source, scores in found.items() if len(found) > 1 else ():
        measurements += _measure(slug(source), [source], scores, _protocol([of[source]]))
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


def _measure(
    part: str, episodes: Sequence[str], scores: Sequence[ViewScore], protocol: str
) -> list[Measurement]:
    """All numbers about some views; the raw ones first."""
    stored = "rendered images stored as JPEG" if any(s.jpeg for s in scores) else "stored lossless"
    after = f"{stored}; mean of per-image values{protocol}"
    found = list(dict.fromkeys(name for score in scores for name in score.scores))
    variants = ["raw", *(name for name in found if name != "raw")]
    measurements = []
    for variant in variants:
        stamp = f"{VARIANTS.get(variant) or MASKED.format(name=variant)}, {after}"
        measurements += _measure_images(part, variant, episodes, scores, stamp)
    measurements += _measure_depth(part, episodes, scores, after)
    measurements.append(
        Measurement(
            id=f"views.{part}.lpips",
            value=None,
            unit="1",
            definition="learned perceptual image patch similarity",
            reason_if_undefined=LPIPS_NOT_COMPUTED,
            episodes=tuple(episodes),
        )
    )
    return measurements


def _measure_images(
    part: str, variant: str, episodes: Sequence[str], scores: Sequence[ViewScore], stamp: str
) -> list[Measurement]:
    mine = [score.scores[variant] for score in scores if variant in score.scores]
    psnr = [s.psnr_db for s in mine if s.psnr_db is not None]
    ssim = [s.ssim for s in mine if s.ssim is not None]
    name = "" if variant == "raw" else f"_{variant}"
    return [
        measured(
            f"views.{part}.{measurement}",
            partial(_mean, statistic, values),
            unit=unit,
            definition=f"{protocol}; {stamp}",
            n=len(values),
            counted="image",
            reason_without_interval="the per-image list is in the table",
            episodes=episodes,
        )
        for measurement, statistic, unit, protocol, values in (
            (f"psnr{name}_db", "PSNR", "dB", PSNR_PROTOCOL, psnr),
            (f"ssim{name}", "SSIM", "1", SSIM_PROTOCOL, ssim),
        )
    ]


def _measure_depth(
    part: str, episodes: Sequence[str], scores: Sequence[ViewScore], after: str
) -> list[Measurement]:
    depths = [score.depth for score in scores if score.depth is not None]
    if not depths:
        return []
    return [
        measured(
            f"views.{part}.{name}",
            partial(_mean, statistic, values),
            unit="m",
            definition=f"{statistic}, {DEPTH_PROTOCOL}; {after}",
            n=len(values),
            counted="image",
            reason_without_interval="the per-image list is in the table",
            episodes=episodes,
        )
        for name, statistic, values in (
            ("depth_mean_abs_m", "mean absolute depth error", [d.mean_abs_m for d in depths]),
            ("depth_rmse_m", "root mean square depth error", [d.rmse_m for d in depths]),
        )
    ]


def _protocol(files: Iterable[DerivedFile]) -> str:
    """What the views say about how their scenes were made, where they agree."""
    said: list[Mapping[str, Any]] = [file.derived.settings for file in files]
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
        values = [settings.get(name) for settings in said]
        if values and values[0] is not None and all(value == values[0] for value in values):
            value = values[0]
            parts.append(text.format(", ".join(value) if isinstance(value, list) else value))
    return f"; {'; '.join(parts)}" if parts else ""


def _mean(statistic: str, values: Iterable[float]) -> float:
    found = list(values)
    if not found:
        raise UndefinedStatisticError(statistic=statistic, reason="no pair of images has it")
    return float(np.mean(found))


def _table(table_id: str, name: str, scores: Sequence[ViewScore]) -> Table:
    return Table(
        id=table_id,
        title=f"Held-out views: {name}",
        columns=(
            *("camera", "stamp_ns", "PSNR (dB)", "SSIM", "pixels"),
            *("PSNR gain (dB)", "PSNR affine (dB)", "PSNR pose and gain (dB)", "depth (mm)"),
        ),
        rows=tuple(
            (
                s.camera_id,
                s.stamp_ns,
                _rounded(s.scores["raw"].psnr_db, 3),
                _rounded(s.scores["raw"].ssim, 4),
                s.scores["raw"].num_pixels,
                *(
                    _rounded(s.scores[variant].psnr_db, 3) if variant in s.scores else None
                    for variant in ("gain", "affine", "pose_gain")
                ),
                None if s.depth is None else round(1e3 * s.depth.mean_abs_m, 2),
            )
            for s in scores
        ),
        note=f"{PSNR_PROTOCOL}. {SSIM_PROTOCOL}. LPIPS {LPIPS_NOT_COMPUTED}.",
    )


def _rounded(value: float | None, digits: int) -> Cell:
    return None if value is None else round(value, digits)
