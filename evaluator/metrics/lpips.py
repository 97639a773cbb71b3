"""LPIPS: its four names, and what is said where it is not computed. No torch is loaded here.

LPIPS (Zhang et al. 2018, version 0.1) is defined for images in -1..1; papers on 3D Gaussian
splatting feed it images in 0..1, which gives other numbers. So each backbone makes two metrics.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from evaluator.metrics.image_protocol import ImageMetric, NetName

NET_WORDS: dict[NetName, str] = {"vgg": "VGG16", "alex": "AlexNet"}
InputName = Literal["01", "pm1"]
INPUTS: dict[InputName, str] = {
    "01": "images fed in 0..1, not scaled (as 3D Gaussian splatting papers)",
    "pm1": "images scaled to -1..1 first (as LPIPS is defined)",
}
LPIPS_NOT_COMPUTED = (
    "not computed: no backbone (its weights are not shipped and nothing is downloaded)"
)
MIN_SIDE_PX = 32
"""Shortest side that AlexNet's two poolings leave something of."""


def metric_id(net: NetName, given: InputName) -> str:
    """Return the id of LPIPS with one backbone and one input range."""
    return f"lpips_{net}_{given}"


LPIPS_METRICS: tuple[ImageMetric, ...] = tuple(
    ImageMetric(
        id=metric_id(net, given),
        column=f"LPIPS ({net}, {'0..1' if given == '01' else '-1..1'})",
        definition=f"LPIPS 0.1 (Zhang 2018), {NET_WORDS[net]}, {words}",
        implementation="evaluator.metrics.lpips_torch 1",
        values="sRGB, data range 0..1" if given == "01" else "sRGB, scaled to -1..1",
        window=f"receptive fields of {NET_WORDS[net]}",
        padding="zeros inside the network",
        higher_is_better=False,
        by_pixel=False,
    )
    for net in NET_WORDS
    for given, words in INPUTS.items()
)


@dataclass(frozen=True, kw_only=True)
class Distances:
    """What one backbone says of one pair of images."""

    values: Mapping[str, float] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)


@runtime_checkable
class PerceptualNet(Protocol):
    """What scoring needs of a network; the one there is stands in ``lpips_torch``."""

    @property
    def name(self) -> NetName:
        """Its backbone."""

    @property
    def weights(self) -> str:
        """Content hashes of backbone and heads."""

    def distances(
        self,
        recorded: Float[np.ndarray, "height width 3"],
        replayed: Float[np.ndarray, "height width 3"],
    ) -> Distances:
        """Return a distance, or the reason against one, by metric id."""


def net_of(metric: ImageMetric, nets: Sequence[PerceptualNet]) -> PerceptualNet | None:
    """Return the network that an LPIPS is computed with, where it was given."""
    return next((net for net in nets if metric.id.startswith(f"lpips_{net.name}_")), None)
