"""The ways one pair of images is scored: as it is, brightened, re-posed, and under each mask."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from evaluator.metrics.image import ALIGNMENTS, Alignment
from evaluator.metrics.lpips import PerceptualNet
from evaluator.metrics.scores import METRICS, ImageScore, score_image
from evaluator.metrics.stamp import MASK_MODES, MaskMode


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to score a pair."""

    name: str
    """Part of the ids in ``results.json``."""
    alignment: Alignment = "raw"
    mode: MaskMode = "full"
    mask: str = ""
    """Name of the mask, where there is one."""
    posed: bool = False
    """Whether the image was rendered where pose and brightness fit the recorded one."""
    learned: bool = False
    """Whether LPIPS is computed for it too; a network takes seconds for each image."""

    @property
    def mask_words(self) -> str:
        """What the mask does, for a stamp."""
        words = MASK_MODES[self.mode]
        return f"{words} {self.mask!r}" if self.mask else words

    @property
    def alignment_words(self) -> str:
        """What was fitted to the recorded image, for a stamp."""
        if self.posed:
            return (
                "camera pose and one gain per channel fitted to the recorded image: not strictly "
                "held out"
            )
        return ALIGNMENTS[self.alignment]

    @property
    def clamp_words(self) -> str:
        """What became of values outside 0..1."""
        return "no value outside 0..1" if self.alignment == "raw" else "to 0..1 after alignment"


RAW = Variant(name="raw", learned=True)
GAIN = Variant(name="gain", alignment="gain", learned=True)
AFFINE = Variant(name="affine", alignment="affine")
POSE_GAIN = Variant(name="pose_gain", alignment="gain", posed=True)
_TAKEN = {variant.name for variant in (RAW, GAIN, AFFINE, POSE_GAIN)}


def masked(name: str) -> tuple[Variant, Variant]:
    """Return both ways to use a mask: its pixels alone, and everything else black."""
    own = f"mask_{name}" if name in _TAKEN or name.endswith("_black") else name
    return (
        Variant(name=own, mode="mask-pixels", mask=name),
        Variant(name=f"{own}_black", mode="black-background", mask=name, learned=True),
    )


def score_variants(
    recorded: UInt8[np.ndarray, "height width 3"] | Float[np.ndarray, "height width 3"],
    rendered: (
        UInt8[np.ndarray, "rendered_height rendered_width 3"]
        | Float[np.ndarray, "rendered_height rendered_width 3"]
    ),
    masks: Mapping[str, Bool[np.ndarray, "height width"]],
    *,
    nets: Sequence[PerceptualNet] = (),
) -> dict[Variant, ImageScore]:
    """Score one pair in every way but re-posed.

    Raises:
        ImageShapeError: When the sizes differ.
    """
    ways: list[tuple[Variant, np.ndarray | None]] = [(RAW, None), (GAIN, None), (AFFINE, None)]
    ways += [(variant, mask) for name, mask in masks.items() for variant in masked(name)]
    return {
        variant: score_image(
            recorded,
            rendered,
            mask=mask,
            mode=variant.mode,
            alignment=variant.alignment,
            nets=nets if variant.learned else (),
        )
        for variant, mask in ways
    }


def values_by_id(scores: Mapping[Variant, ImageScore]) -> dict[str, float]:
    """Return every value by the last part of its id: ``psnr_db``, ``psnr_gain_db``, ``ssim`` ..."""
    return {
        METRICS[metric].named(variant.name): value
        for variant, score in scores.items()
        for metric, value in score.values.items()
    }
