"""The network of LPIPS, version 0.1, in plain torch; loaded only when a backbone was given.

Its backbone's weights come from a file of the user, those of the linear heads from torchmetrics'
wheel. Nothing is downloaded and no other package imported: only files are read. Every shape is
checked, since a wrong network would give a number that looks right.
"""

import pickle
import warnings
from collections.abc import Mapping
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from bridge.episode.provenance import hash_file
from bridge.errors import MissingDependencyError, UsageError
from evaluator.errors import UndefinedStatisticError

MIN_SIDE_PX = 16
"""Shortest side that VGG's four poolings leave something of."""
PUBLISHED = "397923af"
"""How the SHA-256 of torchvision's published file begins; its name carries it."""
HEADS = ("torchmetrics", "functional/image/lpips_models/vgg.pth")
"""Package whose wheel holds the linear heads of version 0.1, and where in it."""
STAGES = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
"""Channels and convolutions of VGG16 between poolings; LPIPS compares the last of each."""
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""Mean and spread of ImageNet's channels for images in -1..1, as version 0.1 fixes them."""
SMALLEST_NORM = 1e-10
"""Added to the length of a feature before it is divided by it."""


class LpipsWeightsError(UsageError):
    """Weights cannot be used for LPIPS."""

    def __init__(self, *, path: Path, found: str) -> None:
        """Remember the file."""
        self.path = path
        super().__init__(
            f"{path}: {found}. It must be the state dict of torchvision's VGG16 "
            "(safetensors or torch.save); docs/metrics.md says where to get it."
        )


class _Weights:
    """A state dict whose tensors are checked when they are taken out."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise self.refused("there is no such file")
        try:
            state = _loaded(path)
        except (OSError, RuntimeError, ValueError, KeyError, TypeError, EOFError) as error:
            first = str(error).partition("\n")[0][:100]
            raise self.refused(f"it cannot be read ({first})" if first else "empty") from error
        if not isinstance(state, Mapping):
            raise self.refused(f"it holds a {type(state).__name__}, no state dict")
        self.state = state

    def refused(self, found: str) -> LpipsWeightsError:
        return LpipsWeightsError(path=self.path, found=found)

    def tensor(self, key: str, shape: tuple[int, ...]) -> Tensor:
        tensor = self.state.get(key)
        if not isinstance(tensor, Tensor):
            raise self.refused(f"it has no tensor {key}")
        if tuple(tensor.shape) != shape:
            raise self.refused(f"{key} is {tuple(tensor.shape)}, not {shape}")
        if not tensor.is_floating_point():
            raise self.refused(f"{key} holds {tensor.dtype}, no floats")
        if not bool(torch.isfinite(tensor).all()):
            raise self.refused(f"{key} holds values that are not finite")
        return tensor.to(torch.float32)


def _loaded(path: Path) -> Any:
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError  # noqa: PLC0415  # only for this format
        from safetensors.torch import load_file  # noqa: PLC0415

        try:
            return load_file(path)
        except SafetensorError as error:
            raise ValueError(str(error)) from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of pickles that it then refuses
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # Its message tells how to load pickles after all, which runs their code.
        raise ValueError("it holds more than tensors, or is no torch file") from error


def read_heads() -> tuple[list[Float[Tensor, "_channels 1 1"]], str]:
    """Read weights of each channel of each stage out of an installed wheel, and say of which.

    The wheel is not imported.
    """
    package, file = HEADS
    spec = find_spec(package)
    for root in (spec.submodule_search_locations or ()) if spec is not None else ():
        path = Path(root) / file
        if path.is_file():
            weights = _Weights(path)
            heads = [
                weights.tensor(f"lin{stage}.model.1.weight", (1, channels, 1, 1))[0]
                for stage, (channels, _) in enumerate(STAGES)
            ]
            return heads, f"{package} {metadata.version(package)}, {hash_file(path)[:16]}"
    raise MissingDependencyError(
        package=package, extra="lpips", purpose="LPIPS (for its linear heads)"
    )


class LpipsNet:
    """VGG16 with the linear heads."""

    def __init__(self, path: Path) -> None:
        """Load a backbone from a file, whose other weights are not looked at, and the heads.

        Raises:
            LpipsWeightsError: When the file is not there, not a state dict, or another network's.
        """
        backbone = _Weights(path)
        prefix = "features." if "features.0.weight" in backbone.state else ""
        self._stages: list[list[tuple[Tensor, Tensor]]] = []
        index, channels = 0, 3
        for width, depth in STAGES:
            stage = []
            for _ in range(depth):
                weight = backbone.tensor(f"{prefix}{index}.weight", (width, channels, 3, 3))
                stage.append((weight, backbone.tensor(f"{prefix}{index}.bias", (width,))))
                channels, index = width, index + 2  # a ReLU has a number of its own
            self._stages.append(stage)
            index += 1  # and so has a pooling
        self._heads, origin = read_heads()
        sha256 = hash_file(path)
        whose = (
            "torchvision's published file"
            if sha256.startswith(PUBLISHED)
            else "not torchvision's published file, so its owner must vouch for it"
        )
        self.weights = f"backbone sha256 {sha256[:16]} ({whose}), heads of {origin}"

    def distance(
        self,
        recorded: Float[np.ndarray, "height width 3"],
        replayed: Float[np.ndarray, "height width 3"],
    ) -> float:
        """Return the distance of a pair in 0..1, which is not scaled to -1..1.

        Range: 0 and up, 0 is identical, lower is better. Undefined when: a side is too short.
        """
        if min(recorded.shape[:2]) < MIN_SIDE_PX:
            reason = f"a side is shorter than {MIN_SIDE_PX} pixels"
            raise UndefinedStatisticError(statistic="LPIPS", reason=reason)
        with torch.inference_mode():
            x = torch.from_numpy(np.stack([recorded, replayed]).astype(np.float32))
            shift, scale = (torch.tensor(values).view(1, 3, 1, 1) for values in (SHIFT, SCALE))
            x = (x.permute(0, 3, 1, 2).contiguous() - shift) / scale
            total = 0.0
            for number, (stage, head) in enumerate(zip(self._stages, self._heads, strict=True)):
                if number:
                    x = functional.max_pool2d(x, 2, stride=2)
                for weight, bias in stage:
                    x = functional.relu(functional.conv2d(x, weight, bias, padding=1))
                total += _head_distance(x, head)
            return total


def _head_distance(
    features: Float[Tensor, "2 channels height width"], head: Float[Tensor, "channels 1 1"]
) -> float:
    unit = features / (features.square().sum(1, keepdim=True).sqrt() + SMALLEST_NORM)
    difference = (unit[0] - unit[1]).square() * head
    return float(difference.sum(0).mean(dtype=torch.float64))
