"""Depth Anything from folders that hold tiny networks with random weights."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from model_inputs import CPU, picture

from bridge.errors import UsageError
from twin.scene.foundation.loading import WeightsError
from twin.scene.foundation.models import DEPTH_MODELS, DepthAnything, split_spec
from twin.scene.foundation.stage import check_models
from twin.scene.settings import ModelConfig

pytest.importorskip("transformers", reason="the extra [foundation] is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("without_network")]


@pytest.mark.parametrize(
    ("name", "is_metric"), [("depth_anything", False), ("metric_depth_anything", True)]
)
def test_an_image_gets_a_depth_for_every_pixel_the_same_each_time(
    saved: Callable[[str], Path], name: str, is_metric: bool
) -> None:
    network = DepthAnything.load(saved(name), CPU)
    assert network.is_metric is is_metric
    found = network.predict(picture(48, 80), (24, 40))
    assert found.shape == (24, 40)
    assert found.dtype == np.float32
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    if is_metric:
        assert 0.0 < found.max() < 20.0  # a sigmoid times the configuration's max_depth
    np.testing.assert_array_equal(found, network.predict(picture(48, 80), (24, 40)))
    assert not np.array_equal(found, network.predict(picture(48, 80, seed=1), (24, 40)))


def test_what_comes_out_is_what_the_network_says_for_the_normalised_image(
    saved: Callable[[str], Path],
) -> None:
    import torch
    import transformers

    image = picture(56, 84)  # whole cells, and one side as trained: nothing is resized
    found = DepthAnything.load(saved("depth_anything"), CPU).predict(image, (56, 84))
    network = transformers.DepthAnythingForDepthEstimation.from_pretrained(
        saved("depth_anything")
    ).eval()
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    pixels = np.moveaxis((image / 255.0 - mean) / deviation, -1, 0)[None].astype(np.float32)
    with torch.no_grad():
        wanted = network(pixel_values=torch.from_numpy(pixels)).predicted_depth[0].numpy()
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_an_image_is_resized_as_the_makers_processor_does(saved: Callable[[str], Path]) -> None:
    from transformers.models.dpt import image_processing_pil_dpt as makers

    network = DepthAnything.load(saved("depth_anything"), CPU)
    for height, width in ((480, 640), (720, 1280), (1080, 1920), (48, 64), (56, 56), (300, 40)):
        wanted = makers.get_resize_output_image_size(
            np.zeros((3, height, width), dtype=np.uint8),
            output_size=(56, 56),
            keep_aspect_ratio=True,
            multiple=14,
        )
        size = (wanted.height, wanted.width) if hasattr(wanted, "height") else tuple(wanted)
        assert network.network_size(height, width) == size


def copy_of(folder: Path, place: Path) -> Path:
    place.mkdir()
    for path in folder.iterdir():
        (place / path.name).write_bytes(path.read_bytes())
    return place


def test_other_models_pickles_and_backbones_to_fetch_are_refused_before_anything_slow(
    saved: Callable[[str], Path], tmp_path: Path
) -> None:
    def check(folder: Path) -> None:
        check_models(ModelConfig(depth_model=f"depth-anything:{folder}", device="cpu"), None)

    check(saved("depth_anything"))
    with pytest.raises(UsageError, match="write depth-anything:FOLDER"):
        split_spec("midas:folder", "--depth-model", DEPTH_MODELS)
    with pytest.raises(WeightsError, match="no such folder"):
        check(tmp_path / "nothing")
    with pytest.raises(WeightsError, match="type 'clip', not 'depth_anything'"):
        check(saved("clip"))
    pickled = copy_of(saved("depth_anything"), tmp_path / "pickled")
    (pickled / "model.safetensors").rename(pickled / "pytorch_model.bin")
    with pytest.raises(WeightsError, match="can run code when opened"):
        check(pickled)
    for name, change, found in (
        ("swin", {"backbone_config": {"model_type": "swin"}}, "backbone of type 'swin'"),
        ("none", {"backbone_config": None}, "backbone of type None"),
        ("named", {"backbone": "makers/dinov2"}, "names a backbone to fetch"),
    ):
        folder = copy_of(saved("depth_anything"), tmp_path / name)
        config = json.loads((folder / "config.json").read_text()) | change
        (folder / "config.json").write_text(json.dumps(config))
        with pytest.raises(WeightsError, match=found):
            check(folder)


def test_a_kind_of_depth_that_nobody_knows_is_refused(
    saved: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = copy_of(saved("depth_anything"), tmp_path / "odd")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"depth_estimation_type": "odd"}))
    with pytest.raises(WeightsError, match="transformers cannot load it"):
        DepthAnything.load(folder, CPU)
