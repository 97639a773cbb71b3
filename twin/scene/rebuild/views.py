"""Render held-out frames and keep them, recorded beside rendered, as a derived episode.

Topics, all with the stamp of the recorded frame and the frame id of its colour camera:
``/<cell>/views/cam/<id>/{recorded,rendered}/image`` (PNG), ``.../rendered/depth`` (16UC1),
``.../recorded/depth`` where depth and colour come from the same camera and
``.../recorded/depth_in_color`` where it was carried over, ``.../mask/{static,objects}`` (PNG, white
inside) where there is something to mask, and ``.../color/info``.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

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
from bridge.media.image_quality import aligned, as_float, psnr_db, ssim
from bridge.terminal import Advance
from twin.scene.backdrop import Backdrop
from twin.scene.dataset.masks import EgoMask, ReferenceView, find_moving
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, TrainingView, training_view
from twin.scene.frames.selection import FrameChoice, load
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, View
from twin.scene.render import seen_mask
from twin.scene.robot.extraction import DrivenRobot

VIEWS_NOTE = (
    "held out from initialisation, poses, exposure, fit and objects; means of the images' values; "
    "native resolution; raw: no colour alignment; gain_: one factor per image and channel, fitted "
    "to the recorded image; static_: without pixels that show something that moved; "
    "seen_: only pixels that show what was measured in the scan, not what was completed; the "
    "evaluator computes the official numbers from the views episode"
)
MOST_DB = 100.0
AVERAGED = (
    *("psnr_db", "static_psnr_db", "seen_psnr_db", "seen_fraction", "gain_psnr_db", "ssim"),
    *("depth_mean_abs_m", "depth_median_abs_m"),
)


@dataclass(frozen=True, kw_only=True)
class ViewNumbers:
    """How one held-out view came out."""

    episode: str
    camera_id: str
    stamp_ns: int
    stationary_camera: bool
    """The camera does not move, so training frames show the same view."""
    psnr_db: float
    """Over the whole image, as recorded: a robot in view counts as error."""
    static_psnr_db: float | None
    """Over the pixels that show nothing that moved; None when there are none."""
    static_fraction: float
    """Share of those pixels."""
    seen_psnr_db: float | None
    """Over the pixels that show what was measured in the scan, and not what was completed."""
    seen_fraction: float
    """Share of those pixels."""
    gain_psnr_db: float
    """Over the whole image, each channel brightened by the factor that fits best."""
    ssim: float
    """Structural similarity of the whole image, as the fit sees it (zero padding)."""
    depth_mean_abs_m: float | None
    """Against the recorded depth where nothing moved and both exist."""
    depth_median_abs_m: float | None
    """The same; most of the mean are silhouettes."""
    coverage_fraction: float
    """Mean alpha of the rendered image."""


def rate_view(
    frame: RgbdFrame,
    recorded: TrainingView,
    view: View,
    static_mask: Bool[np.ndarray, "height width"],
    seen: Bool[np.ndarray, "height width"],
    *,
    episode: str,
    stationary: bool,
) -> ViewNumbers:
    """Compare one rendered view with its recorded frame.

    Args:
        recorded: The same frame as the fit would have seen it; gives depth.
        static_mask: True where nothing moved.
    """
    rendered_u8 = view.image_u8()
    rendered, wanted = as_float(rendered_u8), as_float(frame.image_u8)
    both = (recorded.full.depth_m > 0) & (view.depth_m > 0)
    difference = np.abs(recorded.full.depth_m - view.depth_m)[both]
    return ViewNumbers(
        episode=episode,
        camera_id=frame.camera_id,
        stamp_ns=frame.stamp_ns,
        stationary_camera=stationary,
        psnr_db=finite_psnr_db(wanted, rendered),
        static_psnr_db=finite_psnr_db(wanted, rendered, static_mask) if static_mask.any() else None,
        static_fraction=float(static_mask.mean()),
        seen_psnr_db=finite_psnr_db(wanted, rendered, seen) if seen.any() else None,
        seen_fraction=float(seen.mean()),
        gain_psnr_db=finite_psnr_db(wanted, aligned(frame.image_u8, rendered_u8, "gain")),
        ssim=ssim(wanted, rendered, padding="zero"),
        depth_mean_abs_m=float(difference.mean()) if both.any() else None,
        depth_median_abs_m=float(np.median(difference)) if both.any() else None,
        coverage_fraction=float(view.alpha.mean()),
    )


def finite_psnr_db(
    wanted: Float[np.ndarray, "height width 3"],
    rendered: Float[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"] | None = None,
) -> float:
    """Peak signal-to-noise ratio, at most 100 dB: JSON has no word for identical images.

    Args:
        wanted: The recorded image, 0..1.
        rendered: The drawn image, 0..1.
        mask: Pixels that count; None: all of them.
    """
    try:
        return min(psnr_db(wanted, rendered, mask=mask), MOST_DB)
    except UndefinedStatisticError:
        return MOST_DB


def summarise_views(numbers: Sequence[ViewNumbers], files: Sequence[str]) -> dict[str, Any]:
    """Average the held-out views; cameras that stand still are kept apart."""
    moving = [item for item in numbers if not item.stationary_camera]
    stationary = [item for item in numbers if item.stationary_camera]
    averages = {
        f"{name}{ending}": _mean([getattr(item, name) for item in items])
        for ending, items in (("", moving), ("_still_cameras", stationary))
        for name in AVERAGED
    }
    return {
        "files": list(files),
        "note": VIEWS_NOTE,
        **averages,
        "num_images": len(moving),
        "num_images_still_cameras": len(stationary),
        "images": [asdict(item) for item in numbers],
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(float(np.mean(known)), 4) if known else None


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

    scene_hash: str
    cloud: GaussianCloud
    reference_views: Sequence[ReferenceView]
    limits: DepthLimits
    raster: RasterConfig
    protocol: Mapping[str, Any]
    """How the scene was made: kept with the images, for whoever rates them."""
    marked: GaussianCloud | None = None
    """The same scene with objects white and everything else black; None without objects."""
    robot: DrivenRobot | None = None
    """Drawn where it stood at each frame; the cloud holds only what is static."""
    ego_masks: Mapping[tuple[Path, str], EgoMask] = field(default_factory=dict)
    """By episode and camera: what moves with the camera and is not part of the scene."""
    backdrop: Backdrop | None = None
    """Stands behind everything; None: black."""

    def settings(self) -> dict[str, Any]:
        """What the derived episode records about how its views were made."""
        return {
            **self.protocol,
            "resolution": "native colour camera",
            "masks": "as separate topics; none applied",
            "alpha_cut": self.raster.alpha_cut,
        }


@dataclass(frozen=True, kw_only=True)
class HeldOutViews:
    """One held-out frame with everything that is said about it."""

    choice: FrameChoice
    frame: RgbdFrame
    recorded: TrainingView
    """The frame with what moved masked; nothing is trained on it."""
    view: View
    seen_mask: Bool[np.ndarray, "height width"]
    """Where the view shows what was measured in the scan."""
    masks: Mapping[str, Bool[np.ndarray, "height width"]] = field(default_factory=dict)


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
                    engine=ENGINE,
                    settings=job.settings(),
                ),
            )
            for choice in own:
                for item in _rendered(choice, rasteriser, job):
                    _write_view(writer, item)
                    numbers.append(
                        rate_view(
                            item.frame,
                            item.recorded,
                            item.view,
                            item.masks["static"],
                            item.seen_mask,
                            episode=choice.episode.info.id,
                            stationary=choice.stationary,
                        )
                    )
                    advance(len(numbers), f"{numbers[-1].psnr_db:.1f} dB")
    return numbers


def _rendered(choice: FrameChoice, rasteriser: Rasteriser, job: ViewsJob) -> Iterator[HeldOutViews]:
    for frame in load(choice, choice.holdout_ns):
        camera, T = frame.color_camera, frame.T_base_color
        cloud = job.cloud
        if job.robot is not None:
            cloud = job.robot.joined(cloud, choice.episode, frame.stamp_ns)
        recorded = _recorded(frame, job, job.ego_masks.get((choice.episode.path, choice.camera_id)))
        view = rasteriser.view(cloud, camera, T)
        seen = seen_mask(rasteriser, view.alpha, cloud)
        if job.backdrop is not None:
            view = job.backdrop.behind(view, camera, T)
        masks = {"static": recorded.full.static_mask}
        if job.marked is not None:
            planes = rasteriser.draw_planes(job.marked, camera, T)
            masks["objects"] = planes[0] > OBJECT_SHARE
        yield HeldOutViews(
            choice=choice,
            frame=frame,
            recorded=recorded,
            view=view,
            seen_mask=seen,
            masks=masks,
        )


def _recorded(frame: RgbdFrame, job: ViewsJob, ego_mask: EgoMask | None) -> TrainingView:
    """A held-out frame without what training frames look through or moves with the camera."""
    surface = FrameSurface(frame, job.limits)
    view, points = training_view(surface), surface.points()
    if ego_mask is not None:
        view, points = ego_mask.mask_in(view), ego_mask.drop_from(points, view)
    return find_moving([points], job.reference_views).mask_in(view)


def one_camera(frame: RgbdFrame) -> bool:
    """Say whether colour and depth have the same pixels."""
    return frame.color_camera == frame.depth_camera and bool(
        np.allclose(frame.T_base_color, frame.T_base_depth, atol=1e-6)
    )


def _write_view(writer: EpisodeWriter, item: HeldOutViews) -> None:
    choice, frame = item.choice, item.frame
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
        millimetres = np.clip(np.rint(depth_m * 1e3), 0, 65535).astype(np.uint16)
        image = DepthImage(stamp_ns=stamp, frame_id=frame_id, depth_mm=millimetres)
        put(tail, image.to_cdr(), schema.IMAGE)

    info = CameraInfo(stamp_ns=stamp, frame_id=frame_id, camera=frame.color_camera)
    put("color/info", info.to_cdr(), schema.CAMERA_INFO)
    png("recorded/image", frame.image_u8)
    png("rendered/image", item.view.image_u8())
    depth("rendered/depth", item.view.depth_m)
    if one_camera(frame):
        depth("recorded/depth", np.nan_to_num(frame.depth_m, posinf=0.0))
    else:
        depth("recorded/depth_in_color", item.recorded.full.depth_m)
    for name, mask in item.masks.items():
        if not mask.all():
            png(f"mask/{name}", np.repeat(mask[..., None], 3, axis=2).astype(np.uint8) * 255)
