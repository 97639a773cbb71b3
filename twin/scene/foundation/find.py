"""What the command ``find`` draws and tells: things of a scene in frames of its scan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt16

from bridge.episode.run_folder import RunFolder
from twin.naming.phrases import Answer, Found, Meaning
from twin.naming.scene_file import BACKGROUND_KEY, about_item, read_semantics, read_vectors
from twin.naming.things import SemanticScene, SemanticsError
from twin.scene.foundation.models import ClipEmbedder
from twin.scene.foundation.stage import training_frames, viewpoint_of
from twin.scene.frames.selection import choose_frames, find_sources, load
from twin.scene.gaussians import concatenate, moved_cloud
from twin.scene.movable_scene import outlined, read_movable_scene
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.lift import Viewpoint, render_labels
from twin.scene.settings import FrameConfig
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import read_scene

MAX_VIEWS = 12
"""Frames of the scan among which the picture is chosen."""
SHOWN_PX = 20
"""A frame shows a thing that has so many of its pixels."""
CANONICAL = ("object", "thing", "stuff", "texture")
"""What a text has to beat (LERF, Kerr et al. 2023)."""
LOGIT_SCALE = 100.0
"""CLIP's trained temperature: cosines differ by hundredths."""


@dataclass(frozen=True, kw_only=True)
class View:
    """What one frame of the scan shows."""

    name: str
    image_u8: np.ndarray
    T_base_camera: Float[np.ndarray, "4 4"]
    splats: UInt16[np.ndarray, "height width"]
    """Per pixel, of the thing that gives it most, its number; 0 is the background."""
    parts: UInt16[np.ndarray, "height width"]
    """The same of parts, numbered through."""
    part_numbers: dict[tuple[int, str], int]

    def mask(self, found: Found) -> np.ndarray:
        """Pixels of one thing or part."""
        if not found.part:
            return np.asarray(self.splats == found.item.id)
        return np.asarray(self.parts == self.part_numbers[found.item.id, found.part])

    def numbers(self, answer: Answer) -> UInt16[np.ndarray, "height width"]:
        """Per pixel the number of what was found, from 1."""
        drawn = np.zeros(self.splats.shape, dtype=np.uint16)
        for number, item in enumerate(answer.found, start=1):
            drawn[self.mask(item)] = number
        return drawn


@dataclass(frozen=True, kw_only=True)
class Looked:
    """A scene and the frames that show it."""

    scene: SemanticScene
    views: Sequence[View]

    @property
    def best(self) -> View:
        """Of the frames that show most things the one whose upper edge is most upwards."""

        def shown(view: View) -> tuple[int, float]:
            sizes = np.bincount(view.splats.ravel())[1:]
            ups = [item.T_base_instance[:3, 2] for item in self.scene.instances]
            upright = float(np.mean(ups, axis=0) @ -view.T_base_camera[:3, 1]) if ups else 0.0
            return int((sizes >= SHOWN_PX).sum()), upright

        return max(self.views, key=shown)

    def view_of(self, answer: Answer) -> View:
        """The best frame if it shows all that was found, else the one that shows most of it."""
        if all(self.best.mask(item).sum() >= SHOWN_PX for item in answer.found):
            return self.best
        return max(self.views, key=lambda view: np.count_nonzero(view.numbers(answer)))


def look_at(run: RunFolder, holdout: bool = False) -> Looked:
    """Read a scene's things, and draw them into frames of its scan.

    Args:
        holdout: Into all held-out frames instead of some of the others.
    """
    config = FrameConfig(max_train_frames=MAX_VIEWS)
    choices = choose_frames(find_sources(run), config, calibration=read_calibration(run)).choices
    frames = training_frames(choices, MAX_VIEWS)
    if holdout:
        frames = [frame for choice in choices for frame in load(choice, choice.holdout_ns)]
    named = {f"{frame.camera_id}:{frame.stamp_ns}": frame for frame in frames}
    images = {key: frame.image_u8 for key, frame in named.items()}
    return viewed(run, {key: viewpoint_of(frame) for key, frame in named.items()}, images)


