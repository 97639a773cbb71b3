"""Load networks through ``transformers``: from a local folder, no network access, no foreign code.

Only ``safetensors`` are accepted: the other formats are pickles, which run code when opened. Images
are resized and normalised in torch, without torchvision.
"""

import importlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from bridge.episode import provenance
from bridge.errors import MissingDependencyError, UsageError

MAX_JSON_BYTES = 64_000_000
MAX_WEIGHT_BYTES = 64_000_000_000
MAX_HEADER_BYTES = 100_000_000
"""What the format's own library allows."""
SINGLE, INDEX = "model.safetensors", "model.safetensors.index.json"
CHECKSUMS = "SHA256SUMS"
_PICKLED = (".bin", ".pt", ".pth", ".ckpt", ".pkl", ".pickle", ".h5", ".msgpack")


class WeightsError(UsageError):
    """A folder of weights cannot be used."""

    def __init__(self, *, folder: Path, found: str, kind: "WeightsKind") -> None:
        """Remember the folder."""
        self.folder = folder
        super().__init__(
            f"{folder}: {found}. Weights of {kind.name} are a folder with {kind.wanted()}, got by "
            f"hand ({kind.origin}; licence: {kind.licence}); docs/foundation_models.md says how."
        )


@dataclass(frozen=True, kw_only=True)
class WeightsKind:
    """One family of models, and what a folder of its weights holds."""

    name: str
    model_types: tuple[str, ...]
    """Values of ``model_type`` in ``config.json`` that the adapter reads."""
    origin: str
    """Name under which its makers publish it."""
    licence: str
    speaks: bool = False
    """Whether it takes text and so needs a tokenizer."""

    def wanted(self) -> str:
        """The files a folder needs, in words."""
        files = f"config.json, {SINGLE} (or {INDEX} and its parts)"
        return f"{files} and tokenizer.json" if self.speaks else files


def check_folder(folder: Path, kind: WeightsKind) -> dict[str, Any]:
    """Look whether a folder holds whole weights of one kind; load none of them.

    Sizes are compared with what the headers of the files promise. Where a file ``SHA256SUMS`` lies
    beside the weights, every file it names is compared with its checksum.

    Raises:
        WeightsError: Naming what is missing, cut short, changed, pickled or of another kind.
    """
    if not folder.is_dir():
        raise WeightsError(folder=folder, found="no such folder", kind=kind)
    config = _json(folder / "config.json", folder, kind)
    found_type = config.get("model_type")
    if found_type not in kind.model_types:
        found = f"config.json describes a model of type {found_type!r}, not {kind.model_types[0]!r}"
        raise WeightsError(folder=folder, found=found, kind=kind)
    for path in weight_files(folder, kind):
        _check_safetensors(path, folder, kind)
    tokenizers = (("tokenizer.json",), ("vocab.json", "merges.txt"))
    has_tokenizer = any(all((folder / name).is_file() for name in names) for names in tokenizers)
    if kind.speaks and not has_tokenizer:
        raise WeightsError(folder=folder, found="there is no tokenizer.json", kind=kind)
    _check_sums(folder, kind)
    return config


def weight_files(folder: Path, kind: WeightsKind) -> list[Path]:
    """The safetensors of a folder, all of them present."""
    if (folder / SINGLE).is_file():
        return [folder / SINGLE]
    if not (folder / INDEX).is_file():
        pickled = sorted(path.name for path in folder.iterdir() if path.suffix in _PICKLED)
        found = f"there is no {SINGLE}"
        if pickled:
            found += f", only {pickled[0]}, which can run code when opened and is refused"
        raise WeightsError(folder=folder, found=found, kind=kind)
    named = _json(folder / INDEX, folder, kind).get("weight_map")
    if not isinstance(named, dict) or not named:
        raise WeightsError(folder=folder, found=f"{INDEX} names no parts", kind=kind)
    parts = sorted({str(name) for name in named.values()})
    strange = [
        name for name in parts if Path(name).name != name or not name.endswith(".safetensors")
    ]
    if strange:
        found = f"{INDEX} names {strange[0]!r}, which is no safetensors file of this folder"
        raise WeightsError(folder=folder, found=found, kind=kind)
    missing = [name for name in parts if not (folder / name).is_file()]
    if missing:
        found = f"{len(missing)} of {len(parts)} parts are missing, first {missing[0]}"
        raise WeightsError(folder=folder, found=found, kind=kind)
    return [folder / name for name in parts]


def weights_hash(folder: Path, kind: WeightsKind) -> str:
    """SHA-256 over configuration and weights, for the record of what was used."""
    return provenance.hash_files([folder / "config.json", *weight_files(folder, kind)])


