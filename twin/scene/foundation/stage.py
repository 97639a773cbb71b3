"""What ``rebuild`` asks the models: masks and features of training frames, vectors of things."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from bridge.episode.streams import RgbdFrame
from bridge.errors import UsageError
from bridge.task.task_file import Task
from bridge.terminal import Advance
from twin.naming.things import MaskSet, SemanticScene
from twin.naming.words import spoken_name
from twin.scene.foundation import models
from twin.scene.foundation.loading import (
    Placement,
    WeightsKind,
    check_folder,
    import_transformers,
    weights_hash,
)
from twin.scene.foundation.models import (
    FEATURES,
    SEGMENTERS,
    ClipEmbedder,
    DinoFeatures,
    Sam3Segmenter,
    split_spec,
)
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.features import (
    FeatureBasis,
    SceneFeatures,
    fit_basis,
    lift_reduced,
    save_features,
)
from twin.scene.semantics.lift import Viewpoint, render_labels
from twin.scene.settings import ModelConfig

MIN_SHOWN_PX = 64
"""A thing is cut out of frames that show at least this much of it."""
MAX_CROPS = 5
"""Frames whose vectors of one thing are averaged: those that show most of it."""


@dataclass(frozen=True, kw_only=True)
class ModelFindings:
    """What the models say about the frames."""

    masks: list[tuple[Viewpoint, MaskSet]]
    """Empty without a segmenter."""
    features: SceneFeatures | None
    """None without a feature model."""


def check_models(config: ModelConfig, task: Task | None) -> dict[str, str]:
    """Check all that the models need, before anything slow begins.

    Returns:
        SHA-256 of each model's weights, by its option.

    Raises:
        UsageError: When an option or a folder cannot be used, or nothing says what to look for.
    """
    named: list[tuple[str, Path, WeightsKind]] = []
    if config.segmenter:
        prompts_of(config, task)
        _, folder = split_spec(config.segmenter, "--segmenter", SEGMENTERS)
        named.append(("segmenter", folder, models.SAM3_KIND))
    if config.features:
        _, folder = split_spec(config.features, "--features", FEATURES)
        named.append(("features", folder, models.DINOV3_KIND))
    if config.clip:
        named.append(("clip", Path(config.clip).expanduser(), models.CLIP_KIND))
    hashes = {}
    for option, folder, kind in named:
        check_folder(folder, kind)
        hashes[option] = weights_hash(folder, kind)
    if hashes:
        Placement(device=config.device).resolve()
        import_transformers()
    return hashes


def prompts_of(config: ModelConfig, task: Task | None) -> list[str]:
    """What to look for: the prompts given, else the names of the task's objects."""
    if config.prompt:
        return list(config.prompt)
    names = [] if task is None else [spoken_name(key) for key in task.objects]
    prompts = list(dict.fromkeys(name for name in names if name))
    if not prompts:
        message = (
            "--segmenter needs words to look for, and the run's episodes name no task with "
            "objects. Give some: --prompt 'red cube' --prompt box."
        )
        raise UsageError(message)
    return prompts


def ask_models(
    config: ModelConfig,
    frames: Sequence[RgbdFrame],
    cloud: GaussianCloud,
    task: Task | None,
    *,
    threads: int = 0,
    advance: Advance = lambda done, note: None,
) -> ModelFindings:
    """Run segmenter and feature model over frames, one model in memory at a time.

    Args:
        cloud: The Gaussians that features are lifted to, in the frames' root frame.
    """
    placement = Placement(device=config.device)
    masks: list[tuple[Viewpoint, MaskSet]] = []
    if config.segmenter:
        _, folder = split_spec(config.segmenter, "--segmenter", SEGMENTERS)
        segmenter = Sam3Segmenter.load(folder, placement)
        prompts = prompts_of(config, task)
        for done, frame in enumerate(frames, 1):
            found = segmenter.segment(
                frame.image_u8, prompts, camera_id=frame.camera_id, stamp_ns=frame.stamp_ns
            )
            masks.append((viewpoint_of(frame), found))
            advance(done, segmenter.source)
        del segmenter
    features = None
    if config.features and frames:
        _, folder = split_spec(config.features, "--features", FEATURES)
        source = DinoFeatures.load(folder, placement)
        maps = []
        for done, frame in enumerate(frames, 1):
            maps += source.features([frame.image_u8], stride=config.feature_stride)
            advance(len(masks) + done, source.source)
        basis = fit_basis(maps, config.feature_channels)
        pairs = zip((viewpoint_of(frame) for frame in frames), maps, strict=True)
        rasteriser = Rasteriser(RasterConfig(threads=threads))
        features = lift_reduced(rasteriser, cloud, pairs, basis, source=source.source)
    return ModelFindings(masks=masks, features=features)


