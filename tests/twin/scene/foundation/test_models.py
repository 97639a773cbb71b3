"""SAM 3, DINOv3 and CLIP from folders that hold tiny networks with random weights.

What they see is meaningless; that everything goes in and comes out as agreed is not.
"""

import contextlib
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.errors import MissingDependencyError, UsageError
from twin.scene.foundation import loading
from twin.scene.foundation.clip import ClipEmbedder, masked_crop
from twin.scene.foundation.dinov3 import DinoFeatures
from twin.scene.foundation.loading import Placement
from twin.scene.foundation.open import open_clip, open_features, open_segmenter
from twin.scene.foundation.sam3 import Sam3Config, Sam3Segmenter
from twin.scene.foundation.weights import WeightsError

pytest.importorskip("transformers", reason="the extra [foundation] is not installed")
pytestmark = pytest.mark.slow  # importing transformers takes seconds

ALL_QUERIES = Sam3Config(min_score=0.0, min_pixels=0)
CPU = Placement(device="cpu")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Folders of weights, each made when it is first asked for."""
    import tiny_models

    made: dict[str, Path] = {}

    def folder(name: str) -> Path:
        if name not in made:
            made[name] = tmp_path_factory.mktemp(name)
            getattr(tiny_models, f"save_{name}")(made[name])
        return made[name]

    return folder


@pytest.fixture(autouse=True)
def without_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **settings: Any) -> None:
        raise AssertionError("a foundation model reached for the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


def picture(height: int = 60, width: int = 80, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, size=(6, 8, 3), dtype=np.uint8)
    return coarse[np.arange(height) * 6 // height][:, np.arange(width) * 8 // width]


def test_sam3_gives_masks_of_the_image_s_size_with_scores_from_0_to_1(
    saved: Callable[[str], Path],
) -> None:
    segmenter = open_segmenter(f"sam3:{saved('sam3')}", CPU, ALL_QUERIES)
    found = segmenter.segment(picture(), ["red cube", "duck"], camera_id="wrist", stamp_ns=7)
    assert (found.camera_id, found.stamp_ns, found.source) == ("wrist", 7, "SAM 3")
    assert len(found.masks) == 20  # ten queries each
    for mask in found.masks:
        assert mask.image.shape == (60, 80)
        assert mask.image.dtype == np.bool_
        assert 0.0 <= mask.score <= 1.0
    for label in ("red cube", "duck"):
        scores = [mask.score for mask in found.masks if mask.label == label]
        assert scores == sorted(scores, reverse=True)
    assert any(mask.image.any() and not mask.image.all() for mask in found.masks)


def test_sam3_says_the_same_twice_and_of_one_prompt_what_it_says_among_others(
    saved: Callable[[str], Path],
) -> None:
    segmenter = Sam3Segmenter.load(saved("sam3"), CPU, ALL_QUERIES)
    again = Sam3Segmenter.load(saved("sam3"), CPU, ALL_QUERIES)
    where = {"camera_id": "c", "stamp_ns": 0}
    both = segmenter.segment(picture(), ["red cube", "duck"], **where)
    twice = again.segment(picture(), ["red cube", "duck"], **where)
    alone = segmenter.segment(picture(), ["duck"], **where)
    pairs = [*zip(both.masks, twice.masks, strict=True)]
    pairs += zip(both.masks[10:], alone.masks, strict=True)
    for one, other in pairs:
        np.testing.assert_array_equal(one.image, other.image)
        assert one.score == pytest.approx(other.score, abs=1e-6)
    assert both.masks[0].score != pytest.approx(both.masks[10].score, abs=1e-9)  # words matter


def test_sam3_drops_what_is_unlikely_or_small(saved: Callable[[str], Path]) -> None:
    everything = Sam3Segmenter.load(saved("sam3"), CPU, ALL_QUERIES)
    where = {"camera_id": "c", "stamp_ns": 0}
    masks = everything.segment(picture(), ["duck"], **where).masks
    cut, least = masks[4].score, sorted(int(mask.image.sum()) for mask in masks)[5]
    likely = Sam3Segmenter.load(saved("sam3"), CPU, Sam3Config(min_score=cut, min_pixels=0))
    assert len(likely.segment(picture(), ["duck"], **where).masks) == 5
    large = Sam3Segmenter.load(saved("sam3"), CPU, Sam3Config(min_score=0.0, min_pixels=least))
    kept = large.segment(picture(), ["duck"], **where).masks
    assert 0 < len(kept) < 10
    assert min(int(mask.image.sum()) for mask in kept) >= least


@pytest.mark.parametrize(
    ("prompts", "said"),
    [
        ([], "0 prompts"),
        (["duck"] * 65, "65 prompts"),
        (["  "], "is no prompt"),
        (["duck\n"], "is no prompt"),
        (["a red cube a red cube a"], "has 9 tokens, SAM 3 reads 8"),
    ],
)
def test_sam3_refuses_prompts_it_cannot_read_whole(
    saved: Callable[[str], Path], prompts: list[str], said: str
) -> None:
    segmenter = Sam3Segmenter.load(saved("sam3"), CPU)
    with pytest.raises(UsageError, match=said):
        segmenter.segment(picture(), prompts, camera_id="c", stamp_ns=0)


@pytest.mark.parametrize(("name", "cell"), [("dino_vit", 16), ("dino_convnext", 32)])
def test_dino_maps_cover_the_image_and_a_batch_is_as_good_as_one_by_one(
    saved: Callable[[str], Path], name: str, cell: int
) -> None:
    source = open_features(f"dinov3:{saved(name)}", CPU)
    images = [picture(96, 128, seed) for seed in range(3)]
    maps = source.features(images)
    for image, found in zip(images, maps, strict=True):
        assert found.values.shape == (32, 96 // cell, 128 // cell)
        assert found.stride == cell
        (alone,) = source.features([image])
        np.testing.assert_allclose(alone.values, found.values, atol=1e-5)
    (finer,) = source.features(images[:1], stride=8)
    assert finer.values.shape == (32, 12, 16)
    (ragged,) = source.features([picture(97, 128)])  # the last row of cells reaches over the edge
    assert ragged.values.shape == (32, 96 // cell + 1, 128 // cell)
    assert source.features([]) == []


@pytest.mark.parametrize("name", ["dino_vit", "dino_convnext"])
def test_dino_features_are_the_network_s_patch_tokens_without_class_and_registers(
    saved: Callable[[str], Path], name: str
) -> None:
    import torch
    import transformers

    image = picture(64, 96)
    (found,) = DinoFeatures.load(saved(name), CPU).features([image])
    network = transformers.AutoModel.from_pretrained(saved(name)).eval()
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    pixels = np.moveaxis((image / 255.0 - mean) / deviation, -1, 0)[None].astype(np.float32)
    with torch.no_grad():
        tokens = network(pixel_values=torch.from_numpy(pixels)).last_hidden_state[0].numpy()
    num_cells = found.values[0].size
    patches = tokens[len(tokens) - num_cells :]
    np.testing.assert_allclose(found.values.reshape(32, -1).T, patches, atol=1e-5)


@pytest.mark.parametrize("name", ["dino_vit", "dino_convnext"])
def test_a_change_in_one_corner_shows_in_that_corner_of_the_map(
    saved: Callable[[str], Path], name: str
) -> None:
    source = DinoFeatures.load(saved(name), CPU)
    image = picture(96, 160)
    changed = image.copy()
    changed[:32, -32:] = 255 - changed[:32, -32:]
    before, after = source.features([image, changed])
    difference = np.linalg.norm(after.values - before.values, axis=0)
    row, column = np.unravel_index(difference.argmax(), difference.shape)
    assert row <= 1
    assert column >= difference.shape[1] - 2


def test_dino_refuses_maps_without_cells_or_with_too_many(saved: Callable[[str], Path]) -> None:
    source = DinoFeatures.load(saved("dino_vit"), CPU)
    for stride in (0, 1, 1000):
        with pytest.raises(UsageError, match="cells"):
            source.features([picture(480, 640)], stride=stride)
    with pytest.raises(UsageError, match="different sizes"):
        source.features([picture(60, 80), picture(80, 60)])


def test_clip_gives_unit_vectors_and_a_batch_is_as_good_as_one_by_one(
    saved: Callable[[str], Path],
) -> None:
    embedder = open_clip(saved("clip"), CPU)
    texts = embedder.encode(["red cube", "a yellow duck", "robot"])
    assert texts.shape == (3, embedder.num_channels) == (3, 16)
    np.testing.assert_allclose(np.linalg.norm(texts, axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(embedder.encode(["a yellow duck"])[0], texts[1], atol=1e-5)
    assert np.abs(texts[0] - texts[1]).max() > 1e-3
    masks = [np.zeros((60, 80), dtype=bool) for _ in range(2)]
    masks[0][10:30, 20:60] = True
    masks[1][5:50, 60:70] = True
    pieces = embedder.embed_masked([picture()] * 2, masks)
    np.testing.assert_allclose(np.linalg.norm(pieces, axis=1), 1.0, atol=1e-5)
    alone = embedder.embed_masked([picture()], masks[1:])
    np.testing.assert_allclose(alone[0], pieces[1], atol=1e-5)
    assert 0.0 < embedder.temperature <= 1.0
    assert embedder.encode([]).shape == embedder.embed_masked([], []).shape == (0, 16)


def test_clip_sees_only_what_the_mask_shows(saved: Callable[[str], Path]) -> None:
    embedder = ClipEmbedder.load(saved("clip"), CPU)
    mask = np.zeros((60, 80), dtype=bool)
    mask[20:40, 30:50] = True
    inside, outside = picture(seed=1), picture(seed=2)
    outside[mask] = inside[mask]
    one = embedder.embed_masked([inside, outside], [mask, mask])
    np.testing.assert_allclose(one[0], one[1], atol=1e-6)
    elsewhere = np.roll(mask, (10, -20), axis=(0, 1))
    moved = embedder.embed_masked([np.roll(inside, (10, -20), axis=(0, 1))], [elsewhere])
    np.testing.assert_allclose(moved[0], one[0], atol=1e-6)
    with pytest.raises(UsageError, match="0 set does not cut anything out"):
        embedder.embed_masked([inside], [np.zeros((60, 80), dtype=bool)])
    with pytest.raises(UsageError, match="does not cut"):
        embedder.embed_masked([inside], [np.ones((6, 8), dtype=bool)])
    with pytest.raises(UsageError, match="1 images for 2 masks"):
        embedder.embed_masked([inside], [mask, mask])


def test_a_crop_is_square_with_its_mask_in_the_middle() -> None:
    image, mask = picture(), np.zeros((60, 80), dtype=bool)
    mask[3:13, 60:80] = True  # at the border, where no margin is left
    ground = np.array([9, 8, 7], dtype=np.uint8)
    crop = masked_crop(image, mask, ground)
    assert crop.shape == (24, 24, 3)
    np.testing.assert_array_equal(crop[7:17, 2:22], image[3:13, 60:80])
    assert (crop[:7] == ground).all()


def test_weights_of_another_model_or_without_some_numbers_are_refused(
    saved: Callable[[str], Path], tmp_path: Path
) -> None:
    from safetensors.torch import load_file, save_file

    with pytest.raises(WeightsError, match="type 'clip', not 'sam3'"):
        open_segmenter(f"sam3:{saved('clip')}", CPU)
    for path in saved("dino_vit").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    tensors = load_file(tmp_path / "model.safetensors")
    lost = sorted(tensors)[3]
    del tensors[lost]
    save_file(tensors, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(WeightsError, match="parameters have no values"):
        open_features(f"dinov3:{tmp_path}", CPU)


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
        open_clip(tmp_path, CPU).encode(["duck"])
    assert not (tmp_path / "ran").exists()


def test_what_is_written_on_the_command_line_is_explained_when_it_is_wrong(tmp_path: Path) -> None:
    for spec in ("sam3", "sam3:", "sam2:folder", ""):
        with pytest.raises(UsageError, match="write sam3:FOLDER"):
            open_segmenter(spec)
    with pytest.raises(UsageError, match="write dinov3:FOLDER"):
        open_features("sam3:folder")
    with pytest.raises(WeightsError, match="no such folder"):
        open_clip(tmp_path / "nothing")
    with pytest.raises(UsageError, match="number type 'int8'"):
        Placement(dtype="int8").resolve()
    with pytest.raises(UsageError, match="device 'toaster'"):
        Placement(device="toaster").resolve()


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


def test_sam3_is_read_in_the_form_it_is_published_in(
    saved: Callable[[str], Path], tmp_path: Path
) -> None:
    """As the detector inside a model for videos, whose other parts are left out."""
    import json

    import torch
    from safetensors.torch import load_file, save_file

    for path in saved("sam3").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    inner = json.loads((tmp_path / "config.json").read_text())
    outer = {"model_type": "sam3_video", "detector_config": inner}
    (tmp_path / "config.json").write_text(json.dumps(outer))
    tensors = load_file(tmp_path / "model.safetensors")
    named = {f"detector_model.{name}": values for name, values in tensors.items()}
    named |= {"tracker_model.a": torch.zeros(3), "tracker_neck.b": torch.zeros(2)}
    save_file(named, tmp_path / "model.safetensors", metadata={"format": "pt"})
    where = {"camera_id": "c", "stamp_ns": 0}
    plain, video = (
        Sam3Segmenter.load(folder, CPU, ALL_QUERIES).segment(picture(), ["duck"], **where)
        for folder in (saved("sam3"), tmp_path)
    )
    for one, other in zip(plain.masks, video.masks, strict=True):
        assert one.score == other.score
        np.testing.assert_array_equal(one.image, other.image)


def test_half_precision_gives_nearly_the_same_as_float32(saved: Callable[[str], Path]) -> None:
    half = Placement(device="cpu", dtype="bfloat16")
    image = picture(64, 64)
    (exact,) = DinoFeatures.load(saved("dino_vit"), CPU).features([image])
    (rough,) = DinoFeatures.load(saved("dino_vit"), half).features([image])
    assert rough.values.dtype == np.float32
    apart = np.linalg.norm(rough.values - exact.values) / np.linalg.norm(exact.values)
    assert 0.0 < apart < 0.05  # eight bits of mantissa
    words = [ClipEmbedder.load(saved("clip"), at).encode(["red cube"]) for at in (CPU, half)]
    assert float(words[0][0] @ words[1][0]) > 0.999
    masks = Sam3Segmenter.load(saved("sam3"), half, ALL_QUERIES).segment(
        image, ["duck"], camera_id="c", stamp_ns=0
    )
    assert len(masks.masks) == 10
