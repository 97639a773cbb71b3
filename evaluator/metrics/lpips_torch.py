"""The network of LPIPS, version 0.1, in plain torch; loaded only when a backbone was given."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from evaluator.metrics.lpips import INPUTS, MIN_SIDE_PX, Distances, InputName, metric_id
from evaluator.metrics.lpips_weights import (
    LAYERS,
    Convolution,
    describe_weights,
    read_backbone,
    read_heads,
)
from evaluator.metrics.options import NetName

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""Mean and spread of ImageNet's channels for images in -1..1, as version 0.1 fixes them."""
SMALLEST_NORM = 1e-10
"""Added to the length of a feature before it is divided by it."""


class LpipsNet:
    """One backbone with its linear heads."""

    def __init__(
        self,
        name: NetName,
        backbone: list[Convolution],
        heads: list[Float[Tensor, "_channels 1 1"]],
        weights: str,
    ) -> None:
        """Keep weights that were checked."""
        self.name = name
        self.weights = weights
        self._layers = list(zip(LAYERS[name], backbone, strict=True))
        self._heads = heads

    @classmethod
    def open(cls, name: NetName, path: Path) -> "LpipsNet":
        """Load a backbone from a file, and the heads from an installed wheel.

        Raises:
            LpipsWeightsError: When one of them is not what it should be.
            MissingDependencyError: When no installed package holds the heads.
        """
        backbone, sha256 = read_backbone(name, path)
        heads, origin = read_heads(name)
        return cls(name, backbone, heads, describe_weights(name, sha256, origin))

    def distances(
        self,
        recorded: Float[np.ndarray, "height width 3"],
        replayed: Float[np.ndarray, "height width 3"],
    ) -> Distances:
        """Return both distances of a pair in 0..1, or why there is none.

        Range: 0 and up, 0 is identical, lower is better.
        """
        ids = {given: metric_id(self.name, given) for given in INPUTS}
        if min(recorded.shape[:2]) < MIN_SIDE_PX:
            reason = f"a side is shorter than {MIN_SIDE_PX} pixels"
            return Distances(reasons=dict.fromkeys(ids.values(), reason))
        pair = torch.from_numpy(np.stack([recorded, replayed]).astype(np.float32))
        channels_first = pair.permute(0, 3, 1, 2).contiguous()
        return Distances(
            values={name: self._distance(channels_first, given) for given, name in ids.items()}
        )

    def _distance(self, pair: Float[Tensor, "2 3 height width"], given: InputName) -> float:
        with torch.inference_mode():
            if given == "pm1":
                pair = 2.0 * pair - 1.0
            shift, scale = (torch.tensor(values).view(1, 3, 1, 1) for values in (SHIFT, SCALE))
            x = (pair - shift) / scale
            total, heads = 0.0, iter(self._heads)
            for layer, (weight, bias) in self._layers:
                if layer.pool:
                    x = functional.max_pool2d(x, layer.pool, stride=2)
                x = functional.relu(functional.conv2d(x, weight, bias, layer.stride, layer.padding))
                if layer.tap:
                    total += _head_distance(x, next(heads))
            return total


def _head_distance(
    features: Float[Tensor, "2 channels height width"], head: Float[Tensor, "channels 1 1"]
) -> float:
    unit = features / (features.square().sum(1, keepdim=True).sqrt() + SMALLEST_NORM)
    difference = (unit[0] - unit[1]).square() * head
    return float(difference.sum(0).mean(dtype=torch.float64))
