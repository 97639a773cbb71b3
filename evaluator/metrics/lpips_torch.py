"""The network of LPIPS, version 0.1, in plain torch; loaded only when a backbone was given.

Its backbone's weights come from a file of the user, those of the linear heads from a wheel. Nothing
is downloaded, and neither the ``lpips`` package nor torchvision is imported: only files are read.
Every shape is checked, since a wrong network would give a number that looks right.
"""

import pickle
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
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
from evaluator.metrics.image_protocol import NetName
from evaluator.metrics.lpips import INPUTS, MIN_SIDE_PX, NET_WORDS, Distances, InputName, metric_id


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One convolution with the ReLU behind it."""

    index: int
    """Number in torchvision's ``features``."""
    channels_in: int
    channels_out: int
    size: int = 3
    stride: int = 1
    padding: int = 1
    pool: int = 0
    """Size of the largest-value pooling before it, with stride 2; 0 is none."""
    tap: bool = False
    """Whether LPIPS compares what comes out."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Of the weight."""
        return (self.channels_out, self.channels_in, self.size, self.size)


def _vgg16() -> tuple[Layer, ...]:
    layers, index, channels = [], 0, 3
    for stage, (width, depth) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        for place in range(depth):
            pool = 2 if stage > 0 and place == 0 else 0
            last = place == depth - 1
            layers.append(
                Layer(index=index, channels_in=channels, channels_out=width, pool=pool, tap=last)
            )
            channels = width
            index += 3 if last else 2
    return tuple(layers)


_ALEXNET = (
    Layer(index=0, channels_in=3, channels_out=64, size=11, stride=4, padding=2, tap=True),
    Layer(index=3, channels_in=64, channels_out=192, size=5, padding=2, pool=3, tap=True),
    Layer(index=6, channels_in=192, channels_out=384, pool=3, tap=True),
    Layer(index=8, channels_in=384, channels_out=256, tap=True),
    Layer(index=10, channels_in=256, channels_out=256, tap=True),
)
LAYERS: dict[NetName, tuple[Layer, ...]] = {"vgg": _vgg16(), "alex": _ALEXNET}
PUBLISHED: dict[NetName, str] = {"vgg": "397923af", "alex": "7be5be79"}
"""How the SHA-256 of torchvision's published files begins; their names carry it."""
HEADS = (("lpips", "weights/v0.1"), ("torchmetrics", "functional/image/lpips_models"))
"""Packages whose wheels hold the linear heads of version 0.1, and where in them."""

Convolution = tuple[
    Float[Tensor, "_channels_out _channels_in _size _size"], Float[Tensor, " _channels_out"]
]
"""Weight and bias; the sizes of one layer are not those of the next."""


class LpipsWeightsError(UsageError):
    """Weights cannot be used for LPIPS."""

    def __init__(self, *, path: Path, found: str, hint: str) -> None:
        """Remember the file."""
        self.path = path
        super().__init__(f"{path}: {found}. {hint}")


def read_backbone(net: NetName, path: Path) -> tuple[list[Convolution], str]:
    """Read the convolutions of a backbone; its other weights are not looked at.

    Returns:
        Weight and bias of each layer as float32, and the SHA-256 of the file.

    Raises:
        LpipsWeightsError: When the file is not there, not a state dict, or another network's.
    """
    hint = (
        f"It must be the state dict of torchvision's {NET_WORDS[net]} (safetensors or torch.save); "
        "docs/metrics.md says where to get it."
    )
    if not path.is_file():
        raise LpipsWeightsError(path=path, found="there is no such file", hint=hint)
    state = _state(path, hint)
    prefix = "features." if "features.0.weight" in state else ""
    found = []
    for layer in LAYERS[net]:
        pair = []
        for name, shape in (("weight", layer.shape), ("bias", (layer.channels_out,))):
            key = f"{prefix}{layer.index}.{name}"
            pair.append(_checked(state, key, shape, path, hint))
        found.append((pair[0], pair[1]))
    return found, hash_file(path)


def read_heads(net: NetName) -> tuple[list[Float[Tensor, "_channels 1 1"]], str]:
    """Read the linear heads out of an installed wheel, without importing it.

    Returns:
        One weight for each channel of each tap, and where they came from, in words.
    """
    for package, folder in HEADS:
        spec = find_spec(package)
        for root in (spec.submodule_search_locations or ()) if spec is not None else ():
            path = Path(root) / folder / f"{net}.pth"
            if path.is_file():
                return _heads(net, path), f"{package} {_version(package)}, {hash_file(path)[:16]}"
    raise MissingDependencyError(
        package="lpips or torchmetrics", extra="lpips", purpose="LPIPS (for its linear heads)"
    )


def describe_weights(net: NetName, sha256: str, heads: str) -> str:
    """Write where the weights of a stamp came from."""
    origin = (
        "torchvision's published file"
        if sha256.startswith(PUBLISHED[net])
        else "not torchvision's published file, so its owner must vouch for it"
    )
    return f"backbone sha256 {sha256[:16]} ({origin}), heads of {heads}"


def _heads(net: NetName, path: Path) -> list[Tensor]:
    hint = "Install the package anew."
    state = _state(path, hint)
    taps = [layer.channels_out for layer in LAYERS[net] if layer.tap]
    return [
        _checked(state, f"lin{k}.model.1.weight", (1, channels, 1, 1), path, hint)[0]
        for k, channels in enumerate(taps)
    ]


def _state(path: Path, hint: str) -> Mapping[str, Any]:
    try:
        state = _safetensors(path) if path.suffix == ".safetensors" else _torch_file(path)
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, EOFError) as error:
        found = f"it cannot be read ({str(error).splitlines()[0][:100]})" if str(error) else "empty"
        raise LpipsWeightsError(path=path, found=found, hint=hint) from error
    if not isinstance(state, Mapping):
        found = f"it holds a {type(state).__name__}, no state dict"
        raise LpipsWeightsError(path=path, found=found, hint=hint)
    return state


def _torch_file(path: Path) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of pickles that it then refuses
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # Its message tells how to load pickles after all, which runs their code.
        message = "it holds more than tensors, or is no torch file"
        raise ValueError(message) from error


def _safetensors(path: Path) -> Mapping[str, Any]:
    try:
        from safetensors import SafetensorError  # noqa: PLC0415  # only for this format
        from safetensors.torch import load_file  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            package="safetensors", extra="lpips", purpose="reading a .safetensors file"
        ) from error
    try:
        return dict(load_file(path))
    except SafetensorError as error:
        raise ValueError(str(error)) from error


def _checked(
    state: Mapping[str, Any], key: str, shape: tuple[int, ...], path: Path, hint: str
) -> Tensor:
    tensor = state.get(key)
    found = ""
    if not isinstance(tensor, Tensor):
        found = f"it has no tensor {key}"
    elif tuple(tensor.shape) != shape:
        found = f"{key} is {tuple(tensor.shape)}, not {shape}"
    elif not tensor.is_floating_point():
        found = f"{key} holds {tensor.dtype}, no floats"
    elif not bool(torch.isfinite(tensor).all()):
        found = f"{key} holds values that are not finite"
    if found or not isinstance(tensor, Tensor):
        raise LpipsWeightsError(path=path, found=found, hint=hint)
    return tensor.to(torch.float32)


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "of unknown version"


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
        """Load a backbone from a file, and the heads from an installed wheel."""
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
