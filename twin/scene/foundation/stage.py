"""Semantics as a stage of ``rebuild``: ask the models, find what is what, write it down."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from bridge.episode.streams import RgbdFrame
from bridge.errors import UsageError
from bridge.task.task_file import Task
from bridge.terminal import Advance, Output
from twin.naming.scene_file import (
    BACKGROUND_KEY,
    SEMANTICS_FILE,
    VECTORS_FILE,
    write_semantics,
    write_vectors,
)
from twin.naming.things import Mask, SemanticScene
from twin.naming.words import spoken_name
from twin.scene.foundation.loading import check_folder, device_of, import_transformers
from twin.scene.foundation.models import ClipEmbedder, Sam3Segmenter, sam3_folder
from twin.scene.frames.rgbd import TrainingView
from twin.scene.frames.selection import FrameChoice, load, spread
from twin.scene.gaussians import GaussianCloud, concatenate, moved_cloud
from twin.scene.objects.decompose import Decomposition
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.describe import scene_by_default, scene_from_masks
from twin.scene.semantics.lift import Viewpoint, render_labels
from twin.scene.settings import ModelConfig

MAX_VIEWPOINTS = 24
"""Frames that count support; more are thinned out evenly."""
MODEL_FRAMES = 12
"""Training frames that large models look at, spread evenly."""
MIN_SHOWN_PX = 64
"""A thing is cut out of frames that show at least this much of it."""
MAX_CROPS = 5
"""Frames whose vectors of one thing are averaged: those that show most of it."""


def check_models(config: ModelConfig, task: Task | None) -> dict[str, str]:
    """Check all that the models need, before anything slow begins.

    Returns:
        SHA-256 of each model's weights, by its option.

    Raises:
        UsageError: When an option or a folder cannot be used, or nothing says what to look for.
    """
    hashes = {}
    if config.segmenter:
        prompts_of(config, task)
        hashes["segmenter"] = check_folder(sam3_folder(config.segmenter), Sam3Segmenter.kind)
    if config.clip:
        hashes["clip"] = check_folder(Path(config.clip).expanduser(), ClipEmbedder.kind)
    if hashes:
        device_of(config.device)
        import_transformers()
    return hashes


def prompts_of(config: ModelConfig, task: Task | None) -> list[str]:
    """What to look for: the prompts given, else the names of the task's objects."""
    names = [] if task is None else [spoken_name(key) for key in task.objects]
    prompts = list(config.prompt) or list(dict.fromkeys(name for name in names if name))
    if not prompts:
        message = (
            "--segmenter needs words to look for, and the run's episodes name no task with "
            "objects. Give some: --prompt 'red cube' --prompt box."
        )
        raise UsageError(message)
    return prompts


def masks_in(
    config: ModelConfig,
    frames: Sequence[RgbdFrame],
    task: Task | None,
    advance: Advance = lambda done, note: None,
) -> list[tuple[Viewpoint, list[Mask]]]:
    """Run the segmenter over frames."""
    segmenter = Sam3Segmenter(sam3_folder(config.segmenter), config.device)
    prompts = prompts_of(config, task)
    masks = []
    for done, frame in enumerate(frames, 1):
        masks.append((viewpoint_of(frame), segmenter.segment(frame.image_u8, prompts)))
        advance(done, segmenter.kind.name)
    return masks


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


def training_frames(choices: Sequence[FrameChoice], count: int) -> list[RgbdFrame]:
    """Read at most ``count`` training frames, spread evenly over episodes, cameras and time."""
    numbered = [(index, ns) for index, each in enumerate(choices) for ns in sorted(each.train_ns)]
    chosen = {numbered[index] for index in spread(np.arange(len(numbered)), count)}
    frames: list[RgbdFrame] = []
    for index, each in enumerate(choices):
        frames += load(each, frozenset(ns for owner, ns in chosen if owner == index))
    return frames


def write_scene_semantics(
    folder: Path,
    decomposed: Decomposition,
    views: Sequence[TrainingView],
    threads: int,
    output: Output,
    *,
    fused: GaussianCloud | None,
    models: ModelConfig,
    choices: Sequence[FrameChoice],
    task: Task | None,
) -> dict[str, Any]:
    """Say what is what in a decomposed scene, and write it into the scene's folder.

    Args:
        fused: The surface as it was measured: things are looked for in it. None: in the Gaussians.
        models: Large models to ask beside the default segmenter.

    Returns:
        What ``scene.json`` says about it.
    """
    objects = decomposed.objects
    placed = {key: moved_cloud(item.cloud, item.T_base_object) for key, item in objects.items()}
    rasteriser = Rasteriser(RasterConfig(threads=threads))
    parts = {BACKGROUND_KEY: decomposed.background, **placed}
    rows, cloud = {key: len(part) for key, part in parts.items()}, concatenate([*parts.values()])
    output.say(f"name what is in the scene: {len(cloud)} Gaussians, {len(objects)} objects known")
    frames = training_frames(choices, MODEL_FRAMES) if models.any_named else []
    masks: list[tuple[Viewpoint, list[Mask]]] = []
    if models.segmenter:
        with output.progress("ask the segmenter", len(frames)) as advance:
            masks = masks_in(models, frames, task, advance)
        num_masks = sum(len(found) for _, found in masks)
        output.say(f"{num_masks} masks in {len(frames)} frames")
    with output.progress("name things", 100) as advance:
        if masks:
            kind = Sam3Segmenter.kind.name
            scene = scene_from_masks(cloud, masks, rasteriser, kind, advance)
        else:
            owner = np.repeat(np.arange(len(rows)), list(rows.values()))
            some = views[:: -(-len(views) // MAX_VIEWPOINTS) or 1]
            scene = scene_by_default(
                cloud,
                [Viewpoint(camera=v.half.camera, T_base_camera=v.T_base_color) for v in some],
                rasteriser,
                known={key: owner == n for n, key in enumerate(placed, start=1)},
                surfaces_m=decomposed.surfaces_m(),
                fused=fused,
                advance=advance,
            )
    for name in (SEMANTICS_FILE, VECTORS_FILE):
        (folder / name).unlink(missing_ok=True)
    record = write_semantics(folder, scene, rows)
    if models.clip:
        embedder = ClipEmbedder(Path(models.clip).expanduser(), models.device)
        with output.progress("give things vectors", len(scene.instances)) as advance:
            vectors, shown = thing_vectors(embedder, scene, cloud, frames, rasteriser, advance)
        source = f"{embedder.kind.name} {embedder.hash[:12]}"
        unseen = [scene.instances[row].label for row, count in enumerate(shown) if not count]
        record["vectors"] = write_vectors(folder, scene, vectors, source) | {"never_shown": unseen}
    names = "; ".join(item["name"] for item in record["instances"])
    output.say(
        f"{len(record['instances'])} things ({record['source']}): {names}"
        if names
        else f"no things named: {record['remark']}"
    )
    return {"semantics": record}
