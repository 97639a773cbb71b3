"""Score rendered views against the held-out recorded images they stand for.

``scores`` pairs and scores the images of one episode; here the newest views of each recorded
episode are found, and their scores become measurements, each with its protocol.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from bridge.episode.reader import Episode
from bridge.errors import GstError
from evaluator.cache import SummaryCache
from evaluator.compare.images.scores import (
    ViewScore,
    images_of,
    measure_images,
    score_views,
    size_words,
)
from evaluator.compare.measure import Part, mean_of, measured, millimetres
from evaluator.measurements import DEPTHS, LPIPS_MISSING, VIEWS
from evaluator.metrics.image import GAIN, LPIPS_NOT_COMPUTED, METRICS, PerceptualNet
from evaluator.metrics.image_options import UNSTATED
from evaluator.result import Cell, Exclusion, Measurement, Table
from evaluator.run_reader.episodes import DerivedFile, RunFile

TWIN = "twin"
"""What the run's own renders are called beside other methods."""
VIEWS_TITLE = "Held-out views: "
"""Before the file's name in the title of the table that rates its images."""


def compare_views(
    files: Sequence[DerivedFile],
    sources: Mapping[str, RunFile],
    *,
    net: PerceptualNet | None = None,
    cache: SummaryCache | None = None,
) -> Part:
    """Compute every image metric of every rendered view, per image and mean."""
    cache = SummaryCache(None) if cache is None else cache
    views, left_out = newest_views(files, sources)
    if not views:
        return Part(
            missing=("views: no rendered views (robot-gst rebuild makes them)",),
            exclusions=tuple(left_out),
        )
    tables: list[Table] = []
    found: dict[str, tuple[ViewScore, ...]] = {}
    for file in views:
        name, source = file.path.stem, file.derived.source_episode
        recorded = sources.get(source)
        sha256 = "-" if recorded is None else recorded.sha256
        key = " ".join([file.sha256, sha256, *([net.weights] if net else ())])
        try:
            scores = cache.kept_or_made(ViewScore, key, partial(_scored, file, recorded, net))
        except GstError as error:
            left_out.append(Exclusion(episode=file.path.name, scope="views", reason=str(error)))
            continue
        left_out += [
            Exclusion(episode=name, scope="views", reason=each.reason)
            for each in scores
            if each.reason
        ]
        found[source] = tuple(each for each in scores if not each.reason)
        tables.append(_table(f"views_{len(tables)}", VIEWS_TITLE + name, found[source]))
    kept = [file for file in views if file.derived.source_episode in found]
    return Part(
        measurements=tuple(_measure(found, [file.derived.settings for file in kept], net)),
        tables=tuple(tables),
        exclusions=tuple(left_out),
    )


def _scored(
    file: DerivedFile, source: RunFile | None, net: PerceptualNet | None
) -> tuple[ViewScore, ...]:
    return score_views(images_of(file.episode, opened(source)), net=net)


def newest_views(
    files: Sequence[DerivedFile], sources: Mapping[str, RunFile]
) -> tuple[list[DerivedFile], list[Exclusion]]:
    """Find the newest views of each recorded episode; stale and older ones are left out by name."""
    newest: dict[str, DerivedFile] = {}
    why: dict[str, str] = {}
    views = [file for file in files if file.derived.kind == "views"]
    for file in sorted(views, key=lambda file: file.age):
        source = sources.get(file.derived.source_episode)
        if source is not None and file.derived.source_sha256 not in ("", source.sha256):
            why[file.name] = "made from another version of the episode (its hash differs); rebuild"
            continue
        older = newest.get(file.derived.source_episode)
        if older is not None:
            why[older.name] = "views of an older scene; there are newer ones of the same episode"
        newest[file.derived.source_episode] = file
    left_out = [
        Exclusion(episode=file.path.name, scope="views", reason=why[file.name])
        for file in views
        if file.name in why
    ]
    return [file for file in views if file.name not in why], left_out


def opened(source: RunFile | None) -> Episode | None:
    """Open a recorded episode, where there is one."""
    return None if source is None else Episode.open(source.path)


def _table(table_id: str, title: str, scores: Sequence[ViewScore]) -> Table:
    """List every view with its raw scores, and PSNR after a gain."""
    shown = [metric for metric in METRICS if any(s.value(metric) is not None for s in scores)]
    others = [metric for metric in shown if metric not in ("psnr_db", "ssim")]
    rows: list[tuple[Cell, ...]] = [
        (
            *(s.camera_id, s.stamp_ns, _rounded(s.value("psnr_db"), 3), _rounded(s.value("ssim"))),
            _rounded(s.value("psnr_db", GAIN), 3),
            millimetres(None if s.depth is None else s.depth.mean_abs_m),
            *(_rounded(s.value(metric)) for metric in others),
        )
        for s in scores
    ]
    return Table(
        id=table_id,
        title=title,
        columns=(
            *("camera", "stamp_ns", "PSNR (dB)", "SSIM", "PSNR gain (dB)", "depth (mm)"),
            *(METRICS[metric].column for metric in others),
        ),
        rows=tuple(rows),
        note=f"{'. '.join(METRICS[m].definition for m in ('psnr_db', 'ssim', *others))}.",
    )


def _rounded(value: float | None, digits: int = 4) -> Cell:
    return None if value is None else round(value, digits)


def _measure(
    found: Mapping[str, Sequence[ViewScore]],
    settings: Sequence[Mapping[str, Any]],
    net: PerceptualNet | None,
) -> list[Measurement]:
    """All numbers about the views, of all episodes together; the raw ones first."""
    views = [view for of_episode in found.values() for view in of_episode]
    stored = "rendered images stored as JPEG" if any(v.jpeg for v in views) else "stored lossless"
    split = agreed_setting(settings, "holdout") or UNSTATED
    measurements = measure_images(
        VIEWS,
        [view.scores for view in views],
        f"{size_words(v.size for v in views)}; split {split}; {stored}",
        net=net,
        episodes=list(found),
        part="all",
    )
    depths = [view.depth for view in views if view.depth is not None]
    for name, quantity in DEPTHS.items() if depths else ():
        values = [getattr(depth, name) for depth in depths]
        measurements.append(
            measured(
                quantity.of(part="all", after=stored),
                partial(mean_of, values, "depth error", "no view has depth"),
                n=len(depths),
                counted="image",
                reason_without_interval="the per-image list is in the table",
                episodes=list(found),
            )
        )
    if net is None:
        lacking = LPIPS_MISSING.of(part="all")
        measurements.append(
            Measurement(**vars(lacking), value=None, reason_if_undefined=LPIPS_NOT_COMPUTED)
        )
    return measurements


def agreed_setting(settings: Iterable[Mapping[str, Any]], name: str) -> str:
    """Return what all views say of one setting, or nothing."""
    values = [each.get(name) for each in settings]
    if not values or values[0] is None or any(value != values[0] for value in values):
        return ""
    return ", ".join(map(str, values[0])) if isinstance(values[0], list) else str(values[0])
