"""The one call of ``rebuild``: say what is what, and write it beside the splats."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bridge.terminal import Advance
from twin.scene.gaussians.cloud import GaussianCloud, concatenate
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.describe import scene_by_default, scene_from_masks
from twin.scene.semantics.features import FEATURES_FILE, SceneFeatures, save_features
from twin.scene.semantics.lift import Viewpoint
from twin.scene.semantics.result import MaskSet, SemanticScene, SemanticsError
from twin.scene.semantics.segment import SOURCE
from twin.scene.semantics.store import BACKGROUND_KEY, SEMANTICS_FILE, write_semantics

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
    robot_m: Float[np.ndarray, "num_robot 3"] | None = None,
    surfaces_m: Mapping[str, Float[np.ndarray, "_ 3"]] | None = None,
    threads: int = 0,
    advance: Advance = lambda done, note: None,
) -> dict[str, Any]:
    """Segment a scene and write ``semantics.npz`` (and ``features.npz``) into its folder.

    Nothing found, or masks that do not fit, is a remark, not an error: the scene is good without.

    Args:
        folder: The scene folder.
        background: What ``background.ply`` holds.
        objects: What ``objects/<id>/gaussians.ply`` hold, moved to where they were scanned; without
            masks each is an instance of that name.
        viewpoints: Training frames, to count in how many an instance shows.
        masks: Masks of a 2D segmenter; without any the default segmenter looks at the Gaussians.
        features: Features of the same Gaussians, background first.
        robot_m: Points on the robot where it stood, to leave it out.
        surfaces_m: Points of the objects' reconstructed surfaces where they stand: their parts are
            told apart on these.
        threads: For drawing; 0: all cores.
        advance: Told the percentage done.

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
            known = {key: _rows(rows, key) for key in objects}
            scene = scene_by_default(
                cloud,
                viewpoints[::step],
                rasteriser,
                robot_m=robot_m,
                known=known,
                surfaces_m=surfaces_m,
                advance=advance,
            )
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


def _rows(rows: Mapping[str, int], key: str) -> Bool[np.ndarray, " num_splats"]:
    """Which Gaussians of the whole scene are one part's."""
    return np.repeat([name == key for name in rows], list(rows.values()))
