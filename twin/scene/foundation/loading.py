"""Load networks through ``transformers``: from a local folder, no network access, no foreign code.

Only ``safetensors`` are accepted: the other formats are pickles, which run code when opened. Images
are resized and normalised in torch, without torchvision.
"""

import importlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from bridge.episode import provenance
from bridge.errors import MissingDependencyError, UsageError
from twin.scene.raster.backend import import_torch

PURPOSE = "a foundation model"
MAX_JSON_BYTES = 64_000_000
MAX_PROMPT_CHARACTERS = 200
SINGLE, INDEX = "model.safetensors", "model.safetensors.index.json"
_PICKLED = (".bin", ".pt", ".pth", ".ckpt", ".pkl", ".pickle", ".h5", ".msgpack")
_TOKENIZERS = (("tokenizer.json",), ("vocab.json", "merges.txt"))

Normalisation = tuple[tuple[float, ...], tuple[float, ...]]
"""Mean and standard deviation of red, green, blue, for colours 0..1."""


class WeightsError(UsageError):
    """A folder of weights cannot be used."""


@dataclass(frozen=True, kw_only=True)
class WeightsKind:
    """One family of models that take words and images, and what a folder of its weights holds."""

    name: str
    model_types: tuple[str, ...]
    """Values of ``model_type`` in ``config.json`` that the adapter reads."""
    class_name: str
    """In ``transformers``."""
    colours: Normalisation
    """Where the folder states none."""
    origin: str
    """Name under which its makers publish it."""
    licence: str

    def refuse(self, folder: Path, found: str) -> WeightsError:
        """What is wrong with a folder, and what is needed instead."""
        return WeightsError(
            f"{folder}: {found}. Weights of {self.name} are a folder with config.json, {SINGLE} "
            f"(or {INDEX} and its parts) and tokenizer.json, got by hand ({self.origin}; licence: "
            f"{self.licence}); docs/foundation_models.md says how."
        )


def check_folder(folder: Path, kind: WeightsKind) -> str:
    """Look whether a folder holds whole weights of one kind; load none of them.

    Returns:
        SHA-256 over configuration and weights, for the record of what was used.

    Raises:
        WeightsError: Naming what is missing, cut short, changed, pickled or of another kind.
    """
    if not folder.is_dir():
        raise kind.refuse(folder, "no such folder")
    found = _json(folder / "config.json", kind).get("model_type")
    if found not in kind.model_types:
        told = f"config.json describes a model of type {found!r}, not {kind.model_types[0]!r}"
        raise kind.refuse(folder, told)
    files = weight_files(folder, kind)
    library = _package("safetensors")
    for path in files:
        try:  # the format's own library compares header and size; no numbers are loaded
            with library.safe_open(path, framework="numpy"):
                continue
        except library.SafetensorError as error:
            told = (
                f"{path.name} ({path.stat().st_size} bytes) is no safetensors file, cut short, or "
                f"a git-lfs pointer instead of the weights ({error})"
            )
            raise kind.refuse(folder, told) from error
    if not any(all((folder / name).is_file() for name in names) for names in _TOKENIZERS):
        raise kind.refuse(folder, "there is no tokenizer.json")
    return provenance.hash_files([folder / "config.json", *files])


def weight_files(folder: Path, kind: WeightsKind) -> list[Path]:
    """The safetensors of a folder, all of them present."""
    there, named = {path.name for path in folder.iterdir()}, [SINGLE]
    if SINGLE not in there and INDEX in there:
        parts = _json(folder / INDEX, kind).get("weight_map")
        if not isinstance(parts, dict) or not parts:
            raise kind.refuse(folder, f"{INDEX} names no parts")
        named = sorted({str(name) for name in parts.values()})
    wanted = [name for name in named if name not in there or not name.endswith(".safetensors")]
    if wanted:
        pickled = sorted(name for name in there if Path(name).suffix in _PICKLED)
        only = [f"; {name}, which can run code when opened, is refused" for name in pickled]
        told = f"{len(wanted)} of {len(named)} safetensors files are missing, first {wanted[0]!r}"
        raise kind.refuse(folder, f"{told}{''.join(only[:1])}")
    return [folder / name for name in named]


def _json(path: Path, kind: WeightsKind) -> dict[str, Any]:
    if not path.is_file():
        raise kind.refuse(path.parent, f"there is no {path.name}")
    if path.stat().st_size > MAX_JSON_BYTES:
        raise kind.refuse(path.parent, f"{path.name} is too large")
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise kind.refuse(path.parent, f"{path.name} is not JSON") from error
    if not isinstance(content, dict):
        raise kind.refuse(path.parent, f"{path.name} is not an object")
    return content


