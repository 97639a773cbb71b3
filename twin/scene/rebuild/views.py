"""Render held-out frames and keep them, recorded beside rendered, as a derived episode.

Topics, all with the stamp of the recorded frame and the frame id of its colour camera:
``/<cell>/views/cam/<id>/{recorded,rendered}/image`` (PNG), ``.../rendered/depth`` (16UC1),
``.../recorded/depth`` where depth and colour come from the same camera and
``.../recorded/depth_in_color`` where it was carried over, ``.../mask/{static,objects}`` (PNG, white
inside) where there is something to mask, and ``.../color/info``.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import CameraInfo, CompressedColor, DepthImage
from bridge.episode.metadata import Derived
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.episode.topics import camera_topic
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UndefinedStatisticError
from bridge.media.color import encode_png
from bridge.media.depth import from_metres
from bridge.media.image_quality import as_float, psnr_db
from bridge.terminal import Advance
from twin.scene.backdrop import Backdrop
from twin.scene.dataset.masks import ReferenceView, find_moving, without_ego
from twin.scene.dataset.training_set import TrainingSet, limits_of
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, TrainingView, training_view
from twin.scene.frames.selection import FrameChoice, load
from twin.scene.objects.decompose import Decomposition
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, View
from twin.scene.robot.extraction import LitLinks
from twin.scene.settings import RebuildConfig
from twin.scene.store.folder import background_hash

VIEWS_NOTE = (
    "held out from initialisation, poses, exposure, fit and objects; mean of the images' values, "
    "whole images as recorded, native resolution, no colour alignment; robot-gst evaluate rates "
    "the views episode further"
)
MOST_DB = 100.0
"""JSON has no word for identical images."""


def summarise_views(numbers: Sequence[Mapping[str, Any]], files: Sequence[str]) -> dict[str, Any]:
    """Average the held-out views, as ``robot-gst evaluate`` does."""
    each = [item["psnr_db"] for item in numbers]
    return {
        "files": list(files),
        "note": VIEWS_NOTE,
        "psnr_db": round(float(np.mean(each)), 4) if each else None,
        "images": list(numbers),
    }


ENGINE = "robot-gst splat"
"""Who drew the views, as their episode says."""
OBJECT_SHARE = 0.5
"""A pixel shows an object when this share of its light comes from it."""


def views_path(run: RunFolder, episode: Episode, scene_hash: str) -> Path:
    """Name of the derived episode that holds an episode's held-out views."""
    return run.derived_dir / f"{episode.path.stem}.views.{scene_hash}.mcap"


@dataclass(frozen=True, kw_only=True)
class ViewsJob:
    """What to render held-out frames of, and what to say about it."""

    training: TrainingSet
    scenes: Decomposition
    """Draws each episode with its own objects."""
    links: LitLinks
    backdrop: Backdrop
    config: RebuildConfig
    protocol: Mapping[str, Any]
    """How the scene was made: kept with the images, for whoever rates them."""


def write_views(run: RunFolder, job: ViewsJob, advance: Advance) -> list[dict[str, Any]]:
    """Render every held-out frame; one derived episode per recorded one, replaced if present.

    Returns:
        How each came out: PSNR over the whole image, as recorded; at most 100 dB.
    """
    rasteriser = Rasteriser(RasterConfig(threads=job.config.fit.threads))
    numbers: list[dict[str, Any]] = []
    choices, scene_hash = job.training.choices, background_hash(run)
    paths = [choice.episode.path for choice in choices]
    episodes = {choice.episode.path: choice.episode for choice in choices if choice.holdout_ns}
    for path, episode in episodes.items():
        target = views_path(run, episode, scene_hash)
        target.unlink(missing_ok=True)
        with EpisodeWriter(target) as writer:
            writer.describe(
                replace(episode.info, id=target.stem),
                derived=Derived(
                    kind="views",
                    source_episode=episode.info.id,
                    source_sha256=episode.sha256(),
                    scene_hash=scene_hash,
                    engine=ENGINE,
                    settings=dict(job.protocol),
                ),
            )
            for index in (k for k, own in enumerate(paths) if own == path):
                for number in _rendered(index, rasteriser, job, paths.index(path), writer):
                    numbers.append(number)
                    advance(len(numbers), f"{numbers[-1]['psnr_db']:.1f} dB")
    return numbers