def embed_things(
    folder: Path,
    scene: SemanticScene,
    cloud: GaussianCloud,
    frames: Sequence[RgbdFrame],
    features: SceneFeatures | None,
    config: ModelConfig,
    *,
    threads: int = 0,
    advance: Advance = lambda done, note: None,
) -> dict[str, Any]:
    """Give every thing of a scene its CLIP vector and write ``features.npz``.

    Returns:
        What ``scene.json`` says about the vectors.
    """
    if not config.clip:
        message = "no folder of CLIP is named; give --clip FOLDER."
        raise UsageError(message)
    placement = Placement(device=config.device)
    embedder = ClipEmbedder.load(Path(config.clip).expanduser(), placement)
    rasteriser = Rasteriser(RasterConfig(threads=threads))
    vectors, shown = thing_vectors(embedder, scene, cloud, frames, rasteriser, advance)
    held = features or _no_features(len(cloud))
    sources = [name for name in (held.source, embedder.source) if name]
    with_vectors = replace(
        held,
        instance_ids=np.array([item.id for item in scene.instances], dtype=np.int32),
        instance_embeddings=vectors,
        source=", ".join(sources),
    )
    path = save_features(folder, with_vectors)
    unseen = [item.label for item, count in zip(scene.instances, shown, strict=True) if not count]
    return {
        "file": path.name,
        "source": embedder.source,
        "num_channels": embedder.num_channels,
        "never_shown": unseen,
    }


def thing_vectors(
    embedder: ClipEmbedder,
    scene: SemanticScene,
    cloud: GaussianCloud,
    frames: Sequence[RgbdFrame],
    rasteriser: Rasteriser,
    advance: Advance = lambda done, note: None,
) -> tuple[Float32[np.ndarray, "num_instances num_channels"], list[int]]:
    """One unit vector for each instance, the mean over the frames that show most of it.

    Returns:
        Vectors in the order of the instances, zero where no frame shows one; how many frames each
        was cut out of.
    """
    seen: dict[int, list[tuple[int, int, np.ndarray]]] = {item.id: [] for item in scene.instances}
    for index, frame in enumerate(frames):
        ids = render_labels(rasteriser, cloud, scene.labels, viewpoint_of(frame))
        for number, found in seen.items():
            mask = ids == number
            count = int(mask.sum())
            if count >= MIN_SHOWN_PX:
                found.append((count, index, mask))
    vectors = np.zeros((len(scene.instances), embedder.num_channels), dtype=np.float32)
    shown = []
    for row, item in enumerate(scene.instances):
        best = sorted(seen[item.id], key=lambda entry: (-entry[0], entry[1]))[:MAX_CROPS]
        shown.append(len(best))
        if best:
            images = [frames[index].image_u8 for _, index, _ in best]
            mean = embedder.embed_masked(images, [mask for _, _, mask in best]).mean(axis=0)
            vectors[row] = mean / max(float(np.linalg.norm(mean)), 1e-12)
        advance(row + 1, item.label)
    return vectors, shown


def viewpoint_of(frame: RgbdFrame) -> Viewpoint:
    """Where a frame's colour camera stood."""
    return Viewpoint(camera=frame.color_camera, T_base_camera=frame.T_base_color)


def _no_features(num_splats: int) -> SceneFeatures:
    basis = FeatureBasis(
        mean=np.zeros(0, dtype=np.float32),
        components=np.zeros((0, 0), dtype=np.float32),
        explained_fraction=1.0,
    )
    return SceneFeatures(
        basis=basis,
        features=np.zeros((num_splats, 0), dtype=np.float32),
        weight=np.zeros(num_splats, dtype=np.float32),
        instance_ids=np.zeros(0, dtype=np.int32),
        instance_embeddings=np.zeros((0, 0), dtype=np.float32),
        source="",
    )
