"""``evaluate --renders``: whose folders are compared with what."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from bridge.episode.provenance import software
from bridge.errors import GstError, UsageError
from bridge.exchange.csv_export import seconds_text
from bridge.media.color import decode_color
from evaluator.compare.images.methods import (
    ImageSet,
    Reference,
    compare_methods,
    folder_set,
)
from evaluator.compare.images.scores import RAW, RECORDED, RENDERED, images_of, open_nets
from evaluator.compare.images.tables import StampedMeasurement, rounded
from evaluator.compare.images.views import (
    TWIN,
    Source,
    ViewReport,
    agreed_setting,
    newest_views,
    opened,
)
from evaluator.compare.rows import Comparison
from evaluator.errors import EvaluatorError
from evaluator.measurements import slug
from evaluator.metrics.image_protocol import UNSTATED, ImageOptions, common_text
from evaluator.metrics.lpips import LPIPS_NOT_COMPUTED, PerceptualNet
from evaluator.result import Cell, Table
from evaluator.run_reader.episodes import DerivedFile

HEADLINE = {"psnr_db": "PSNR (dB)", "ssim_zero": "SSIM", "lpips_vgg_01": "LPIPS (vgg)"}
"""Metrics of the table, by the conventions of 3D Gaussian splatting papers."""
_NOTE = (
    "Means over the views that every method has. SSIM with zeros beyond the border and LPIPS of "
    "images in 0..1, as papers on 3D Gaussian splatting compute them; results.json has the other "
    "conventions, which give other numbers. LPIPS is not computed without a backbone."
)


def _headline(numbers: Mapping[str, Sequence[StampedMeasurement]], origin: str) -> Table:
    """Lay the methods out, by the metrics of papers, with the protocol of each row."""
    rows: list[dict[str, Cell]] = []
    for method, found in numbers.items():
        raw = {number.metric.id: number for number in found if number.variant == RAW}
        shown = [raw[metric] for metric in HEADLINE if metric in raw]
        stamps = [each.stamp for each in shown if each.measurement.value is not None]
        stamps = stamps or [shown[0].stamp]
        rows.append(
            {
                "method": method,
                **{head: _cell(raw.get(metric)) for metric, head in HEADLINE.items()},
                "views": max(stamp.n for stamp in stamps) or None,
                "protocol": common_text(stamps),
            }
        )
    title = "Rendering quality on the same views"
    return Table.of(rows, id="image_methods", title=title, note=f"{_NOTE} Images: {origin}.")


def _cell(found: StampedMeasurement | None) -> Cell:
    if found is None or found.measurement.reason_if_undefined == LPIPS_NOT_COMPUTED:
        return "not computed"
    return rounded(found.measurement.value)


def compare_folders(options: ImageOptions) -> Comparison:
    """Compare folders of renders with a folder of recorded images, without any run."""
    if options.reference is None or not options.renders:
        message = "images alone need --reference FOLDER and --renders METHOD=FOLDER."
        raise UsageError(message)
    nets = open_nets(options.backbones)
    report = _beside_folder(options, options.reference, nets)
    return Comparison(
        run=options.reference.resolve().name,
        source="images",
        stand_in=None,
        measurements=report.measurements,
        tables=report.tables,
        exclusions=report.exclusions,
        missing=report.missing,
        provenance={
            "software": software(),
            **options.origin(),
            "weights": [net.weights for net in nets],
        },
    )


def compare_renders(
    options: ImageOptions,
    files: Sequence[DerivedFile],
    sources: Mapping[str, Source],
    *,
    nets: Sequence[PerceptualNet] = (),
) -> ViewReport:
    """Compare folders of renders with the twin's own on the held-out views of a run.

    A view is called ``camera/stamp_ns``; ``camera_stamp_ns`` and the names of ``export tum`` are
    understood too. With a reference of their own, the folders are compared with that instead.

    Raises:
        EvaluatorError: When the run has no views, or nothing can be compared.
    """
    if not options.renders:
        options.refuse_unused()
        return ViewReport()
    if options.reference is not None:
        return _beside_folder(options, options.reference, nets)
    found, _ = newest_views(files, sources)  # what is left out, compare_views says
    recorded, twin = _sets_of(found, sources)
    if not twin.load:
        message = (
            "the run has no rendered views to compare others with. Make them with robot-gst "
            "rebuild, or name a folder of recorded images with --reference."
        )
        raise EvaluatorError(message)
    split = agreed_setting([file.derived.settings for file in found], "holdout") or options.split
    names = other_names(recorded.load)
    reference = Reference(images=recorded, split=split)
    others = [_renamed(method, names) for method in _methods(options, taken=(TWIN,))]
    return _report(reference, [twin, *others], nets)


def _beside_folder(
    options: ImageOptions, folder: Path, nets: Sequence[PerceptualNet]
) -> ViewReport:
    images = folder_set(folder.resolve().name, folder)
    reference = Reference(images=images, split=options.split)
    return _report(reference, _methods(options, taken=()), nets)


def _report(
    reference: Reference, methods: Sequence[ImageSet], nets: Sequence[PerceptualNet]
) -> ViewReport:
    report = compare_methods(reference, methods, nets=nets)
    origin = ", ".join(f"{method.name} from {method.where}" for method in methods)
    missing = []
    if not nets:
        missing.append("LPIPS of renders: no backbone (--lpips-vgg FILE, --lpips-alex FILE)")
    if reference.split == UNSTATED:
        missing.append("split of renders: nobody said which images were held out (--split TEXT)")
    return ViewReport(
        measurements=tuple(n.measurement for found in report.numbers.values() for n in found),
        tables=(_headline(report.numbers, f"{origin}; recorded: {reference.images.where}"),),
        exclusions=report.exclusions,
        missing=tuple(missing),
    )


def _methods(options: ImageOptions, *, taken: Sequence[str]) -> list[ImageSet]:
    seen = {slug(name): name for name in taken}
    found = []
    for name, folder in options.methods().items():
        if slug(name) in seen:
            message = (
                f"--renders calls a method {name}, which ids cannot tell from {seen[slug(name)]}; "
                "give it another name."
            )
            raise UsageError(message)
        seen[slug(name)] = name
        found.append(folder_set(name, folder))
    return found


def other_names(views: Iterable[str]) -> dict[str, str]:
    """Return what else a view of the run may be called, where only one view is called so."""
    found: dict[str, list[str]] = {}
    for view in views:
        camera, stamp = view.rsplit("/", 1)
        seconds = seconds_text(int(stamp))
        for name in (stamp, seconds, f"rgb/{seconds}"):
            found.setdefault(name, []).append(view)
        for name in (f"{camera}_{stamp}", f"{camera}/{seconds}", f"{camera}/rgb/{seconds}"):
            found.setdefault(name, []).append(view)
    return {name: of[0] for name, of in found.items() if len(of) == 1}


def _renamed(method: ImageSet, names: Mapping[str, str]) -> ImageSet:
    """Call the images of a method as the run calls its views."""
    return replace(method, load={names.get(view, view): call for view, call in method.load.items()})


def _sets_of(
    files: Sequence[DerivedFile], sources: Mapping[str, Source]
) -> tuple[ImageSet, ImageSet]:
    """Return recorded images, and the twin's renders, of the views of a run."""
    recorded, rendered = {}, {}
    for file in files:
        try:
            images = images_of(file.episode, opened(sources.get(file.derived.source_episode)))
        except GstError:  # the twin's own views name it
            continue
        for key in images.color[RENDERED].keys() & images.color[RECORDED].keys():
            view = f"{key[0]}/{key[1]}"
            recorded[view] = partial(decode_color, images.color[RECORDED][key])
            rendered[view] = partial(decode_color, images.color[RENDERED][key])
    where = "the run's views"
    return (
        ImageSet(name="recorded", where=where, load=recorded, stored="recorded"),
        ImageSet(name=TWIN, where=where, load=rendered, stored="stored in the run's views"),
    )