def _json(path: Path, folder: Path, kind: WeightsKind) -> dict[str, Any]:
    if not path.is_file():
        raise WeightsError(folder=folder, found=f"there is no {path.name}", kind=kind)
    if path.stat().st_size > MAX_JSON_BYTES:
        raise WeightsError(folder=folder, found=f"{path.name} is too large", kind=kind)
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise WeightsError(folder=folder, found=f"{path.name} is not JSON", kind=kind) from error
    if not isinstance(content, dict):
        raise WeightsError(folder=folder, found=f"{path.name} is not an object", kind=kind)
    return content


def _check_safetensors(path: Path, folder: Path, kind: WeightsKind) -> None:
    """Compare a file's size with its header: 8 bytes of length, JSON, then the numbers."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        start = stream.read(8)
        length = int.from_bytes(start, "little")
        if start == b"version ":
            found = f"{path.name} is a git-lfs pointer of {size} bytes, not the weights themselves"
            raise WeightsError(folder=folder, found=found, kind=kind)
        if len(start) < 8 or length > min(size, MAX_HEADER_BYTES) or size > MAX_WEIGHT_BYTES:
            found = f"{path.name} is no safetensors file, or cut short ({size} bytes)"
            raise WeightsError(folder=folder, found=found, kind=kind)
        try:
            header = json.loads(stream.read(length))
            ends = [
                about["data_offsets"][1] for key, about in header.items() if key != "__metadata__"
            ]
            promised = 8 + length + max((int(end) for end in ends), default=0)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            found = f"the header of {path.name} is broken"
            raise WeightsError(folder=folder, found=found, kind=kind) from error
    if promised != size:
        found = f"{path.name} has {size} bytes where its header promises {promised}"
        raise WeightsError(folder=folder, found=found, kind=kind)


def _check_sums(folder: Path, kind: WeightsKind) -> None:
    """Compare with ``SHA256SUMS`` as ``sha256sum`` writes it, where it exists."""
    path = folder / CHECKSUMS
    if not path.is_file():
        return
    for line in path.read_text("utf-8", "replace").splitlines():
        digest, _, name = line.strip().partition(" ")
        name = name.lstrip(" *")
        if not digest:
            continue
        if Path(name).name != name or not (folder / name).is_file():
            found = f"{CHECKSUMS} names {name!r}, which is no file of this folder"
            raise WeightsError(folder=folder, found=found, kind=kind)
        if provenance.hash_file(folder / name) != digest.lower():
            found = f"{name} does not have the SHA-256 that {CHECKSUMS} states"
            raise WeightsError(folder=folder, found=found, kind=kind)


def read_normalisation(
    folder: Path, kind: WeightsKind, default: tuple[tuple[float, ...], tuple[float, ...]]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Mean and standard deviation of colours 0..1, from ``preprocessor_config.json`` if present.

    Args:
        default: Mean and standard deviation per channel where the folder states none.
    """
    path = folder / "preprocessor_config.json"
    if not path.is_file():
        return default
    content = _json(path, folder, kind)
    values = []
    for name, standard in zip(("image_mean", "image_std"), default, strict=True):
        given = content.get(name, list(standard))
        is_numbers = isinstance(given, list) and all(isinstance(v, int | float) for v in given)
        if not is_numbers or len(given) != 3 or not all(0 <= v < 10 for v in given):
            raise WeightsError(folder=folder, found=f"{path.name}: {name} is {given!r}", kind=kind)
        values.append(tuple(float(v) for v in given))
    mean, deviation = values
    if math.prod(deviation) == 0.0:
        raise WeightsError(folder=folder, found=f"{path.name}: image_std holds a 0", kind=kind)
    return mean, deviation


Normalisation = tuple[tuple[float, ...], tuple[float, ...]]
"""Mean and standard deviation of red, green, blue, for colours 0..1."""
IMAGENET: Normalisation = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
HALF: Normalisation = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


def import_torch() -> Any:
    """Import torch."""
    try:
        import torch  # noqa: PLC0415  # only the extra [twin] brings it
    except ImportError as error:
        purpose = "a foundation model"
        raise MissingDependencyError(package="torch", extra="twin", purpose=purpose) from error
    return torch


def network_input(
    images_u8: Sequence[UInt8[np.ndarray, "_ _ 3"]],
    size: tuple[int, int],
    normalisation: Normalisation,
    *,
    mode: str = "bilinear",
) -> Any:
    """Stretch images to one size and normalise them, as one float32 tensor (n, 3, height, width).

    Args:
        mode: ``bilinear`` or ``bicubic``; both low-pass when they shrink.
    """
    torch = import_torch()
    rows = []
    for image in images_u8:
        pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None].float()
        if tuple(pixels.shape[2:]) != size:
            pixels = torch.nn.functional.interpolate(
                pixels, size=size, mode=mode, align_corners=False, antialias=True
            ).clamp(0.0, 255.0)
        rows.append(pixels)
    mean, deviation = (torch.tensor(each).view(1, 3, 1, 1) for each in normalisation)
    return (torch.cat(rows) / 255.0 - mean) / deviation


