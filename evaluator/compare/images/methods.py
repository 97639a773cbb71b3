"""``evaluate --renders``: several methods on the same views, beside the twin's own or without it.

A mean over other images is another number. So the table is made over the views that every method
has, and each view that is left out is named with its reason.

Folders are read strictly: what cannot be compared is refused with what to do about it. A view is
named by its path inside the folder without the ending: ``wrist/0001``. What a decoder would quietly
change (16 bits to 8, transparency, grey to colour) is looked for in the file itself.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from bridge.episode.provenance import software
from bridge.errors import BridgeError, GstError, PathNotFoundError, UsageError
from bridge.exchange.csv_export import seconds_text
from bridge.media.color import JPEG_MAGIC, decode_color, open_image
from evaluator.compare.images import scores as image_scores
from evaluator.compare.images.scores import RECORDED, RENDERED, images_of, measure_images
from evaluator.compare.images.views import TWIN, agreed_setting, newest_views, opened
from evaluator.compare.measure import Part
from evaluator.compare.rows import Comparison
from evaluator.errors import EvaluatorError
from evaluator.measurements import RENDERS, slug
from evaluator.metrics.image import ImageScore, PerceptualNet, score_pair
from evaluator.metrics.image_options import UNSTATED, ImageOptions
from evaluator.result import Cell, Exclusion, Measurement, Table
from evaluator.run_reader.episodes import DerivedFile, RunFile

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
READ = (".png", ".jpg", ".jpeg")
WANTED = "Wanted: 8-bit RGB as PNG or JPEG"
_REFUSED = {
    "L": "is grey, without colours",
    "LA": "is grey, without colours",
    "CMYK": "holds printing colours (CMYK)",
}
"""Modes of Pillow that are not looked at further."""


class ImageRefusedError(EvaluatorError):
    """An image cannot be compared as it is stored."""

    def __init__(self, *, name: str, found: str) -> None:
        """Remember what was found."""
        self.found = found
        super().__init__(f"{name} {found}. {WANTED}.")


@dataclass(frozen=True, kw_only=True)
class ImageSet:
    """Images by the names of their views, not loaded yet."""

    name: str
    """Of the method, or of the reference."""
    where: str
    """Folder or episode, for messages."""
    load: Mapping[str, Callable[[], np.ndarray]]
    """Gives (height, width, 3) of uint8, or raises a ``GstError``."""
    stored: str
    """For the protocol."""


def folder_set(name: str, folder: Path) -> ImageSet:
    """List the images of a folder and its subfolders; none, or two of one name, are refused."""
    if not folder.is_dir():
        raise PathNotFoundError(path=folder, what="folder of images", hint="Name a folder.")
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in relative.parts)
        if not hidden and path.suffix.lower() in READ and path.is_file():
            view = relative.with_suffix("").as_posix()
            if view in found:
                message = f"{folder} has {found[view].name} and {path.name}; keep one of them."
                raise EvaluatorError(message)
            found[view] = path
    if not found:
        message = f"{folder} holds no image. {WANTED}."
        raise EvaluatorError(message)
    endings = sorted({path.suffix.lower().lstrip(".") for path in found.values()})
    return ImageSet(
        name=name,
        where=str(folder),
        load={view: partial(read_image, path) for view, path in found.items()},
        stored=f"stored as {', '.join(endings)}",
    )


def read_image(path: Path) -> np.ndarray:
    """Read one image of shape (height, width, 3) and 8 bits, or refuse what cannot be compared."""
    refused = partial(ImageRefusedError, name=path.name)
    try:
        data = path.read_bytes()
        if not data.startswith((PNG_MAGIC, JPEG_MAGIC)):
            raise refused(found="is neither PNG nor JPEG inside")
        # Pillow reads 16-bit colour as 8 bits without a word; the header says which it is.
        if data.startswith(PNG_MAGIC) and data[24:25] == b"\x10":
            raise refused(found="has 16 bits for each channel")
        with open_image(data) as image:
            if image.mode in _REFUSED:
                raise refused(found=_REFUSED[image.mode])
            if image.mode not in ("RGBA", "PA") and "transparency" not in image.info:
                return np.asarray(image.convert("RGB"))
            pixels = np.asarray(image.convert("RGBA"))
    except BridgeError as error:
        raise refused(found=f"cannot be read ({error})") from error
    except OSError as error:
        raise refused(found=f"cannot be read ({error.strerror or error})") from error
    if (pixels[..., 3] < 255).any():
        raise refused(found="has transparency; draw it over the background that the reference has")
    return np.ascontiguousarray(pixels[..., :3])


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
        raise UsageError("images alone need --reference FOLDER and --renders METHOD=FOLDER.")
    net = image_scores.open_net(options.lpips_vgg)
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
    sources: Mapping[str, RunFile],
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
    """List the folders of each method; two that ids cannot tell apart are refused."""
    methods = options.methods()
    for name in methods:
        other = next((o for o in (*taken, *methods) if o != name and slug(o) == slug(name)), "")
        if other or name in taken:
            message = f"--renders calls a method {name}, which ids cannot tell from {other or name}"
            raise UsageError(f"{message}; give it another name.")
    return [folder_set(name, folder) for name, folder in methods.items()]


def other_names(views: Iterable[str]) -> dict[str, str]:
    """Return what else a view of the run may be called, where only one view is called so."""
    found: dict[str, list[str]] = {}
    for view in views:
        camera, stamp = view.rsplit("/", 1)
        seconds = seconds_text(int(stamp))
        named = (f"{camera}_{stamp}", f"{camera}/{seconds}", f"{camera}/rgb/{seconds}")
        for name in (stamp, seconds, f"rgb/{seconds}", *named):
            found.setdefault(name, []).append(view)
    return {name: of[0] for name, of in found.items() if len(of) == 1}


def _sets_of(
    files: Sequence[DerivedFile], sources: Mapping[str, RunFile]
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
    views = dict(
        zip(wanted, image_scores.spread(work, wanted, threads=1 if net else None), strict=True)
    )
    left_out = [gone for method in methods for gone in _unpaired(reference, method)]
    left_out += [
        _gone(f"{method}: {view}" if method else view, reason)
        for view, seen in views.items()
        for method, reason in seen.reasons.items()
    ]
    common = [v for v, seen in views.items() if all(m.name in seen.scores for m in methods)]
    if not common:
        raise EvaluatorError(_nothing(reference, methods, left_out))
    for view, seen in views.items():
        lacking = [method.name for method in methods if method.name not in seen.scores]
        if lacking and seen.scores:
            reason = f"left out for every method: no score of {', '.join(lacking)}"
            left_out.append(_gone(view, reason))
    sizes = image_scores.size_words(views[view].size for view in common)
    numbers: list[Measurement] = []
    rows: list[dict[str, Cell]] = []
    for method in methods:
        scores = [views[view].scores[method.name] for view in common]
        protocol = f"{sizes}; split {split}; {method.stored}"
        found = measure_images(RENDERS, scores, protocol, net=net, method=method.name)
        numbers += found
        rows.append(_row(method.name, found, len(common), protocol, net))
    origin = ", ".join(f"{method.name} from {method.where}" for method in methods)
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
    no_image = f"no image of this name in {method.where}"
    not_asked = f"the reference has no such image ({reference.where})"
    return [
        _gone(f"{method.name}: {view}", reason)
        for views, reason in ((ours - theirs, no_image), (theirs - ours, not_asked))
        for view in sorted(views)
    ]


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
    reference: ImageSet, methods: Sequence[ImageSet], left_out: Sequence[Exclusion]
) -> str:
    """Say why there is no view that all methods have."""
    ours = next(iter(sorted(reference.load)), "none")
    theirs = [f"{m.name} has {next(iter(sorted(m.load)), 'none')}" for m in methods]
    why = f"{left_out[-1].episode}: {left_out[-1].reason}" if left_out else "no image"
    return (
        f"no view can be scored for all of {', '.join(m.name for m in methods)} ({why}). The "
        f"reference {reference.where} has {ours}; {'; '.join(theirs)}. Name renders as the "
        "recorded images are named, and leave out a method that cannot be scored."
    )
