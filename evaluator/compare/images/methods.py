"""``evaluate --renders``: several methods on the same views, beside the twin's own or without it.

A mean over other images is another number. So the table is made over the views that every method
has, and each view that is left out is named with its reason.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from bridge.episode.provenance import software
from bridge.errors import GstError, UsageError
from bridge.exchange.csv_export import seconds_text
from bridge.media.color import decode_color
from evaluator.compare.images.folders import ImageSet, folder_set
from evaluator.compare.images.scores import (
    RECORDED,
    RENDERED,
    images_of,
    measure_images,
    open_net,
    size_words,
    spread,
)
from evaluator.compare.images.views import TWIN, Source, agreed_setting, newest_views, opened
from evaluator.compare.measure import Part
from evaluator.compare.rows import Comparison
from evaluator.errors import EvaluatorError
from evaluator.measurements import RENDERS, slug
from evaluator.metrics.image import ImageScore, PerceptualNet, score_pair
from evaluator.metrics.image_options import UNSTATED, ImageOptions
from evaluator.result import Cell, Exclusion, Measurement, Table
from evaluator.run_reader.episodes import DerivedFile

SCOPE = "images"
"""What exclusions are from."""
HEADLINE = {"psnr_db": "PSNR (dB)", "ssim_zero": "SSIM", "lpips_vgg_01": "LPIPS (vgg)"}
"""Metrics of the table, by the conventions of 3D Gaussian splatting papers."""
_NOTE = (
    "Means over the views that every method has. SSIM with zeros beyond the border and LPIPS of "
    "images in 0..1, as papers on 3D Gaussian splatting compute them; results.json has the other "
    "conventions, which give other numbers. LPIPS is not computed without a backbone."
)


def compare_folders(options: ImageOptions) -> Comparison:
    """Compare folders of renders with a folder of recorded images, without any run."""
    if options.reference is None or not options.renders:
        message = "images alone need --reference FOLDER and --renders METHOD=FOLDER."
        raise UsageError(message)
    net = open_net(options.lpips_vgg)
    part = compare_renders(options, (), {}, net=net)
    return Comparison(
        run=options.reference.resolve().name,
        source="images",
        stand_in=None,
        **vars(part),
        provenance={
            "software": software(),
            **options.origin(),
            "weights": None if net is None else net.weights,
        },
    )


def compare_renders(
    options: ImageOptions,
    files: Sequence[DerivedFile],
    sources: Mapping[str, Source],
    *,
    net: PerceptualNet | None = None,
) -> Part:
    """Compare folders of renders with the twin's own on the held-out views of a run.

    A view is called ``camera/stamp_ns``; ``camera_stamp_ns`` and the names of ``export tum`` are
    understood too. With a reference of their own, the folders are compared with that instead.

    Raises:
        EvaluatorError: When the run has no views, or nothing can be compared.
    """
    if not options.renders:
        options.refuse_unused()
        return Part()
    if options.reference is not None:
        reference = folder_set(options.reference.resolve().name, options.reference)
        return _compare(reference, _methods(options), options.split, net)
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
    others = [
        replace(method, load={names.get(view, view): call for view, call in method.load.items()})
        for method in _methods(options, taken=(TWIN,))
    ]
    return _compare(recorded, [twin, *others], split, net)


def _methods(options: ImageOptions, *, taken: Sequence[str] = ()) -> list[ImageSet]:
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


@dataclass(frozen=True, kw_only=True)
class _View:
    """All methods on one view."""

    size: tuple[int, int] = (0, 0)
    scores: Mapping[str, Mapping[str, ImageScore]] = field(default_factory=dict)
    """By method, by variant."""
    reasons: Mapping[str, str] = field(default_factory=dict)
    """Why a method has no score, by method; by "" where the recorded image is unusable."""


def _compare(
    reference: ImageSet, methods: Sequence[ImageSet], split: str, net: PerceptualNet | None
) -> Part:
    """Score every method on every view of the reference, and measure over those in common."""
    wanted = [view for view in sorted(reference.load) if any(view in m.load for m in methods)]
    work = partial(_score_view, reference, methods, net)
    views = dict(zip(wanted, spread(work, wanted, threads=1 if net else None), strict=True))
    left_out = [gone for method in methods for gone in _unpaired(reference, method)]
    left_out += [
        _gone(f"{method}: {view}" if method else view, reason)
        for view, seen in views.items()
        for method, reason in seen.reasons.items()
    ]
    scored = [m for m in methods if any(m.name in seen.scores for seen in views.values())]
    for method in methods:
        if method not in scored:
            why = [e.reason for e in left_out if e.episode.startswith(f"{method.name}: ")]
            words = f"the whole method: none of its images can be scored ({[*why, '-'][0]})"
            left_out.append(_gone(method.name, words))
    common = [v for v, seen in views.items() if all(m.name in seen.scores for m in scored)]
    if not scored or not common:
        raise EvaluatorError(_nothing(reference, methods, scored, left_out))
    for view, seen in views.items():
        lacking = [method.name for method in scored if method.name not in seen.scores]
        if lacking and seen.scores:
            reason = f"left out for every method: no score of {', '.join(lacking)}"
            left_out.append(_gone(view, reason))
    sizes = size_words(views[view].size for view in common)
    numbers: list[Measurement] = []
    rows: list[dict[str, Cell]] = []
    for method in scored:
        scores = [views[view].scores[method.name] for view in common]
        protocol = f"{sizes}; split {split}; {method.stored}"
        found = measure_images(RENDERS, scores, protocol, net=net, method=method.name)
        numbers += found
        rows.append(_row(method.name, found, len(common), protocol, net))
    origin = ", ".join(f"{method.name} from {method.where}" for method in scored)
    note = f"{_NOTE} Images: {origin}; recorded: {reference.where}."
    title = "Rendering quality on the same views"
    missing = []
    if net is None:
        missing.append("LPIPS of renders: no backbone (--lpips-vgg FILE)")
    if split == UNSTATED:
        missing.append("split of renders: nobody said which images were held out (--split TEXT)")
    return Part(
        measurements=tuple(numbers),
        tables=(Table.of(rows, id="image_methods", title=title, note=note),),
        exclusions=tuple(left_out),
        missing=tuple(missing),
    )


def _row(
    method: str,
    found: Sequence[Measurement],
    num_views: int,
    protocol: str,
    net: PerceptualNet | None,
) -> dict[str, Cell]:
    """Lay one method out, by the metrics of papers, with the protocol of the row."""
    values = {each.id.rpartition(".")[2]: each.value for each in found}
    known = {name: round(value, 4) for name, value in values.items() if value is not None}
    undefined = {name: None if name in values else "not computed" for name in HEADLINE}
    weights = "" if net is None else f"; weights {net.weights}"
    stated = protocol.replace(f"split {UNSTATED}", f"{UNSTATED}: split")
    return {
        "method": method,
        **{head: known.get(name, undefined[name]) for name, head in HEADLINE.items()},
        "views": num_views,
        "protocol": f"{stated}; full frame; no colour alignment{weights}",
    }


def _gone(name: str, reason: str) -> Exclusion:
    return Exclusion(episode=name, scope=SCOPE, reason=reason)


def _unpaired(reference: ImageSet, method: ImageSet) -> list[Exclusion]:
    """Name images without a counterpart, on either side."""
    theirs, ours = set(method.load), set(reference.load)
    missing = [(view, f"no image of this name in {method.where}") for view in sorted(ours - theirs)]
    extra = [
        (view, f"the reference has no such image ({reference.where})")
        for view in sorted(theirs - ours)
    ]
    return [_gone(f"{method.name}: {view}", reason) for view, reason in (*missing, *extra)]


def _score_view(
    reference: ImageSet, methods: Sequence[ImageSet], net: PerceptualNet | None, view: str
) -> _View:
    scores: dict[str, Mapping[str, ImageScore]] = {}
    reasons: dict[str, str] = {}
    try:
        recorded = reference.load[view]()
    except GstError as error:
        return _View(reasons={"": f"recorded image: {error}"})
    for method in methods:
        if view in method.load:
            try:
                scores[method.name] = score_pair(recorded, method.load[view](), net=net)
            except GstError as error:
                reasons[method.name] = str(error)
    size = (recorded.shape[0], recorded.shape[1])
    return _View(size=size, scores=scores, reasons=reasons)


def _nothing(
    reference: ImageSet,
    methods: Sequence[ImageSet],
    scored: Sequence[ImageSet],
    left_out: Sequence[Exclusion],
) -> str:
    """Say why there is nothing to compare."""
    if scored:
        names = ", ".join(method.name for method in scored)
        return f"no view can be scored for all of {names}. Compare fewer methods at once."
    ours = next(iter(sorted(reference.load)), "none")
    theirs = [f"{m.name} has {next(iter(sorted(m.load)), 'none')}" for m in methods]
    why = left_out[0].reason if left_out else "no image"
    return (
        f"no rendered image can be compared with {reference.where} ({why}). The reference "
        f"has {ours}; {'; '.join(theirs)}. Name renders as the recorded images are named."
    )
