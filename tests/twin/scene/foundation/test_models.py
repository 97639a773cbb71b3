"""SAM 3 and CLIP from folders that hold tiny networks with random weights."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bridge.errors import MissingDependencyError, UsageError
from twin.scene.foundation import loading
from twin.scene.foundation.loading import WeightsError, device_of
from twin.scene.foundation.models import ClipEmbedder, Sam3Segmenter, sam3_folder

pytest.importorskip("transformers", reason="the extra [foundation] is not installed")
pytestmark = [
    pytest.mark.slow,  # importing transformers takes seconds
    pytest.mark.usefixtures("without_network"),
]


def test_weights_of_another_model_or_without_some_numbers_are_refused(
    saved: Callable[[str], Path], tmp_path: Path
) -> None:
    from safetensors.torch import load_file, save_file

    with pytest.raises(WeightsError, match="type 'clip', not 'sam3'"):
        Sam3Segmenter(saved("clip"), "cpu")
    for path in saved("clip").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    tensors = load_file(tmp_path / "model.safetensors")
    lost = sorted(tensors)[3]
    del tensors[lost]
    save_file(tensors, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(WeightsError, match="parameters have no values"):
        ClipEmbedder(tmp_path, "cpu")


def test_code_in_a_folder_is_never_run(saved: Callable[[str], Path], tmp_path: Path) -> None:
    import json

    for path in saved("clip").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nraise SystemExit\n")
    for name in ("config.json", "tokenizer_config.json"):
        content = json.loads((tmp_path / name).read_text())
        content["auto_map"] = {"AutoModel": "evil.Model", "AutoTokenizer": ["evil.T", "evil.T"]}
        (tmp_path / name).write_text(json.dumps(content))
    with contextlib.suppress(WeightsError):  # refusing them is as good as ignoring the code
        ClipEmbedder(tmp_path, "cpu").encode(["duck"])
    assert not (tmp_path / "ran").exists()


def test_what_is_written_on_the_command_line_is_explained_when_it_is_wrong(tmp_path: Path) -> None:
    for spec in ("sam3", "sam3:", "sam2:folder", ""):
        with pytest.raises(UsageError, match="write sam3:FOLDER"):
            sam3_folder(spec)
    with pytest.raises(WeightsError, match="no such folder"):
        ClipEmbedder(tmp_path / "nothing")
    with pytest.raises(UsageError, match="device 'toaster'"):
        device_of("toaster")


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib

    real = importlib.import_module

    def missing(name: str, *rest: Any) -> Any:
        if name == "transformers":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(loading.importlib, "import_module", missing)
    with pytest.raises(MissingDependencyError, match=r"robot-gst\[foundation\]"):
        loading.import_transformers()