def read_normalisation(folder: Path, kind: WeightsKind) -> Normalisation:
    """Mean and standard deviation of colours, from ``preprocessor_config.json`` if present."""
    path = folder / "preprocessor_config.json"
    if not path.is_file():
        return kind.colours
    content, values = _json(path, kind), []
    for name, standard in zip(("image_mean", "image_std"), kind.colours, strict=True):
        given = content.get(name, list(standard))
        is_three = isinstance(given, list) and len(given) == 3
        is_numbers = is_three and all(isinstance(v, int | float) and 0 <= v < 10 for v in given)
        if not is_numbers or (name == "image_std" and 0 in given):
            raise kind.refuse(folder, f"{path.name}: {name} is {given!r}")
        values.append(tuple(float(v) for v in given))
    return values[0], values[1]


def _package(name: str) -> Any:
    """One of the packages of the extra."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependencyError(package=name, extra="foundation", purpose=PURPOSE) from error


def import_transformers() -> Any:
    """Import transformers, with its way to the network closed."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # read once, when the library is imported
    os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")
    import_torch(PURPOSE)
    _package("safetensors")
    transformers = _package("transformers")
    transformers.utils.logging.disable_progress_bar()
    return transformers


def device_of(wanted: str) -> Any:
    """Torch's device; ``auto`` is the first CUDA device, or the CPU where there is none."""
    torch = import_torch(PURPOSE)
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


class Network:
    """A network of words and images with its tokenizer, loaded and on its device."""

    kind: WeightsKind

    def __init__(self, folder: Path, device: str = "auto") -> None:
        """Load it from a folder alone.

        Raises:
            WeightsError: When the folder is not whole, or leaves parameters without values.
        """
        self.hash = check_folder(folder, self.kind)
        self._device = device_of(device)
        transformers = import_transformers()
        self._model = self._loaded(transformers, folder).to(self._device).eval()
        self._normalisation = read_normalisation(folder, self.kind)
        self._max_tokens = int(self._model.config.text_config.max_position_embeddings)
        try:
            self._tokenizer = transformers.AutoTokenizer.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False
            )
        except (OSError, ValueError, RuntimeError, TypeError, KeyError, ImportError) as error:
            told = f"its tokenizer cannot be read ({type(error).__name__}: {str(error)[:200]})"
            raise self.kind.refuse(folder, told) from error

    def _loaded(self, transformers: Any, folder: Path) -> Any:
        kind, version = self.kind, transformers.__version__
        model_class = getattr(transformers, kind.class_name, None)
        if model_class is None:
            package = f"a transformers with {kind.class_name} (found {version})"
            raise MissingDependencyError(package=package, extra="foundation", purpose=kind.name)
        strict = importlib.import_module("huggingface_hub.errors").StrictDataclassError
        try:
            model, report = model_class.from_pretrained(
                folder,
                local_files_only=True,
                use_safetensors=True,
                trust_remote_code=False,
                dtype=import_torch().float32,
                output_loading_info=True,
            )
        except (strict, OSError, ValueError, RuntimeError, TypeError, KeyError) as error:
            told = f"transformers cannot load it ({type(error).__name__}: {str(error)[:200]})"
            raise self.kind.refuse(folder, told) from error
        empty = sorted(str(name) for name in report["missing_keys"])
        if empty:
            told = f"{len(empty)} parameters have no values, among them {empty[0]}"
            raise self.kind.refuse(folder, told)
        return model

    def _tokens(self, texts: Sequence[str]) -> tuple[Any, Any]:
        """Token ids and their mask, both (n, max_tokens); a text is refused, never cut."""
        for text in texts:
            if not text.strip() or len(text) > MAX_PROMPT_CHARACTERS or not text.isprintable():
                message = f"{text[:40]!r} is no prompt; write a few words, such as 'red cube'."
                raise UsageError(message)
            length = len(self._tokenizer([text])["input_ids"][0])
            if length > self._max_tokens:
                message = (
                    f"prompt {text[:40]!r} has {length} tokens, {self.kind.name} reads "
                    f"{self._max_tokens}. Use fewer words."
                )
                raise UsageError(message)
        tokens = self._tokenizer(
            list(texts), padding="max_length", max_length=self._max_tokens, return_tensors="pt"
        )
        ids, mask = tokens["input_ids"], tokens["attention_mask"]
        return ids.to(self._device), mask.to(self._device)

    def _pixels(
        self,
        images_u8: Sequence[UInt8[np.ndarray, "_ _ 3"]],
        size: tuple[int, int],
        mode: str = "bilinear",
    ) -> Any:
        """Stretch images to one size and normalise them, as one tensor (n, 3, height, width)."""
        torch = import_torch()
        rows = []
        for image in images_u8:
            pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None].float()
            if tuple(pixels.shape[2:]) != size:
                pixels = torch.nn.functional.interpolate(
                    pixels, size=size, mode=mode, align_corners=False, antialias=True
                ).clamp(0.0, 255.0)
            rows.append(pixels)
        mean, deviation = (torch.tensor(each).view(1, 3, 1, 1) for each in self._normalisation)
        return ((torch.cat(rows) / 255.0 - mean) / deviation).to(self._device)
