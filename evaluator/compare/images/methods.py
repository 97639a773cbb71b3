"""Compare several methods on the same views: what one of them lacks counts for none.

A mean over other images is another number. So the table is made over the views that every method
has, and each view that is left out is named with its reason.

Folders of images are read strictly: what cannot be compared is refused with what to do about it. A
view is named by its path inside the folder without the ending: ``wrist/0001``. What a decoder would
quietly change (16 bits to 8, transparency, grey to colour) is looked for in the file itself.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from bridge.errors import BridgeError, GstError, PathNotFoundError
from bridge.media.color import JPEG_MAGIC, decode_color, open_image
from bridge.media.image_quality import as_float
from evaluator.compare.images.scores import (
    Variant,
    score_variants,
    spread,
)
from evaluator.compare.images.tables import (
    Protocol,
    StampedMeasurement,
    resolution_words,
    stamped_measurements,
)
from evaluator.errors import EvaluatorError
from evaluator.measurements import RENDERS
from evaluator.metrics.image import refuse_swapped
from evaluator.metrics.image_scores import ImageScore
from evaluator.metrics.lpips import PerceptualNet
from evaluator.result import Exclusion

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
READ = (".png", ".jpg", ".jpeg")
WANTED = "Wanted: 8-bit RGB as PNG or JPEG"


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
    """For the stamp."""


def folder_set(name: str, folder: Path) -> ImageSet:
    """List the images of a folder and its subfolders.

    Raises:
        EvaluatorError: When it holds no image, or two of one name.
    """
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
    """Read one image of shape (height, width, 3) and 8 bits.

    Raises:
        ImageRefusedError: When it is not what can be compared; the message says what it is.
    """
    try:
        data = path.read_bytes()
        if data.startswith(PNG_MAGIC):
            return _read_png(path.name, data)
        if data.startswith(JPEG_MAGIC):
            return _read_jpeg(path.name, data)
    except BridgeError as error:
        raise ImageRefusedError(name=path.name, found=f"cannot be read ({error})") from error
    except OSError as error:
        found = f"cannot be read ({error.strerror or error})"
        raise ImageRefusedError(name=path.name, found=found) from error
    raise ImageRefusedError(name=path.name, found="is neither PNG nor JPEG inside")


def _read_png(name: str, data: bytes) -> np.ndarray:
    # Pillow reads 16-bit colour as 8 bits without a word; the header says which it is.
    depth, kind = data[24:25], data[25:26]
    if depth == b"\x10":
        raise ImageRefusedError(name=name, found="has 16 bits for each channel")
    if kind in (b"\x00", b"\x04"):
        raise ImageRefusedError(name=name, found="is grey, without colours")
    with open_image(data) as image:
        if image.mode not in ("RGBA", "PA", "LA") and "transparency" not in image.info:
            return np.asarray(image.convert("RGB"))
        pixels = np.asarray(image.convert("RGBA"))
    if (pixels[..., 3] < 255).any():
        found = "has transparency; draw it over the background that the reference has"
        raise ImageRefusedError(name=name, found=found)
    return np.ascontiguousarray(pixels[..., :3])


def _read_jpeg(name: str, data: bytes) -> np.ndarray:
    with open_image(data) as image:
        mode = image.mode
    if mode != "RGB":
        words = {"L": "is grey, without colours", "CMYK": "holds printing colours (CMYK)"}
        raise ImageRefusedError(name=name, found=words.get(mode, f"holds {mode} and no RGB"))
    return decode_color(data)


SCOPE = "images"
"""What exclusions are from."""
Scored = dict[Variant, ImageScore]


@dataclass(frozen=True, kw_only=True)
class Reference:
    """The recorded images that methods are compared with."""

    images: ImageSet
    split: str
    """Which images were held out, as far as anyone said."""


@dataclass(frozen=True, kw_only=True)
class MethodReport:
    """What was found about several methods."""

    numbers: Mapping[str, Sequence[StampedMeasurement]]
    """By method, over the views that all of them have."""
    exclusions: tuple[Exclusion, ...]


@dataclass(frozen=True, kw_only=True)
class _View:
    """All methods on one view."""

    size: tuple[int, int]
    scores: Mapping[str, Scored]
    reasons: Mapping[str, str]
    """Why a method has no score, by method; by "" where the recorded image is unusable."""


def compare_methods(
    reference: Reference, methods: Sequence[ImageSet], *, nets: Sequence[PerceptualNet] = ()
) -> MethodReport:
    """Score every method on every view of the reference.

    Raises:
        EvaluatorError: When no method has a single view that can be scored, or no view is common.
    """
    left_out = [gone for method in methods for gone in _unpaired(reference.images, method)]
    wanted = [
        view
        for view in sorted(reference.images.load)
        if any(view in method.load for method in methods)
    ]
    found = spread(
        partial(_score_view, reference, methods, nets), wanted, threads=1 if nets else None
    )
    views = dict(zip(wanted, found, strict=True))
    left_out += [
        Exclusion(episode=_name(method, view), scope=SCOPE, reason=reason)
        for view, seen in views.items()
        for method, reason in seen.reasons.items()
    ]
    scored = [method for method in methods if any(method.name in v.scores for v in views.values())]
    left_out += _without_scores(methods, scored, left_out)
    common = [v for v, seen in views.items() if all(m.name in seen.scores for m in scored)]
    if not scored or not common:
        raise EvaluatorError(_nothing(reference, methods, scored, left_out))
    left_out += _not_common(views, common, scored)
    sizes = resolution_words([views[view].size for view in common])
    numbers = {
        method.name: _numbers(
            method,
            [views[view].scores[method.name] for view in common],
            Protocol(resolution=sizes, split=reference.split, stored=method.stored, nets=nets),
        )
        for method in scored
    }
    return MethodReport(numbers=numbers, exclusions=tuple(left_out))


def _name(method: str, view: str) -> str:
    return f"{method}: {view}" if method else view


def _unpaired(reference: ImageSet, method: ImageSet) -> list[Exclusion]:
    """Name images without a counterpart, on either side."""
    theirs, ours = set(method.load), set(reference.load)
    missing = [(view, f"no image of this name in {method.where}") for view in sorted(ours - theirs)]
    extra = [
        (view, f"the reference has no such image ({reference.where})")
        for view in sorted(theirs - ours)
    ]
    return [
        Exclusion(episode=_name(method.name, view), scope=SCOPE, reason=reason)
        for view, reason in (*missing, *extra)
    ]


def _score_view(
    reference: Reference, methods: Sequence[ImageSet], nets: Sequence[PerceptualNet], view: str
) -> _View:
    scores: dict[str, Scored] = {}
    reasons: dict[str, str] = {}
    try:
        recorded = reference.images.load[view]()
    except GstError as error:
        return _View(size=(0, 0), scores={}, reasons={"": f"recorded image: {error}"})
    for method in methods:
        if view not in method.load:
            continue
        try:
            rendered = method.load[view]()
            refuse_swapped(as_float(recorded), as_float(rendered))
            scores[method.name] = score_variants(recorded, rendered, {}, nets=nets)
        except GstError as error:
            reasons[method.name] = str(error)
    size = (recorded.shape[0], recorded.shape[1])
    return _View(size=size, scores=scores, reasons=reasons)


def _without_scores(
    methods: Sequence[ImageSet], scored: Sequence[ImageSet], left_out: Sequence[Exclusion]
) -> list[Exclusion]:
    """Name methods that have not one usable image."""
    found = []
    for method in methods:
        if method not in scored:
            why = [e.reason for e in left_out if e.episode.startswith(f"{method.name}: ")]
            reason = (
                f"the whole method: none of its images can be scored ({why[0] if why else '-'})"
            )
            found.append(Exclusion(episode=method.name, scope=SCOPE, reason=reason))
    return found


def _not_common(
    views: Mapping[str, _View], common: Sequence[str], scored: Sequence[ImageSet]
) -> list[Exclusion]:
    found = []
    for view, seen in views.items():
        lacking = [method.name for method in scored if method.name not in seen.scores]
        if view not in common and lacking and seen.scores:
            reason = f"left out for every method: no score of {', '.join(lacking)}"
            found.append(Exclusion(episode=view, scope=SCOPE, reason=reason))
    return found


def _nothing(
    reference: Reference,
    methods: Sequence[ImageSet],
    scored: Sequence[ImageSet],
    left_out: Sequence[Exclusion],
) -> str:
    """Say why there is nothing to compare."""
    if scored:
        names = ", ".join(method.name for method in scored)
        return f"no view can be scored for all of {names}. Compare fewer methods at once."
    ours = next(iter(sorted(reference.images.load)), "none")
    theirs = [f"{m.name} has {next(iter(sorted(m.load)), 'none')}" for m in methods]
    why = left_out[0].reason if left_out else "no image"
    return (
        f"no rendered image can be compared with {reference.images.where} ({why}). The reference "
        f"has {ours}; {'; '.join(theirs)}. Name renders as the recorded images are named."
    )


def _numbers(
    method: ImageSet, scores: Sequence[Scored], protocol: Protocol
) -> list[StampedMeasurement]:
    variants: dict[Variant, None] = {}
    for scored in scores:
        variants |= dict.fromkeys(scored)
    return [
        number
        for variant in variants
        for number in stamped_measurements(
            RENDERS,
            variant,
            [scored[variant] for scored in scores if variant in scored],
            protocol,
            method=method.name,
        )
    ]
