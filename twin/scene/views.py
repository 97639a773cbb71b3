"""Render held-out frames and keep them, recorded beside rendered, as a derived episode.

Topics, all with the stamp of the recorded frame and the frame id of its colour camera:
``/<cell>/views/cam/<id>/{recorded,rendered}/image`` (PNG), ``.../rendered/depth`` (16UC1),
``.../recorded/depth`` where depth and colour come from the same camera, and ``.../color/info``.
"""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bridge.episode import schema, streams
from bridge.episode.metadata import Derived
from bridge.episode.reader import Episode
from bridge.episode.records import CameraInfo, CompressedColor, DepthImage
from bridge.episode.run import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.episode.writer import EpisodeWriter
from bridge.terminal import Advance
from twin.scene.frames import FrameChoice, load
from twin.scene.gaussians import GaussianCloud
from twin.scene.losses import psnr_db
from twin.scene.moving import Witness, find_moving
from twin.scene.points import DepthLimits, FrameSurface
from twin.scene.raster import RasterConfig, Rasteriser, View
from twin.scene.training_view import training_view


@dataclass(frozen=True, kw_only=True)
class ViewNumbers:
    """How one held-out view came out."""

    episode: str
    camera_id: str
    stamp_ns: int
    still_camera: bool
    """The camera does not move, so training frames show the same view."""
    psnr_db: float
    """Over the whole image, as recorded: a robot in view counts as error."""
    static_psnr_db: float | None
    """Over the pixels that show nothing that moved; None when there are none."""
    static_fraction: float
    """Share of those pixels."""
    depth_mean_abs_m: float | None
    """Against the recorded depth, where both exist and the cameras coincide."""
    coverage_fraction: float
    """Mean alpha of the rendered image."""


def views_path(run: RunFolder, episode: Episode, scene_hash: str) -> Path:
    """Name of the derived episode that holds an episode's held-out views."""
    return run.derived_dir / f"{episode.path.stem}.views.{scene_hash}.mcap"


@dataclass(frozen=True, kw_only=True)
class ViewsJob:
    """What to render held-out frames of, and what to say about it."""

    scene_hash: str
    cloud: GaussianCloud
    witnesses: Sequence[Witness]
    limits: DepthLimits
    holdout_every: int
    raster: RasterConfig

    def settings(self) -> dict[str, object]:
        """What the derived episode records about how its views were made."""
        return {
            "holdout": f"every {self.holdout_every}th frame of each camera",
            "resolution": "native colour camera",
            "masks": "none",
            "alpha_cut": self.raster.alpha_cut,
        }


def write_views(
    run: RunFolder, choices: Sequence[FrameChoice], job: ViewsJob, advance: Advance
) -> list[ViewNumbers]:
    """Render every held-out frame; one derived episode per recorded one, replaced if present."""
    rasteriser = Rasteriser(job.raster)
    numbers: list[ViewNumbers] = []
    episodes = {choice.episode.path: choice.episode for choice in choices if choice.holdout_ns}
    for path, episode in episodes.items():
        target = views_path(run, episode, job.scene_hash)
        target.unlink(missing_ok=True)
        own = [choice for choice in choices if choice.episode.path == path]
        with EpisodeWriter(target) as writer:
            writer.describe(
                replace(episode.info, id=target.stem),
                derived=Derived(
                    kind="views",
                    source_episode=episode.info.id,
                    source_sha256=episode.sha256(),
                    scene_hash=job.scene_hash,
                    engine="robot-gst splat",
                    settings=job.settings(),
                ),
            )
            for choice in own:
                for frame, view in _rendered(choice, rasteriser, job.cloud):
                    _write_view(writer, choice, frame, view)
                    numbers.append(_numbers(choice, frame, view, _static_mask(frame, job)))
                    advance(len(numbers), f"{numbers[-1].psnr_db:.1f} dB")
    return numbers


def _rendered(
    choice: FrameChoice, rasteriser: Rasteriser, cloud: GaussianCloud
) -> Iterator[tuple[RgbdFrame, View]]:
    for frame in load(choice, choice.holdout_ns):
        yield frame, rasteriser.view(cloud, frame.color_camera, frame.T_base_color)


def _static_mask(frame: RgbdFrame, job: ViewsJob) -> np.ndarray:
    """Pixels of a held-out frame that no training frame looks through."""
    surface = FrameSurface(frame, job.limits)
    moving = find_moving([surface.points()], job.witnesses)
    return moving.mask_in(training_view(surface)).full.static_mask


def one_camera(frame: RgbdFrame) -> bool:
    """Say whether colour and depth have the same pixels."""
    return frame.color_camera == frame.depth_camera and bool(
        np.allclose(frame.T_base_color, frame.T_base_depth, atol=1e-6)
    )


def _write_view(writer: EpisodeWriter, choice: FrameChoice, frame: RgbdFrame, view: View) -> None:
    cell = choice.episode.info.cell or "cell"
    topic = f"/{cell}/views/cam/{frame.camera_id}"
    frame_id = streams.camera_info(choice.episode, frame.camera_id).frame_id
    stamp = frame.stamp_ns

    def put(tail: str, data: bytes, type_name: str) -> None:
        writer.write(
            f"{topic}/{tail}", data, type_name=type_name, log_time_ns=stamp, publish_time_ns=stamp
        )

    def png(image_u8: np.ndarray) -> bytes:
        return CompressedColor(
            stamp_ns=stamp, frame_id=frame_id, format="png", data=encode_png(image_u8)
        ).to_cdr()

    def depth(depth_m: np.ndarray) -> bytes:
        millimetres = np.clip(np.rint(depth_m * 1e3), 0, 65535).astype(np.uint16)
        return DepthImage(stamp_ns=stamp, frame_id=frame_id, depth_mm=millimetres).to_cdr()

    info = CameraInfo(stamp_ns=stamp, frame_id=frame_id, camera=frame.color_camera)
    put("color/info", info.to_cdr(), schema.CAMERA_INFO)
    put("recorded/image", png(frame.image_u8), schema.COMPRESSED_IMAGE)
    put("rendered/image", png(view.image_u8()), schema.COMPRESSED_IMAGE)
    put("rendered/depth", depth(view.depth_m), schema.IMAGE)
    if one_camera(frame):
        put("recorded/depth", depth(frame.depth_m), schema.IMAGE)


def _numbers(
    choice: FrameChoice, frame: RgbdFrame, view: View, static_mask: np.ndarray
) -> ViewNumbers:
    squared = np.square((view.image_u8().astype(np.float64) - frame.image_u8) / 255.0)
    depth_error = None
    if one_camera(frame):
        both = (frame.depth_m > 0) & (view.depth_m > 0)
        if both.any():
            depth_error = float(np.abs(frame.depth_m[both] - view.depth_m[both]).mean())
    return ViewNumbers(
        episode=choice.episode.info.id,
        camera_id=frame.camera_id,
        stamp_ns=frame.stamp_ns,
        still_camera=choice.still,
        psnr_db=psnr_db(float(squared.mean())),
        static_psnr_db=psnr_db(float(squared[static_mask].mean())) if static_mask.any() else None,
        static_fraction=float(static_mask.mean()),
        depth_mean_abs_m=depth_error,
        coverage_fraction=float(view.alpha.mean()),
    )


def encode_png(image_u8: np.ndarray) -> bytes:
    """Compress an sRGB image without loss."""
    from PIL import Image  # noqa: PLC0415  # heavy, only where images are written

    buffer = io.BytesIO()
    Image.fromarray(image_u8).save(buffer, format="png", compress_level=3)
    return buffer.getvalue()
