"""Load models through ``transformers``: from a local folder, no network, no code of the folder."""

import importlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.errors import MissingDependencyError, UsageError
from twin.scene.foundation.images import import_torch
from twin.scene.foundation.weights import WeightsError, WeightsKind, check_folder

DTYPES = ("float32", "bfloat16", "float16")
MAX_PROMPT_CHARACTERS = 200


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Where and how precisely a network runs."""

    device: str = "auto"
    """auto: the first CUDA device, or the CPU where there is none."""
    dtype: str = "float32"
    """float32, bfloat16 or float16; results are float32 in any case."""

    def resolve(self) -> tuple[Any, Any]:
        """Return torch's device and number type.

        Raises:
            UsageError: For a device or type that is not there.
        """
        torch = import_torch()
        if self.dtype not in DTYPES:
            message = f"number type {self.dtype!r} is unknown; there are {', '.join(DTYPES)}."
            raise UsageError(message)
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
        return device, getattr(torch, self.dtype)


def import_transformers() -> Any:
    """Import transformers, with its way to the network closed.

    Raises:
        MissingDependencyError: It, or safetensors, is not installed.
    """
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

    Args:
        folder: Checked by ``check_folder`` first.
        kind: What the folder must hold.
        class_name: Name of the class of ``transformers``.
        placement: Device and number type.

    Raises:
        WeightsError: When the folder is not whole, or leaves parameters of the network without
            values.
        MissingDependencyError: When ``transformers`` is not installed or does not know the class.
    """
    check_folder(folder, kind)
    device, dtype = placement.resolve()
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
            dtype=dtype,
            output_loading_info=True,
        )
    except (OSError, ValueError, RuntimeError, TypeError, KeyError) as error:
        found = f"transformers cannot load it ({type(error).__name__}: {str(error)[:200]})"
        raise WeightsError(folder=folder, found=found, kind=kind) from error
    empty = sorted(str(name) for name in report["missing_keys"])
    if empty:
        found = f"{len(empty)} parameters have no values, among them {empty[0]}"
        raise WeightsError(folder=folder, found=found, kind=kind)
    return model.to(device).eval()


class Tokenizer:
    """Words to numbers, by the tokenizer that lies beside the weights."""

    def __init__(self, folder: Path, kind: WeightsKind, max_tokens: int) -> None:
        """Load it from the folder alone.

        Raises:
            WeightsError: When it cannot be read.
        """
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
