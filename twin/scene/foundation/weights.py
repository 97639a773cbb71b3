"""Check a folder of weights before anything of it is loaded.

Only ``safetensors`` are accepted: the other formats are pickles, which run code when opened.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.episode import provenance
from bridge.errors import UsageError

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

    Args:
        folder: Folder with the files named by ``WeightsKind.wanted``.
        kind: What they must be.

    Returns:
        The content of ``config.json``.

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
    if kind.speaks and not _has_tokenizer(folder):
        raise WeightsError(folder=folder, found="there is no tokenizer.json", kind=kind)
    _check_sums(folder, kind)
    return config


def weight_files(folder: Path, kind: WeightsKind) -> list[Path]:
    """The safetensors of a folder, all of them present.

    Raises:
        WeightsError: When there are none, or some of a set of parts are missing.
    """
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


def _has_tokenizer(folder: Path) -> bool:
    pair = all((folder / name).is_file() for name in ("vocab.json", "merges.txt"))
    return (folder / "tokenizer.json").is_file() or pair


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
            promised = 8 + length + _end_of_tensors(header)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            found = f"the header of {path.name} is broken"
            raise WeightsError(folder=folder, found=found, kind=kind) from error
    if promised != size:
        found = f"{path.name} has {size} bytes where its header promises {promised}"
        raise WeightsError(folder=folder, found=found, kind=kind)


def _end_of_tensors(header: Mapping[str, Any]) -> int:
    ends = [int(item["data_offsets"][1]) for key, item in header.items() if key != "__metadata__"]
    return max(ends, default=0)


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

    Raises:
        WeightsError: When the file holds something else than three numbers each.
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