def _rendered(
    index: int, rasteriser: Rasteriser, job: ViewsJob, scan: int, writer: EpisodeWriter
) -> Iterator[dict[str, Any]]:
    """Draw and write the held-out frames of one camera, and rate each.

    Objects of other scans did not move in this one.
    """
    training, choice = job.training, job.training.choices[index]
    references = [each for each in training.reference_views if each.scan == scan]
    scene, num_background = job.scenes.as_seen_in(choice.episode), len(job.scenes.background)
    for frame in load(choice, choice.holdout_ns):
        camera, T = frame.color_camera, frame.T_base_color
        cloud = training.robot.joined(job.links, scene, choice.episode, frame.stamp_ns)
        ego_mask = training.ego_masks.get(index)
        recorded = _recorded(frame, limits_of(job.config), references, ego_mask)
        view = job.backdrop.behind(rasteriser.view(cloud, camera, T), camera, T)
        masks = {"static": recorded.full.static_mask}
        if len(scene) > num_background:
            white = np.zeros((len(cloud), 1), dtype=np.float32)
            white[num_background : len(scene)] = 1.0
            masks["objects"] = rasteriser.draw_features(white)[0] > OBJECT_SHARE
        _write_view(writer, choice, frame, recorded.full.depth_m, view, masks)
        psnr = MOST_DB
        with suppress(UndefinedStatisticError):  # the images are the same
            psnr = psnr_db(as_float(frame.image_u8), as_float(view.image_u8()))
        yield {
            "episode": choice.episode.info.id,
            "camera_id": frame.camera_id,
            "stamp_ns": frame.stamp_ns,
            "stationary_camera": choice.stationary,  # training frames show the same view
            "psnr_db": min(psnr, MOST_DB),
        }


def _recorded(
    frame: RgbdFrame,
    limits: DepthLimits,
    references: Sequence[ReferenceView],
    ego_mask: Bool[np.ndarray, "_ _"] | None,
) -> TrainingView:
    """A held-out frame without what training frames look through or moves with the camera."""
    surface = FrameSurface(frame, limits)
    view, points = training_view(surface), surface.points()
    if ego_mask is not None:
        points, view = without_ego(points, view, ego_mask)
    return find_moving([points], references).mask_in(view)


def _write_view(
    writer: EpisodeWriter,
    choice: FrameChoice,
    frame: RgbdFrame,
    depth_in_color_m: Float32[np.ndarray, "height width"],
    view: View,
    masks: Mapping[str, Bool[np.ndarray, "height width"]],
) -> None:
    cell = choice.episode.info.cell or "cell"
    topic = camera_topic(f"{cell}/views", frame.camera_id)
    frame_id = streams.camera_info(choice.episode, frame.camera_id).frame_id
    stamp = frame.stamp_ns

    def put(tail: str, data: bytes, type_name: str) -> None:
        writer.write(
            f"{topic}/{tail}", data, type_name=type_name, log_time_ns=stamp, publish_time_ns=stamp
        )

    def png(tail: str, image_u8: np.ndarray) -> None:
        color = CompressedColor(
            stamp_ns=stamp, frame_id=frame_id, format="png", data=encode_png(image_u8)
        )
        put(tail, color.to_cdr(), schema.COMPRESSED_IMAGE)

    def depth(tail: str, depth_m: np.ndarray) -> None:
        image = DepthImage(stamp_ns=stamp, frame_id=frame_id, depth_mm=from_metres(depth_m))
        put(tail, image.to_cdr(), schema.IMAGE)

    info = CameraInfo(stamp_ns=stamp, frame_id=frame_id, camera=frame.color_camera)
    put("color/info", info.to_cdr(), schema.CAMERA_INFO)
    png("recorded/image", frame.image_u8)
    png("rendered/image", view.image_u8())
    depth("rendered/depth", view.depth_m)
    same = np.allclose(frame.T_base_color, frame.T_base_depth, atol=1e-6)
    if same and frame.color_camera == frame.depth_camera:
        depth("recorded/depth", frame.depth_m)
    else:
        depth("recorded/depth_in_color", depth_in_color_m)
    for name, mask in masks.items():
        if not mask.all():
            png(f"mask/{name}", np.repeat(mask[..., None], 3, axis=2).astype(np.uint8) * 255)