def viewed(
    run: RunFolder, viewpoints: Mapping[str, Viewpoint], images_u8: Mapping[str, np.ndarray]
) -> Looked:
    """Draw a scene's things into images of these viewpoints."""
    whole = read_movable_scene(run, read_scene(run))
    rows = {BACKGROUND_KEY: len(whole.background)}
    rows |= {key: len(item.cloud) for key, item in whole.objects.items()}
    scene = read_semantics(run.scene_dir, rows)
    placed = [moved_cloud(item.cloud, item.T_base_object) for item in whole.objects.values()]
    cloud, rasteriser = concatenate([whole.background, *placed]), Rasteriser(RasterConfig())
    numbers: dict[tuple[int, str], int] = {}
    parts = np.zeros(len(cloud), dtype=np.uint16)
    for item in scene.instances:
        for name, mask in item.parts.items():
            parts[mask] = numbers[item.id, name] = len(numbers) + 1
    views = [
        View(
            name=key,
            image_u8=images_u8[key],
            T_base_camera=viewpoint.T_base_camera,
            splats=render_labels(rasteriser, cloud, scene.labels, viewpoint),
            parts=render_labels(rasteriser, cloud, parts, viewpoint),
            part_numbers=numbers,
        )
        for key, viewpoint in viewpoints.items()
    ]
    return Looked(scene=scene, views=views)


def about(found: Found) -> dict[str, Any]:
    """What is told about one thing or part."""
    own = {"part": found.part, "score": round(found.score, 3), "num_splats": int(found.mask.sum())}
    return about_item(found.item) | own


def line_of(number: int, found: Found) -> str:
    """The same in one line."""
    item = found.item
    at = ", ".join(f"{value:.3f}" for value in item.T_base_instance[:3, 3])
    part = f"{found.part} of " if found.part else ""
    return f"{number}: {part}{item.name}, at ({at}) m, score {found.score:.2f}"


def picture_of(view: View, answer: Answer) -> np.ndarray:
    """The frame with what was found outlined and numbered."""
    image = view.image_u8
    for number, item in enumerate(answer.found, start=1):
        mask = view.mask(item)
        if mask.any():
            image = outlined(image, mask, f"{number}: {item.part or item.item.label}")
    return image


def meaning_of(run: RunFolder, scene: SemanticScene, folder: Path) -> Meaning:
    """CLIP's opinion of the things of a scene that was rebuilt with it."""
    held = read_vectors(run.scene_dir, scene)
    if held is None:
        message = f"{run.path} has no vectors of its things. Rebuild it: --clip {folder}."
        raise SemanticsError(message)
    embedder = ClipEmbedder(folder.expanduser())
    vectors, source = held
    if vectors.shape[1] != embedder.num_channels or embedder.hash[:12] not in source:
        message = f"the things' vectors are by {source}, {folder} is {embedder.hash[:12]}."
        raise SemanticsError(message)
    return lambda text: activations(vectors, embedder.encode([text, *CANONICAL])).tolist()


def activations(
    vectors: Float32[np.ndarray, "num_instances num_channels"],
    texts: Float32[np.ndarray, "num_texts num_channels"],
) -> Float[np.ndarray, " num_instances"]:
    """Softmax of the first text against each of the others, the least favourable counts.

    Vectors may have any length; one of zeros, of a thing that no frame showed, gives 0.
    """
    length = np.linalg.norm(vectors, axis=1)
    unit = vectors / np.maximum(length, 1e-12)[:, None]
    cosine = unit @ (texts / np.linalg.norm(texts, axis=1, keepdims=True)).T
    against = LOGIT_SCALE * (cosine[:, 1:].max(axis=1) - cosine[:, 0])
    return np.where(length > 0, 1.0 / (1.0 + np.exp(np.clip(against, -60.0, 60.0))), 0.0)
