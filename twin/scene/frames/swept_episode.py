"""Scans without depth: estimate it from posed images, and keep it as a derived episode.

The derived episode holds the colour images that are used, their poses as they were recorded, and
depth by plane sweep at a smaller size; everything after reads it as any RGB-D scan. Images that are
held out have no depth in it and give none to others.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bridge.episode import provenance, schema, streams
from bridge.episode.cdr.codec import decode
from bridge.episode.cdr.messages import (
    CameraInfo,
    DepthImage,
    FrameTransform,
    color_from_message,
    stamp_of,
    transforms_to_cdr,
)
from bridge.episode.metadata import Derived
from bridge.episode.reader import Episode, RawMessage
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import (
    COLOR_IMAGE,
    COLOR_INFO,
    DEPTH_IMAGE,
    DEPTH_INFO,
    TF,
    camera_topic,
)
from bridge.episode.transforms import TransformTree
from bridge.episode.writer import EpisodeWriter
from bridge.errors import BridgeError
from bridge.geometry.cameras_view import distance_to_what_is_seen
from bridge.terminal import Output
from twin.scene.frames.camera_poses import base_tree, unknown_mask
from twin.scene.frames.plane_sweep import PosedView, posed_view, sweep
from twin.scene.frames.selection import NoFramesError, Sources, cameras_with, find_sources, spread
from twin.scene.settings import FrameConfig

ENGINE = "plane sweep"
SWEEP_VERSION = 1
"""Counts changes of method that make kept depth out of date."""
NEAR, FAR = 0.4, 3.0
"""Depths that are tried where the import did not say, times the distance the cameras look at."""
SLACK = 1.4
"""How far beyond the range that the import said."""
LEAST_IMAGES = 3
MAX_MM = 65535


def find_or_sweep_sources(run: RunFolder, config: FrameConfig, output: Output) -> Sources:
    """The run's RGB-D scans; where there are none, its posed colour scans with estimated depth.

    Raises:
        NoFramesError: When there is neither.
    """
    try:
        return find_sources(run)
    except NoFramesError:
        scans = _posed_scans(run)
        if not scans:
            raise
    made = tuple(_with_depth(run, scan, config, output) for scan in scans)
    metric = all(scan.is_metric for scan in scans)
    remark = "no depth was recorded: it is estimated by plane sweep between the images"
    if not metric:
        remark += "; lengths are not metric"
    return Sources(episodes=made, remark=remark)


@dataclass(frozen=True, kw_only=True)
class _PosedScan:
    """A scan whose cameras have colour, intrinsics and poses, and no depth."""

    episode: Episode
    tree: TransformTree
    infos: Mapping[str, CameraInfo]
    """Of its cameras."""

    @property
    def source(self) -> dict[str, Any]:
        """What the import said of it."""
        return self.episode.metadata_records.get("source", {})

    @property
    def is_metric(self) -> bool:
        return bool(self.source.get("is_metric", True))


def _posed_scans(run: RunFolder) -> list[_PosedScan]:
    found = []
    for path in run.episodes():
        try:
            episode = Episode.open(path)
            if episode.info.kind != "scan":
                continue
            tree = base_tree(episode)
            infos = {
                camera_id: streams.camera_info(episode, camera_id)
                for camera_id in cameras_with(episode, (COLOR_INFO,))
            }
        except BridgeError:
            continue
        posed = {name: info for name, info in infos.items() if info.frame_id in tree.frames()}
        if posed:
            found.append(_PosedScan(episode=episode, tree=tree, infos=posed))
    return found


@dataclass(frozen=True, kw_only=True)
class _Image:
    """One colour image that is used."""

    camera_id: str
    stamp_ns: int
    message: RawMessage
    view: PosedView
    is_held_out: bool


def _with_depth(run: RunFolder, scan: _PosedScan, config: FrameConfig, output: Output) -> Episode:
    """The derived episode, made unless it is there."""
    settings = {
        "version": SWEEP_VERSION,
        "holdout_every": config.holdout_every,
        "first_holdout": config.first_holdout,
        "max_train_frames": config.max_train_frames,
        "max_holdout_frames": config.max_holdout_frames,
    }
    source_sha256 = scan.episode.sha256()
    key = provenance.hash_settings(settings | {"source": source_sha256})[:8]
    path = run.derived_dir / f"{scan.episode.path.stem}.depth.{key}.mcap"
    if path.is_file():
        return Episode.open(path)
    output.say("no depth was recorded: estimate it by plane sweep between the images")
    images = _images(scan, config, output)
    training = [image.view for image in images if not image.is_held_out]
    if len(training) < LEAST_IMAGES:
        message = (
            f"{scan.episode.path} has {len(training)} posed images to learn from; depth needs "
            f"{LEAST_IMAGES} of them that show the same from different places."
        )
        raise NoFramesError(message)
    near, far = _range(scan, training)
    with output.progress("estimate depth", len(training)) as advance:
        depths = iter(sweep(training, near, far, lambda done: advance(done, "")))
    run.derived_dir.mkdir(exist_ok=True)
    derived = Derived(
        kind="depth",
        source_episode=scan.episode.info.id,
        source_sha256=source_sha256,
        engine=ENGINE,
        settings=settings | {"near_m": near, "far_m": far, "is_metric": scan.is_metric},
    )
    _write(run, path.name, scan, images, depths, derived)
    return Episode.open(path)


def _images(scan: _PosedScan, config: FrameConfig, output: Output) -> list[_Image]:
    """The images that are used, spread over each camera's path, held-out ones among them."""
    most = config.max_train_frames + min(
        config.max_holdout_frames, config.max_train_frames // (config.holdout_every - 1)
    )
    found: list[_Image] = []
    for camera_id, info in scan.infos.items():
        found_topic = streams.find_camera_topic(scan.episode, camera_id, "color/image")
        topics = [found_topic] if found_topic else []
        stamps = np.array(
            [stamp_of(decode(m.type_name, m.data)) for m in scan.episode.messages(topics)]
        )
        posed = stamps[~unknown_mask(scan.tree, [info.frame_id], stamps)]
        chosen = spread(np.unique(posed), max(1, most // len(scan.infos))).tolist()
        held = set(chosen[config.first_holdout :: config.holdout_every])
        wanted = set(chosen)
        for message in scan.episode.messages(topics):
            color = color_from_message(message.type_name, message.data)
            if color.stamp_ns not in wanted:
                continue
            wanted.remove(color.stamp_ns)
            T = scan.tree.T_root_frame(info.frame_id, color.stamp_ns)
            image = _Image(
                camera_id=camera_id,
                stamp_ns=color.stamp_ns,
                message=message,
                view=posed_view(color.image_u8(), info.camera, T),
                is_held_out=color.stamp_ns in held,
            )
            found.append(image)
    return sorted(found, key=lambda image: image.stamp_ns)


def _range(scan: _PosedScan, views: Sequence[PosedView]) -> tuple[float, float]:
    """Least and most depth to try [m]."""
    imported = scan.source.get("depth_range_m")
    if imported:
        return float(imported[0]) / SLACK, float(imported[1]) * SLACK
    Ts = np.stack([view.T_world_camera for view in views])
    distance = distance_to_what_is_seen(Ts)
    if distance is None:
        span = float(np.linalg.norm(np.ptp(Ts[:, :3, 3], axis=0)))
        distance = max(span, 1e-3)  # cameras that look apart see a room they walk about in
    return NEAR * distance, FAR * distance


def _write(
    run: RunFolder,
    name: str,
    scan: _PosedScan,
    images: Sequence[_Image],
    depths: Iterator[np.ndarray],
    derived: Derived,
) -> None:
    cell = scan.episode.info.cell or "scene"
    info = replace(scan.episode.info, id=name.removesuffix(".mcap"))
    begun: set[str] = set()
    with EpisodeWriter(run.derived_dir / name) as writer:
        writer.describe(info, derived=derived)
        for image in images:
            shape = image.view.features.shape[1:]
            depth_m = np.zeros(shape) if image.is_held_out else next(depths)
            color = scan.infos[image.camera_id]
            topic = camera_topic(cell, image.camera_id)
            millimetres = np.clip(np.rint(depth_m * 1e3), 0, MAX_MM).astype(np.uint16)
            depth = DepthImage(
                stamp_ns=image.stamp_ns, frame_id=color.frame_id, depth_mm=millimetres
            )
            pose = FrameTransform(
                stamp_ns=image.stamp_ns,
                parent=scan.tree.root_of(color.frame_id),
                child=color.frame_id,
                T_parent_child=image.view.T_world_camera,
            )
            messages = [
                (TF, transforms_to_cdr([pose]), schema.TF_MESSAGE),
                (topic + COLOR_IMAGE, image.message.data, image.message.type_name),
                (topic + DEPTH_IMAGE, depth.to_cdr(), schema.IMAGE),
            ]
            if image.camera_id not in begun:
                begun.add(image.camera_id)
                small = replace(color, camera=image.view.camera)
                messages = [
                    (topic + COLOR_INFO, color.to_cdr(), schema.CAMERA_INFO),
                    (topic + DEPTH_INFO, small.to_cdr(), schema.CAMERA_INFO),
                    *messages,
                ]
            for where, data, type_name in messages:
                writer.write(where, data, type_name=type_name, log_time_ns=image.stamp_ns)
