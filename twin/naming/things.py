"""What segmentation gives: masks in images, instances in the scene."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, UInt16

from twin.errors import TwinError

UNKNOWN_SHAPE = "thing"
"""Word in labels for a shape that is no box, cylinder, ball or container."""
NAMED = "task"
"""Source of an instance that is an object of the task."""


class SemanticsError(TwinError):
    """Masks, features or a query do not fit the scene they are meant for."""


@dataclass(frozen=True, kw_only=True)
class Mask:
    """One thing in one image, as a 2D segmenter reports it."""

    image: Bool[np.ndarray, "height width"]
    """True on the thing; the size of the camera's image."""
    label: str
    """What the segmenter calls it; may be empty."""
    score: float = 1.0
    """The segmenter's confidence, 0..1."""


@dataclass(frozen=True, kw_only=True)
class Instance:
    """One thing of the scene, as a set of its Gaussians."""

    id: int
    """Its value in ``SemanticScene.labels``; from 1."""
    label: str
    mask: Bool[np.ndarray, " num_splats"]
    score: float
    """0..1: mean confidence of its masks; of the default segmenter the share of firm points."""
    source: str
    color_srgb: tuple[int, int, int] = (0, 0, 0)
    """Median colour of its Gaussians."""
    T_base_instance: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Centre and axes of its box: z up, x along the longer side, see ``size_m``."""
    size_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Extents of its box along those axes."""
    parts: Mapping[str, Bool[np.ndarray, " num_splats"]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What people are told: size and number too, and no shape where none is known."""
        size = " x ".join(f"{100 * extent:.0f}" for extent in self.size_m)
        colour, _, shape = self.label.rpartition(" ")
        known = colour if shape in (UNKNOWN_SHAPE, "toy") else self.label
        return f"object {self.id}, {known or 'no name'}, {size} cm"


@dataclass(frozen=True, kw_only=True)
class SemanticScene:
    """The things of a scene."""

    instances: tuple[Instance, ...]
    labels: UInt16[np.ndarray, " num_splats"]
    """Which instance each Gaussian belongs to; 0 is the background."""
    source: str
    """Who says so."""
    remark: str = ""
    """Why there is nothing, or what was left out; empty when there is nothing to say."""
