"""Semantics as a stage of ``rebuild``: ask the models, find what is what, write it down."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bridge.episode.streams import RgbdFrame
from bridge.task.task_file import Task
from bridge.terminal import Advance, Output
from twin.naming.scene_file import (
    BACKGROUND_KEY,
    SEMANTICS_FILE,
    read_semantics,
    write_semantics,
)
from twin.naming.things import MaskSet, SemanticScene, SemanticsError
from twin.scene.foundation.stage import ModelFindings, ask_models, embed_things
from twin.scene.frames.rgbd import TrainingView
from twin.scene.frames.selection import FrameChoice, load, spread
from twin.scene.gaussians import GaussianCloud, concatenate, moved_cloud
from twin.scene.objects.decompose import Decomposition
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.describe import scene_by_default, scene_from_masks
from twin.scene.semantics.features import FEATURES_FILE, SceneFeatures, save_features
from twin.scene.semantics.lift import Viewpoint
from twin.scene.semantics.segment import SOURCE
from twin.scene.settings import ModelConfig

MAX_VIEWPOINTS = 24
"""Frames that count support; more are thinned out evenly."""


def add_semantics(
    folder: Path,
    background: GaussianCloud,
    objects: Mapping[str, GaussianCloud],
    viewpoints: Sequence[Viewpoint],
    *,
    masks: Sequence[tuple[Viewpoint, MaskSet]] = (),
    features: SceneFeatures | None = None,
    surfaces_m: Mapping[str, Float[np.ndarray, "_ 3"]] | None = None,
    fused: GaussianCloud | None = None,
    threads: int = 0,
    advance: Advance = lambda done, note: None,
) -> dict[str, Any]:
    """Segment a scene and write ``semantics.npz`` (and ``features.npz``) into its folder.

    Nothing found, or masks that do not fit, is a remark, not an error: the scene is good without.

    Args:
        background: What ``background.ply`` holds. Those that nobody measured are guessed surfaces:
            without masks no thing is looked for in them.
        objects: What ``objects/<id>/gaussians.ply`` hold, moved to where they were scanned; without
            masks each is an instance of that name.
        masks: Masks of a 2D segmenter; without any the default segmenter looks at the Gaussians.
        surfaces_m: Points of the objects' reconstructed surfaces where they stand: their parts are
            told apart on these.
        fused: The surface as it was measured: things are looked for in it. None: in the Gaussians.

    Returns:
        What ``scene.json`` says under ``semantics``.
    """
    cloud = concatenate([background, *objects.values()])
    rows = {BACKGROUND_KEY: len(background)} | {key: len(part) for key, part in objects.items()}
    rasteriser = Rasteriser(RasterConfig(threads=threads))
    try:
        if masks:
            scene = scene_from_masks(cloud, masks, rasteriser, advance=advance)
        else:
            step = -(-len(viewpoints) // MAX_VIEWPOINTS) or 1
            sizes = list(rows.values())
            known = {key: np.repeat([name == key for name in rows], sizes) for key in objects}
            measured = np.ones(len(cloud), dtype=bool)
            measured[: len(background)] = ~background.completed
            scene = scene_by_default(
                cloud.take(measured),
                viewpoints[::step],
                rasteriser,
                known={key: mask[measured] for key, mask in known.items()},
                surfaces_m=surfaces_m,
                fused=fused,
                advance=advance,
            )
            scene = _among_all(scene, measured)
    except SemanticsError as error:
        nothing = np.zeros(len(cloud), dtype=np.uint16)
        source = masks[0][1].source if masks else SOURCE
        scene = SemanticScene(instances=(), labels=nothing, source=source, remark=str(error))
    for name in (SEMANTICS_FILE, FEATURES_FILE):
        (folder / name).unlink(missing_ok=True)
    record = write_semantics(folder, scene, rows)
    if features is not None:
        if len(features.features) != len(cloud):
            told = f"features of {len(features.features)} Gaussians for {len(cloud)}: left out"
            return record | {"features": None, "features_remark": told}
        record["features"] = {
            "file": save_features(folder, features).name,
            "source": features.source,
            "num_kept": len(features.basis.components),
            "explained_fraction": round(features.basis.explained_fraction, 4),
        }
    return record


def _among_all(scene: SemanticScene, measured: Bool[np.ndarray, " num_splats"]) -> SemanticScene:
    """The same things among all Gaussians; only the measured ones were looked at."""

    def spread_out(values: np.ndarray) -> np.ndarray:
        spread_values = np.zeros(len(measured), dtype=values.dtype)
        spread_values[measured] = values
        return spread_values

    things = tuple(
        replace(
            item,
            mask=spread_out(item.mask),
            parts={name: spread_out(mask) for name, mask in item.parts.items()},
        )
        for item in scene.instances
    )
    return replace(scene, instances=things, labels=spread_out(scene.labels))


def ask_models_about(
    config: ModelConfig,
    choices: Sequence[FrameChoice],
    cloud: GaussianCloud,
    task: Task | None,
    output: Output,
    *,
    threads: int = 0,
) -> tuple[list[RgbdFrame], ModelFindings]:
    """Ask segmenter and feature model about training frames; nothing when none is named.

    Returns:
        The frames they looked at, and what they found.
    """
    num_models = bool(config.segmenter) + bool(config.features)
    if not num_models and not config.clip:
        return [], ModelFindings(masks=[], features=None)
    frames = training_frames(choices, config.model_frames)
    with output.progress("ask the models", num_models * len(frames)) as advance:
        findings = ask_models(config, frames, cloud, task, threads=threads, advance=advance)
    num_masks = sum(len(masks.masks) for _, masks in findings.masks)
    if config.segmenter:
        output.say(f"{num_masks} masks in {len(frames)} frames")
    return frames, findings


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
    fused: GaussianCloud | None = None,
    models: ModelConfig | None = None,
    choices: Sequence[FrameChoice] = (),
    task: Task | None = None,
) -> dict[str, Any]:
    """Say what is what in a decomposed scene.

    Args:
        fused: The surface as it was measured: things are looked for in it. None: in the Gaussians.
        models: Large models to ask beside the default segmenter; None: none.
    """
    objects = decomposed.objects
    placed = {key: moved_cloud(item.cloud, item.T_base_object) for key, item in objects.items()}
    cloud = concatenate([decomposed.background, *placed.values()])
    output.say(f"name what is in the scene: {len(cloud)} Gaussians, {len(objects)} objects known")
    models = models or ModelConfig()
    frames, found = ask_models_about(models, choices, cloud, task, output, threads=threads)
    with output.progress("name things", 100) as advance:
        record = add_semantics(
            folder,
            decomposed.background,
            placed,
            [Viewpoint(camera=v.half.camera, T_base_camera=v.T_base_color) for v in views],
            masks=found.masks,
            features=found.features,
            surfaces_m=decomposed.surfaces_m(),
            fused=fused,
            threads=threads,
            advance=advance,
        )
    rows = {BACKGROUND_KEY: len(decomposed.background)}
    rows |= {key: len(part) for key, part in placed.items()}
    if models.clip:
        scene = read_semantics(folder, rows)
        with output.progress("give things vectors", len(scene.instances)) as advance:
            record["vectors"] = embed_things(
                folder,
                scene,
                cloud,
                frames,
                found.features,
                models,
                threads=threads,
                advance=advance,
            )
    names = "; ".join(item["name"] for item in record["instances"])
    output.say(
        f"{len(record['instances'])} things ({record['source']}): {names}"
        if names
        else f"no things named: {record['remark']}"
    )
    return {"semantics": record}
