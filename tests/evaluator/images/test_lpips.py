"""LPIPS: the numbers of the ``lpips`` package with drawn backbones, and weights that are wrong."""

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from bridge.errors import MissingDependencyError
from evaluator.compare.images.scores import open_nets
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics import lpips_torch
from evaluator.metrics.image import score_pair
from evaluator.metrics.lpips_torch import LpipsNet, LpipsWeightsError, read_heads

INPUTS = {("vgg", "01"), ("alex", "pm1")}
"""How each backbone is fed."""


@pytest.fixture(scope="session")
def golden(load_golden_script: Any) -> ModuleType:
    return load_golden_script("make_lpips_reference")


@pytest.fixture(scope="session")
def backbones(golden: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """State dicts with drawn weights: VGG as torch.save makes them, AlexNet as safetensors."""
    from safetensors.torch import save_file

    folder = tmp_path_factory.mktemp("backbones")
    states = {
        net: {name: torch.from_numpy(w) for name, w in golden.backbone(net).items()}
        for net in ("vgg", "alex")
    }
    states["vgg"]["classifier.0.weight"] = torch.zeros(2, 2)  # is not looked at
    torch.save(states["vgg"], folder / "vgg16.pth")
    save_file(states["alex"], folder / "alexnet.safetensors")
    return {"vgg": folder / "vgg16.pth", "alex": folder / "alexnet.safetensors"}


@pytest.mark.slow
@pytest.mark.golden
def test_distances_are_those_of_the_lpips_package(
    golden: ModuleType, backbones: dict[str, Path]
) -> None:
    recorded = json.loads(golden.PATH.read_text())
    nets = {net.name: net for net in open_nets(backbones)}
    cases = [c for c in recorded["cases"] if (c["net"], c["input"]) in INPUTS]
    assert len(cases) >= 4
    for case in cases:
        found = nets[case["net"]].distance(*golden.images(case["seed"]))
        # Both compute in float32; the order of sums is the libraries'.
        assert found == pytest.approx(case["value"], rel=2e-5), case


def test_no_difference_is_zero(golden: ModuleType, backbones: dict[str, Path]) -> None:
    net = LpipsNet("alex", backbones["alex"])
    image, other = golden.images(0)
    assert net.distance(image, other) > 1e-4
    assert net.distance(image, image) == 0.0


def test_the_stamp_says_whose_weights_they_are(backbones: dict[str, Path]) -> None:
    from hashlib import sha256

    net = LpipsNet("alex", backbones["alex"])
    digest = sha256(backbones["alex"].read_bytes()).hexdigest()
    assert digest[:16] in net.weights
    assert "not torchvision's published file" in net.weights
    assert "heads of" in net.weights


def test_the_stamp_says_that_the_published_file_is_used(
    backbones: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    from hashlib import sha256

    digest = sha256(backbones["alex"].read_bytes()).hexdigest()
    monkeypatch.setitem(lpips_torch.PUBLISHED, "alex", digest[:8])
    assert "(torchvision's published file)" in LpipsNet("alex", backbones["alex"]).weights


def test_too_small_images_have_no_distance(backbones: dict[str, Path]) -> None:
    net = LpipsNet("alex", backbones["alex"])
    with pytest.raises(UndefinedStatisticError, match="32 pixels"):
        net.distance(np.zeros((31, 80, 3)), np.ones((31, 80, 3)))
    assert np.isfinite(net.distance(np.zeros((32, 32, 3)), np.ones((32, 32, 3))))


@pytest.mark.slow
def test_learned_distances_are_left_out_of_single_pixels(
    golden: ModuleType, backbones: dict[str, Path]
) -> None:
    nets = open_nets({"alex": backbones["alex"]})
    image, other = golden.images(0)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[10:40, 10:60] = True
    scores = score_pair(image, other, masks={"cup": mask}, nets=nets)
    with_lpips = {name for name, score in scores.items() if "lpips_alex_pm1" in score.values}
    assert with_lpips == {"raw"}
    small = score_pair(image[:31], other[:31], nets=nets)["raw"]
    assert "32 pixels" in small.reasons["lpips_alex_pm1"]


def test_another_network_s_weights_are_refused(backbones: dict[str, Path]) -> None:
    with pytest.raises(
        LpipsWeightsError, match=r"features.0.weight is \(64, 3, 11, 11\), not \(64, 3, 3, 3\)"
    ):
        LpipsNet("vgg", backbones["alex"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda state: state.pop("features.8.bias"), "no tensor features.8.bias"),
        (
            lambda state: state.update({"features.3.bias": torch.zeros(191)}),
            r"\(191,\), not \(192,\)",
        ),
        (
            lambda state: state.update({"features.0.bias": torch.full((64,), torch.nan)}),
            "not finite",
        ),
        (
            lambda state: state.update({"features.0.bias": torch.zeros(64, dtype=torch.int64)}),
            "no floats",
        ),
    ],
)
def test_broken_weights_are_refused_by_name(
    golden: ModuleType, tmp_path: Path, change: Any, words: str
) -> None:
    state = {name: torch.from_numpy(w) for name, w in golden.backbone("alex").items()}
    change(state)
    torch.save(state, tmp_path / "alex.pth")
    with pytest.raises(LpipsWeightsError, match=words):
        LpipsNet("alex", tmp_path / "alex.pth")


@pytest.mark.parametrize("name", ["x.pth", "x.safetensors"])
def test_what_is_no_state_dict_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with pytest.raises(LpipsWeightsError, match="no such file"):
        LpipsNet("alex", path)
    for content in (b"", b"not weights", b"\x80\x04}\x94."):
        path.write_bytes(content)
        with pytest.raises(LpipsWeightsError, match="state dict of torchvision's AlexNet"):
            LpipsNet("alex", path)
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(LpipsWeightsError, match="it holds a list"):
        LpipsNet("alex", tmp_path / "list.pth")


def run_code() -> Any:
    """Stands for what a pickle could do."""
    return sys.exit("the pickle ran")


def test_a_file_that_would_run_code_is_refused(tmp_path: Path) -> None:
    torch.save({"features.0.weight": run_code}, tmp_path / "evil.pth")
    with pytest.raises(LpipsWeightsError, match="more than tensors"):
        LpipsNet("alex", tmp_path / "evil.pth")


def test_without_heads_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips_torch, "HEADS", ("no_such_package", "weights"))
    with pytest.raises(MissingDependencyError, match=r"robot-gst\[lpips\]"):
        read_heads("vgg")
