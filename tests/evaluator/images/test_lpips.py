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
from evaluator.compare.images.scores import open_nets, score_variants
from evaluator.metrics import lpips_torch
from evaluator.metrics.lpips import metric_id
from evaluator.metrics.lpips_torch import LAYERS, LpipsNet, LpipsWeightsError, read_heads


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
    for case in recorded["cases"]:
        pair = golden.images(case["seed"])
        values = nets[case["net"]].distances(*pair).values
        found = values[metric_id(case["net"], case["input"])]
        # Both compute in float32; the order of sums is the libraries'.
        assert found == pytest.approx(case["value"], rel=2e-5), case


def test_both_ranges_of_input_are_two_numbers_and_no_difference_is_zero(
    golden: ModuleType, backbones: dict[str, Path]
) -> None:
    net = LpipsNet.open("alex", backbones["alex"])
    image, other = golden.images(0)
    values = net.distances(image, other).values
    assert values["lpips_alex_01"] != pytest.approx(values["lpips_alex_pm1"], rel=0.01)
    assert set(net.distances(image, image).values.values()) == {0.0}


def test_the_stamp_says_whose_weights_they_are(backbones: dict[str, Path]) -> None:
    from hashlib import sha256

    net = LpipsNet.open("alex", backbones["alex"])
    digest = sha256(backbones["alex"].read_bytes()).hexdigest()
    assert digest[:16] in net.weights
    assert "not torchvision's published file" in net.weights
    assert "heads of" in net.weights
    assert "torchvision's published file" in lpips_torch.describe_weights(
        "vgg", lpips_torch.PUBLISHED["vgg"] + "0" * 56, "x"
    )


def test_too_small_images_have_no_distance(backbones: dict[str, Path]) -> None:
    net = LpipsNet.open("alex", backbones["alex"])
    found = net.distances(np.zeros((31, 80, 3)), np.ones((31, 80, 3)))
    assert not found.values
    assert "32 pixels" in found.reasons["lpips_alex_01"]
    assert np.isfinite(
        list(net.distances(np.zeros((32, 32, 3)), np.ones((32, 32, 3))).values.values())
    ).all()


@pytest.mark.slow
def test_learned_distances_are_left_out_of_single_pixels(
    golden: ModuleType, backbones: dict[str, Path]
) -> None:
    nets = open_nets({"alex": backbones["alex"]})
    image, other = golden.images(0)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[10:40, 10:60] = True
    scores = {
        v.name: s.values for v, s in score_variants(image, other, {"cup": mask}, nets=nets).items()
    }
    with_lpips = {name for name, values in scores.items() if "lpips_alex_01" in values}
    assert with_lpips == {"raw", "gain"}


def test_another_network_s_weights_are_refused(backbones: dict[str, Path]) -> None:
    with pytest.raises(
        LpipsWeightsError, match=r"features.0.weight is \(64, 3, 11, 11\), not \(64, 3, 3, 3\)"
    ):
        LpipsNet.open("vgg", backbones["alex"])


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
        LpipsNet.open("alex", tmp_path / "alex.pth")


@pytest.mark.parametrize("name", ["x.pth", "x.safetensors"])
def test_what_is_no_state_dict_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with pytest.raises(LpipsWeightsError, match="no such file"):
        LpipsNet.open("alex", path)
    for content in (b"", b"not weights", b"\x80\x04}\x94."):
        path.write_bytes(content)
        with pytest.raises(LpipsWeightsError, match="state dict of torchvision's AlexNet"):
            LpipsNet.open("alex", path)
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(LpipsWeightsError, match="it holds a list"):
        LpipsNet.open("alex", tmp_path / "list.pth")


def run_code() -> Any:
    """Stands for what a pickle could do."""
    return sys.exit("the pickle ran")


def test_a_file_that_would_run_code_is_refused(tmp_path: Path) -> None:
    torch.save({"features.0.weight": run_code}, tmp_path / "evil.pth")
    with pytest.raises(LpipsWeightsError, match="more than tensors"):
        LpipsNet.open("alex", tmp_path / "evil.pth")


def test_without_heads_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips_torch, "HEADS", (("no_such_package", "weights"),))
    with pytest.raises(MissingDependencyError, match=r"robot-gst\[lpips\]"):
        read_heads("vgg")


def test_heads_come_out_of_an_lpips_wheel_without_importing_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "lpips" / "weights" / "v0.1"
    folder.mkdir(parents=True)
    (tmp_path / "lpips" / "__init__.py").write_text("raise RuntimeError('imported')")
    taps = [layer.channels_out for layer in LAYERS["vgg"] if layer.tap]
    state = {f"lin{k}.model.1.weight": torch.full((1, c, 1, 1), 0.5) for k, c in enumerate(taps)}
    torch.save(state, folder / "vgg.pth")
    monkeypatch.syspath_prepend(str(tmp_path))
    heads, origin = read_heads("vgg")
    assert [tuple(head.shape) for head in heads] == [(c, 1, 1) for c in taps]
    assert origin.startswith("lpips of unknown version")
    assert "lpips" not in sys.modules
