"""What a rebuild asks the models, on a table with a red and a blue heap drawn by ourselves."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clouds import even_cloud

from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.task.task_file import load_task
from bridge.terminal import Output
from twin.naming.things import Instance, SemanticScene
from twin.scene.foundation.find import activations
from twin.scene.foundation.loading import WeightsError
from twin.scene.foundation.models import ClipEmbedder
from twin.scene.foundation.stage import (
    check_models,
    masks_in,
    prompts_of,
    thing_vectors,
    training_frames,
    viewpoint_of,
)
from twin.scene.frames.selection import choose_frames, find_sources, spread
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.rebuild.run import rebuild
from twin.scene.settings import FitConfig, FrameConfig, InitialiseConfig, ModelConfig, RebuildConfig

CAMERA = Camera(width=96, height=80, fx=90.0, fy=90.0, cx=48.0, cy=40.0)
COLOURS = {1: (0.9, 0.1, 0.1), 2: (0.1, 0.1, 0.9)}


def heaps() -> tuple[GaussianCloud, np.ndarray]:
    """A grey table and two heaps on it, with the label of each Gaussian."""
    rng = np.random.default_rng(0)
    table = np.stack(np.meshgrid(np.arange(-0.3, 0.3, 0.02), np.arange(-0.3, 0.3, 0.02)), -1)
    flat = np.concatenate([table.reshape(-1, 2), np.zeros((table[..., 0].size, 1))], axis=1)
    red = rng.uniform([-0.14, -0.05, 0.0], [-0.04, 0.05, 0.08], size=(300, 3))
    blue = rng.uniform([0.05, -0.04, 0.0], [0.13, 0.04, 0.06], size=(300, 3))
    labels = np.repeat(np.array([0, 1, 2], dtype=np.uint16), [len(flat), 300, 300])
    means = np.concatenate([flat, red, blue])
    colors = np.array([(0.5, 0.5, 0.5), COLOURS[1], COLOURS[2]])[labels]
    sigma = np.where(labels == 0, 0.015, 0.008)
    return even_cloud(means, colors, sigma[:, None]), labels


def things(labels: np.ndarray) -> SemanticScene:
    def thing(number: int, label: str) -> Instance:
        return Instance(
            id=number,
            label=label,
            mask=labels == number,
            score=1.0,
            source="test",
            color_srgb=(0, 0, 0),
            T_base_instance=np.eye(4),
            size_m=(0.1, 0.1, 0.08),
        )

    instances = (thing(1, "red heap"), thing(2, "blue heap"), thing(9, "hidden thing"))
    return SemanticScene(instances=instances, labels=labels, source="test")


def frames_of(cloud: GaussianCloud, count: int = 3) -> list[RgbdFrame]:
    frames = []
    for index in range(count):
        angle = 0.5 * index - 0.5
        eye = np.array([0.5 * np.sin(angle), -0.5 * np.cos(angle), 0.4])
        T = se3.look_at(eye, np.array([0.0, 0.0, 0.02]), np.array([0.0, 0.0, 1.0]))
        view = Rasteriser().view(cloud, CAMERA, T)
        frames.append(
            RgbdFrame(
                camera_id="wrist",
                stamp_ns=index * 1000,
                image_u8=view.image_u8(),
                depth_m=view.depth_m.astype(np.float64),
                color_camera=CAMERA,
                depth_camera=CAMERA,
                T_base_color=T,
                T_base_depth=T,
            )
        )
    return frames


class MeanColour(ClipEmbedder):
    """Stands in for CLIP: the vector of a piece is its mean colour."""

    num_channels = 3  # type: ignore[assignment]

    def __init__(self) -> None:  # noqa: D107 (loads nothing)
        pass

    def embed_masked(self, images_u8: Any, masks: Any) -> np.ndarray:
        means = [image[mask].mean(axis=0) for image, mask in zip(images_u8, masks, strict=True)]
        vectors = np.array(means)
        return as_float32(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def test_things_get_vectors_of_what_the_frames_show_of_them() -> None:
    cloud, labels = heaps()
    embedder = MeanColour()
    vectors, shown = thing_vectors(embedder, things(labels), cloud, frames_of(cloud), Rasteriser())
    assert shown == [3, 3, 0]
    for row, number in enumerate((1, 2)):
        wanted = np.array(COLOURS[number]) / np.linalg.norm(COLOURS[number])
        assert vectors[row] @ wanted > 0.99
        assert np.linalg.norm(vectors[row]) == pytest.approx(1.0, abs=1e-5)
    assert not vectors[2].any()
    many, shown = thing_vectors(embedder, things(labels), cloud, frames_of(cloud, 8), Rasteriser())
    assert shown[:2] == [5, 5]  # only those that show most
    np.testing.assert_allclose(many[:2], vectors[:2], atol=0.02)


def test_prompts_are_those_given_or_the_names_of_the_task_s_objects() -> None:
    ducks = load_task("five_ducks_into_basket")
    assert prompts_of(ModelConfig(), ducks)[:1] == ["duck"]
    assert len(prompts_of(ModelConfig(), ducks)) == len(set(prompts_of(ModelConfig(), ducks)))
    assert prompts_of(ModelConfig(prompt=("red cube", "box")), ducks) == ["red cube", "box"]
    with pytest.raises(UsageError, match="--prompt"):
        prompts_of(ModelConfig(), None)


def test_frames_are_spread_evenly() -> None:
    assert spread(np.arange(100), 5).tolist() == [0, 25, 50, 74, 99]
    assert spread(np.array([7, 8]), 5).tolist() == [7, 8]
    assert spread(np.zeros(0), 5).tolist() == []
    assert spread(np.array([3]), 1).tolist() == [3]


def test_bad_options_are_refused_before_anything_slow(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--segmenter 'sam2:x'"):
        check_models(ModelConfig(segmenter="sam2:x", prompt=("box",)), None)
    with pytest.raises(WeightsError, match="no such folder"):
        check_models(ModelConfig(clip=str(tmp_path / "nothing")), None)
    with pytest.raises(UsageError, match="--prompt"):
        check_models(ModelConfig(segmenter="sam3:x"), None)
    assert check_models(ModelConfig(), None) == {}


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[str], Path]:
    pytest.importorskip("transformers", reason="the extra [foundation] is not installed")
    import tiny_models

    def folder(name: str) -> Path:
        getattr(tiny_models, f"save_{name}")(tmp_path / name)
        return tmp_path / name

    return folder


@pytest.mark.slow
def test_both_models_are_asked(saved: Callable[[str], Path]) -> None:
    config = ModelConfig(segmenter=f"sam3:{saved('sam3')}", clip=str(saved("clip")), device="cpu")
    task = load_task("five_ducks_into_basket")
    hashes = check_models(config, task)
    assert sorted(hashes) == ["clip", "segmenter"]
    assert len(set(hashes.values())) == 2
    cloud, labels = heaps()
    frames, seen = frames_of(cloud), []
    masks = masks_in(config, frames, task, advance=lambda done, _: seen.append(done))
    assert seen == [1, 2, 3]
    np.testing.assert_array_equal(masks[1][0].T_base_camera, viewpoint_of(frames[1]).T_base_camera)
    embedder = ClipEmbedder(saved("clip"), "cpu")
    vectors, shown = thing_vectors(embedder, things(labels), cloud, frames, Rasteriser())
    assert (vectors.shape, shown) == ((3, 16), [3, 3, 0])
    values = activations(vectors, embedder.encode(["red duck", "table"]))
    assert ((values >= 0) & (values <= 1)).all()
    assert values[2] == 0.0  # nobody saw it


def test_a_text_counts_as_it_beats_what_means_anything() -> None:
    vectors = np.array([[0.0, 2.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, 0.1]], dtype=np.float32)
    texts = np.array([[0.0, 3.0, 0.0], [1.0, 0.0, 0.0]], dtype=np.float32)
    np.testing.assert_allclose(activations(vectors, texts), [1.0, 0.5, 0.0], atol=1e-6)


def test_training_frames_are_spread_over_those_of_the_fit(tmp_path: Path) -> None:
    import textured_room  # beside the tests one folder up, see conftest there

    run = RunFolder.create(tmp_path)
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=16)
    choices = choose_frames(find_sources(run), FrameConfig(holdout_every=4)).choices
    stamps = sorted(choices[0].train_ns)
    found = [frame.stamp_ns for frame in training_frames(choices, 4)]
    assert len(found) == 4
    assert found[0] == stamps[0]
    assert found[-1] == stamps[-1]
    assert set(found) <= set(stamps)
    assert len(training_frames(choices, 100)) == len(stamps)


@pytest.mark.slow
def test_a_rebuild_asks_the_models_it_is_given(
    saved: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import textured_room

    run = RunFolder.create(tmp_path / "run")
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=16)
    models = ModelConfig(
        segmenter=f"sam3:{saved('sam3')}",
        prompt=("red cube",),
        clip=str(saved("clip")),
        device="cpu",
    )
    config = RebuildConfig(
        fit=FitConfig(iterations=10, threads=1),
        initialise=InitialiseConfig(max_splats=800, flying_fraction=0.1),
        models=models,
    )
    record = rebuild(run, config, Output(quiet=True))["semantics"]
    assert record["source"] == "SAM 3"
    assert record["vectors"]["source"].startswith("CLIP ")
    json.dumps(record)  # it is part of scene.json
    monkeypatch.setattr(
        "twin.scene.rebuild.run.read_training_set", None
    )  # nothing is learnt a second time
    rebuild(run, config, Output(quiet=True))
    (run.scene_dir / "features.npz").unlink()
    with pytest.raises(TypeError):
        rebuild(run, config, Output(quiet=True))
    no_words = replace(config, models=replace(models, prompt=()))
    with pytest.raises(UsageError, match="--prompt"):
        rebuild(run, no_words, Output(quiet=True))
