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
from evaluator.compare.images.scores import open_net
from evaluator.metrics import lpips_torch
from evaluator.metrics.image import LPIPS, score_pair
from evaluator.metrics.lpips_torch import LpipsNet, LpipsWeightsError, read_heads


@pytest.fixture(scope="session")
def golden(load_golden_script: Any) -> ModuleType:
    return load_golden_script("make_lpips_reference")


@pytest.fixture(scope="session")
def state(golden: ModuleType) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(w) for name, w in golden.backbone().items()}


@pytest.fixture(scope="session")
def backbone(state: dict[str, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state dict with drawn weights, as torch.save makes it."""
    path = tmp_path_factory.mktemp("backbones") / "vgg16.pth"
    torch.save(state | {"classifier.0.weight": torch.zeros(2, 2)}, path)  # is not looked at
    return path


@pytest.mark.slow
@pytest.mark.golden
def test_distances_are_those_of_the_lpips_package(golden: ModuleType, backbone: Path) -> None:
    recorded = json.loads(golden.PATH.read_text())
    net = open_net(backbone)
    assert net is not None
    assert len(recorded["cases"]) == 2
    for case in recorded["cases"]:
        found = net.distance(*golden.images(case["seed"]))
        # Both compute in float32; the order of sums is the libraries'.
        assert found == pytest.approx(case["value"], rel=2e-5), case


def test_no_difference_is_zero_and_safetensors_are_the_same_weights(
    golden: ModuleType, state: dict[str, torch.Tensor], backbone: Path, tmp_path: Path
) -> None:
    from safetensors.torch import save_file

    save_file(state, tmp_path / "vgg16.safetensors")
    net, same = LpipsNet(backbone), LpipsNet(tmp_path / "vgg16.safetensors")
    image, other = golden.images(0)
    assert net.distance(image, other) > 1e-4
    assert net.distance(image, other) == same.distance(image, other)
    assert net.distance(image, image) == 0.0


def test_the_stamp_says_whose_weights_they_are(
    backbone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hashlib import sha256

    net = LpipsNet(backbone)
    digest = sha256(backbone.read_bytes()).hexdigest()
    assert digest[:16] in net.weights
    assert "not torchvision's published file" in net.weights
    assert "heads of" in net.weights
    monkeypatch.setattr(lpips_torch, "PUBLISHED", digest[:8])
    assert "(torchvision's published file)" in LpipsNet(backbone).weights


@pytest.mark.slow
def test_learned_distances_are_of_whole_images_that_are_large_enough(
    golden: ModuleType, backbone: Path
) -> None:
    net = open_net(backbone)
    image, other = golden.images(0)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[10:40, 10:60] = True
    scores = score_pair(image, other, masks={"cup": mask}, net=net)
    assert {name for name, score in scores.items() if LPIPS in score.values} == {"raw"}
    small = score_pair(image[:15], other[:15], net=net)["raw"]
    assert "16 pixels" in small.reasons[LPIPS]
    assert np.isfinite(score_pair(image[:16, :16], other[:16, :16], net=net)["raw"].values[LPIPS])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda state: state.pop("features.7.bias"), "no tensor features.7.bias"),
        (
            lambda state: state.update({"features.0.weight": torch.zeros(64, 3, 11, 11)}),
            r"features.0.weight is \(64, 3, 11, 11\), not \(64, 3, 3, 3\)",
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
    state: dict[str, torch.Tensor], tmp_path: Path, change: Any, words: str
) -> None:
    broken = {name: w for name, w in state.items() if int(name.split(".")[1]) < 10}
    change(broken)
    torch.save(broken, tmp_path / "vgg.pth")
    with pytest.raises(LpipsWeightsError, match=words):
        LpipsNet(tmp_path / "vgg.pth")


@pytest.mark.parametrize("name", ["x.pth", "x.safetensors"])
def test_what_is_no_state_dict_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with pytest.raises(LpipsWeightsError, match="no such file"):
        LpipsNet(path)
    for content in (b"", b"not weights", b"\x80\x04}\x94."):
        path.write_bytes(content)
        with pytest.raises(LpipsWeightsError, match="state dict of torchvision's VGG16"):
            LpipsNet(path)
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(LpipsWeightsError, match="it holds a list"):
        LpipsNet(tmp_path / "list.pth")


def run_code() -> Any:
    """Stands for what a pickle could do."""
    return sys.exit("the pickle ran")


def test_a_file_that_would_run_code_is_refused(tmp_path: Path) -> None:
    torch.save({"features.0.weight": run_code}, tmp_path / "evil.pth")
    with pytest.raises(LpipsWeightsError, match="more than tensors"):
        LpipsNet(tmp_path / "evil.pth")


def test_without_heads_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips_torch, "HEADS", ("no_such_package", "weights"))
    with pytest.raises(MissingDependencyError, match=r"robot-gst\[lpips\]"):
        read_heads()
