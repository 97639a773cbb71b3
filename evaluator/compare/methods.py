"""Compare several methods on the same views: what one of them lacks counts for none.

A mean over other images is another number. So the table is made over the views that every method
has, and each view that is left out is named with its reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from bridge.errors import GstError
from evaluator.compare.image_measurements import (
    Protocol,
    StampedMeasurement,
    resolution_words,
    stamped_measurements,
)
from evaluator.compare.image_sets import ImageSet
from evaluator.compare.measure import slug
from evaluator.compare.parallel import spread
from evaluator.compare.variants import Variant, score_variants, values_by_id
from evaluator.compare.view_quality import NUM_WORST, ViewQuality, shrunk_u8
from evaluator.errors import EvaluatorError
from evaluator.metrics.image import ImageShapeError, as_float, refuse_swapped
from evaluator.metrics.lpips import PerceptualNet
from evaluator.metrics.scores import ImageScore
from evaluator.result import Exclusion

SCOPE = "images"
"""What exclusions are from."""
EMPTY_MASK = "no pixel of the mask is above 127: write what is inside as 255; scored without it"
Scored = dict[Variant, ImageScore]


@dataclass(frozen=True, kw_only=True)
class Reference:
    """The recorded images that methods are compared with."""

    images: ImageSet
    masks: Mapping[str, ImageSet] = field(default_factory=dict)
    """Boolean images by the name of the mask."""
    asked: frozenset[str] = frozenset()
    """Masks that somebody gave for these views: a view without one is named. An object that is not
    seen has no mask in a run's own views, and that is no lack."""
    split: str
    """Which images were held out, as far as anyone said."""


@dataclass(frozen=True, kw_only=True)
class MethodReport:
    """What was found about several methods."""

    numbers: Mapping[str, Sequence[StampedMeasurement]]
    """By method, over the views that all of them have."""
    views: tuple[ViewQuality, ...]
    exclusions: tuple[Exclusion, ...]
    common: tuple[str, ...]
    """The views in every mean."""


@dataclass(frozen=True, kw_only=True)
class _View:
    """All methods on one view."""

    size: tuple[int, int]
    scores: Mapping[str, Scored]
    reasons: Mapping[str, str]
    """Why a method has no score, by method; by "" where the recorded image is unusable."""
    unmasked: Mapping[str, str] = field(default_factory=dict)
    """Why a mask that somebody gave does not count here, by its name."""


def compare_methods(
    reference: Reference, methods: Sequence[ImageSet], *, nets: Sequence[PerceptualNet] = ()
) -> MethodReport:
    """Score every method on every view of the reference.

    Args:
        reference: The recorded images.
        methods: Their renders.
        nets: For LPIPS; none leaves it out.

    Raises:
        EvaluatorError: When no method has a single view that can be scored, or no view is common.
    """
    left_out = [gone for method in methods for gone in _unpaired(reference.images, method)]
    wanted = [
        view
        for view in sorted({*reference.images.load, *reference.images.refused})
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
    left_out += [
        Exclusion(episode=f"mask {name}: {view}", scope=SCOPE, reason=reason)
        for view, seen in views.items()
        for name, reason in seen.unmasked.items()
    ]
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
    shown = [
        quality
        for method in scored
        for quality in _qualities(reference.images, method, {v: views[v] for v in common})
    ]
    return MethodReport(
        numbers=numbers, views=tuple(shown), exclusions=tuple(left_out), common=tuple(common)
    )


def _name(method: str, view: str) -> str:
    return f"{method}: {view}" if method else view


def _unpaired(reference: ImageSet, method: ImageSet) -> list[Exclusion]:
    """Name images without a counterpart, on either side."""
    theirs, ours = {*method.load, *method.refused}, {*reference.load, *reference.refused}
    missing = [(view, f"no image of this name in {method.where}") for view in sorted(ours - theirs)]
    extra = [
        (view, f"the reference has no such image ({reference.where})")
        for view in sorted(theirs - ours)
    ]
    refused = [(view, reason) for view, reason in sorted(method.refused.items()) if view in ours]
    return [
        Exclusion(episode=_name(method.name, view), scope=SCOPE, reason=reason)
        for view, reason in (*missing, *extra, *refused)
    ]


def _score_view(
    reference: Reference, methods: Sequence[ImageSet], nets: Sequence[PerceptualNet], view: str
) -> _View:
    scores: dict[str, Scored] = {}
    reasons: dict[str, str] = {}
    try:
        if view in reference.images.refused:
            raise EvaluatorError(reference.images.refused[view])
        recorded = reference.images.load[view]()
        masks, unmasked = _masks(reference, view, recorded)
    except GstError as error:
        return _View(size=(0, 0), scores={}, reasons={"": f"recorded image: {error}"})
    for method in methods:
        if view not in method.load:
            continue
        try:
            rendered = method.load[view]()
            refuse_swapped(as_float(recorded), as_float(rendered))
            scores[method.name] = score_variants(recorded, rendered, masks, nets=nets)
        except GstError as error:
            reasons[method.name] = str(error)
    size = (recorded.shape[0], recorded.shape[1])
    return _View(size=size, scores=scores, reasons=reasons, unmasked=unmasked)


def _masks(
    reference: Reference, view: str, recorded: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Load the masks of one view, and say which were asked for and lack; it is scored without."""
    found, lacking = {}, {}
    for name, masks in reference.masks.items():
        if view not in masks.load:
            lacking[name] = f"no mask of this name in {masks.where}; scored without it"
            continue
        mask = masks.load[view]()
        if mask.shape != recorded.shape[:2]:
            raise ImageShapeError(
                found=f"the mask is {mask.shape}, the recorded image {recorded.shape[:2]}"
            )
        if mask.any():
            found[name] = mask
        else:
            lacking[name] = EMPTY_MASK
    return found, {name: why for name, why in lacking.items() if name in reference.asked}


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
            f"image.{slug(method.name)}",
            variant,
            [scored[variant] for scored in scores if variant in scored],
            protocol,
        )
    ]


def _qualities(
    reference: ImageSet, method: ImageSet, views: Mapping[str, _View]
) -> list[ViewQuality]:
    """One record for each view, with pictures of those with the lowest PSNR."""
    values = {view: values_by_id(seen.scores[method.name]) for view, seen in views.items()}
    rated = sorted((found["psnr_db"], view) for view, found in values.items() if "psnr_db" in found)
    worst = {view for _, view in rated[:NUM_WORST]}
    return [
        ViewQuality(
            episode=reference.name,
            view_id=view,
            method=method.name,
            values=found,
            recorded_u8=shrunk_u8(reference.load[view]()) if view in worst else None,
            rendered_u8=shrunk_u8(method.load[view]()) if view in worst else None,
        )
        for view, found in values.items()
    ]