MAX_PROMPT_CHARACTERS = 200


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Where a network runs."""

    device: str = "auto"
    """auto: the first CUDA device, or the CPU where there is none."""

    def resolve(self) -> Any:
        """Return torch's device."""
        torch = import_torch()
        wanted = self.device
        if wanted == "auto":
            wanted = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            device = torch.device(wanted)
        except RuntimeError as error:
            message = f"device {wanted!r} is unknown; write auto, cpu, cuda or cuda:1."
            raise UsageError(message) from error
        if device.type == "cuda" and not torch.cuda.is_available():
            message = f"device {wanted!r} was asked for, but torch finds no CUDA device here."
            raise UsageError(message)
        return device


def import_transformers() -> Any:
    """Import transformers, with its way to the network closed."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # read once, when the library is imported
    os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")
    import_torch()
    for package in ("safetensors", "transformers"):
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise MissingDependencyError(
                package=package, extra="foundation", purpose="a foundation model"
            ) from error
    transformers = importlib.import_module("transformers")
    transformers.utils.logging.disable_progress_bar()
    return transformers


def load_model(folder: Path, kind: WeightsKind, class_name: str, placement: Placement) -> Any:
    """Load a network and put it to inference on its device.

    Raises:
        WeightsError: When the folder is not whole, or leaves parameters of the network without
            values.
    """
    check_folder(folder, kind)
    device = placement.resolve()
    transformers = import_transformers()
    model_class = getattr(transformers, class_name, None)
    if model_class is None:
        package = f"a transformers with {class_name} (found {transformers.__version__})"
        purpose = kind.name
        raise MissingDependencyError(package=package, extra="foundation", purpose=purpose)
    try:
        model, report = model_class.from_pretrained(
            folder,
            local_files_only=True,
            use_safetensors=True,
            trust_remote_code=False,
            dtype=import_torch().float32,
            output_loading_info=True,
        )
    except _load_errors() as error:
        found = f"transformers cannot load it ({type(error).__name__}: {str(error)[:200]})"
        raise WeightsError(folder=folder, found=found, kind=kind) from error
    empty = sorted(str(name) for name in report["missing_keys"])
    if empty:
        found = f"{len(empty)} parameters have no values, among them {empty[0]}"
        raise WeightsError(folder=folder, found=found, kind=kind)
    return model.to(device).eval()


def _load_errors() -> tuple[type[Exception], ...]:
    """What transformers raises for files, or a configuration, that it cannot read."""
    strict = importlib.import_module("huggingface_hub.errors")  # transformers depends on it
    return (strict.StrictDataclassError, OSError, ValueError, RuntimeError, TypeError, KeyError)


class Tokenizer:
    """Words to numbers, by the tokenizer that lies beside the weights."""

    def __init__(self, folder: Path, kind: WeightsKind, max_tokens: int) -> None:
        """Load it from the folder alone."""
        self._max_tokens = max_tokens
        self._kind = kind
        transformers = import_transformers()
        try:
            self._tokenizer = transformers.AutoTokenizer.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False
            )
        except (OSError, ValueError, RuntimeError, TypeError, KeyError, ImportError) as error:
            found = f"its tokenizer cannot be read ({type(error).__name__}: {str(error)[:200]})"
            raise WeightsError(folder=folder, found=found, kind=kind) from error

    def __call__(self, texts: Sequence[str]) -> tuple[Any, Any]:
        """Turn texts into token ids and their mask, both (n, max_tokens).

        Raises:
            UsageError: For an empty text, or one that is too long for the network; it is never cut.
        """
        for text in texts:
            if not text.strip() or len(text) > MAX_PROMPT_CHARACTERS or not text.isprintable():
                message = f"{text[:40]!r} is no prompt; write a few words, such as 'red cube'."
                raise UsageError(message)
        lengths = [len(ids) for ids in self._tokenizer(list(texts))["input_ids"]]
        for text, length in zip(texts, lengths, strict=True):
            if length > self._max_tokens:
                message = (
                    f"prompt {text[:40]!r} has {length} tokens, {self._kind.name} reads "
                    f"{self._max_tokens}. Use fewer words."
                )
                raise UsageError(message)
        tokens = self._tokenizer(
            list(texts), padding="max_length", max_length=self._max_tokens, return_tensors="pt"
        )
        return tokens["input_ids"], tokens["attention_mask"]
