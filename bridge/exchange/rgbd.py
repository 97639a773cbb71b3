"""Folders of RGB-D images: read into a scan episode without the wire, and written in TUM's layout.

Written colour is as it was recorded (JPEG bytes) or PNG; depth is 16-bit PNG with 5000 per metre,
so that whole millimetres survive exactly up to 13.107 m. Stamps keep nine decimals. Poses are
``T_base_color`` at the time of every colour and every depth image. The layout has no place for
intrinsics: ``camera.json`` beside the lists holds them, and ``import rgbd`` reads it back.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bridge.episode import streams
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    RawColor,
    color_from_message,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.episode.schema import StampedMessage
from bridge.episode.transforms import TransformTree
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError
from bridge.exchange.csv_export import seconds_text
from bridge.exchange.output import message_named, new_folder, safe_names, write_note
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import JPEG_MAGIC, encode_png
from bridge.terminal import Advance

STORED_PER_MM = 5
MAX_MM = 65535 // STORED_PER_MM
"""Beyond 13.107 m a depth does not fit in 16 bits at 5000 per metre."""


class Stamped(NamedTuple):
    """One written image."""

    stamp_ns: int
    name: str


@dataclass(kw_only=True)
class CameraReport:
    """What was written of one camera."""

    folder: str
    colors: list[Stamped] = field(default_factory=list)
    depths: list[Stamped] = field(default_factory=list)
    depth_too_far: int = 0
    """Pixels beyond 13.107 m, written as "no measurement"."""
    straightened: str = ""
    """What was done to its images, where a lens bent them."""


def export_tum(
    episode: Episode, out: Path, *, camera: str | None, force: bool, advance: Advance
) -> list[CameraReport]:
    """Write one camera into ``out`` itself, several into one folder each."""
    known = streams.camera_ids(episode)
    wanted = known if camera is None else [camera]
    if not wanted or not set(wanted) <= set(known):
        raise EpisodeError(
            path=episode.path,
            found="no colour images" if not known else f"no camera {camera!r}",
            hint=f"Cameras here: {', '.join(known) or 'none'}.",
        )
    tree = streams.transform_tree(episode)
    reports: list[CameraReport] = []
    with new_folder(out, force=force) as folder:
        for name, place_name in safe_names(wanted).items():
            place = folder if len(wanted) == 1 else folder / place_name
            reports.append(_write_camera(episode, name, tree, place, advance))
        choices = {
            "color": "JPEG as recorded, PNG of others and of those through a lens",
            "depth": "16-bit PNG, 5000 per metre",
            "poses": "groundtruth.txt is T_base_color at every colour and depth stamp",
            "cameras": {
                name: {
                    "folder": report.folder,
                    "depth_pixels_too_far": report.depth_too_far,
                    "lens": report.straightened,
                }
                for name, report in zip(wanted, reports, strict=True)
            },
        }
        write_note(folder, made_by="export tum", sources=[episode.path], choices=choices)
    return reports


def _write_camera(
    episode: Episode, name: str, tree: TransformTree, place: Path, advance: Advance
) -> CameraReport:
    report = CameraReport(folder=place.name)
    info = streams.camera_info(episode, name, "color")
    for part in ("rgb", "depth"):
        (place / part).mkdir(parents=True, exist_ok=True)
    kinds = ("color", "depth")
    topics = [streams.find_camera_topic(episode, name, f"{kind}/image") for kind in kinds]
    lenses = [streams.lens_of(episode, name, kind) for kind in kinds]
    report.straightened = "" if info.lens is None else info.lens.said
    counts = dict.fromkeys(topics, 0)
    for message in episode.messages([topic for topic in topics if topic is not None]):
        counts[message.topic] += 1
        with message_named(episode, message.topic, counts[message.topic]):
            if message.topic == topics[0]:
                image = color_from_message(message.type_name, message.data, lenses[0])
                report.colors.append(_write_color(place, image))
            else:
                depth = DepthImage.from_message(message.type_name, message.data, lenses[1])
                item, too_far = _write_depth(place, depth)
                report.depths.append(item)
                report.depth_too_far += too_far
        advance(len(report.colors) + len(report.depths), message.topic)
    _write_list(place / "rgb.txt", "color images", report.colors)
    _write_list(place / "depth.txt", "depth maps", report.depths)
    stamps = sorted({item.stamp_ns for item in report.colors + report.depths})
    _write_poses(place / "groundtruth.txt", tree, info.frame_id, stamps)
    _write_cameras(place / "camera.json", episode, name, tree, info)
    return report


def _write_color(place: Path, image: CompressedColor | RawColor) -> Stamped:
    data = image.data if isinstance(image, CompressedColor) and image.lens is None else b""
    ending = "jpg" if data[:2] == JPEG_MAGIC else "png"
    if ending == "png":
        data = encode_png(image.image_u8(), level=1)
    name = f"rgb/{seconds_text(image.stamp_ns)}.{ending}"
    (place / name).write_bytes(data)
    return Stamped(image.stamp_ns, name)


def _write_depth(place: Path, depth: DepthImage) -> tuple[Stamped, int]:
    too_far = depth.depth_mm > MAX_MM
    stored = np.where(too_far, 0, depth.depth_mm.astype(np.uint32) * STORED_PER_MM)
    name = f"depth/{seconds_text(depth.stamp_ns)}.png"
    (place / name).write_bytes(encode_png(stored.astype(np.uint16), level=1))
    return Stamped(depth.stamp_ns, name), int(too_far.sum())


def _write_list(path: Path, what: str, items: list[Stamped]) -> None:
    lines = [f"# {what}", "# timestamp filename"]
    lines += [f"{seconds_text(item.stamp_ns)} {item.name}" for item in sorted(items)]
    path.write_text("\n".join(lines) + "\n")


def _write_poses(path: Path, tree: TransformTree, frame: str, stamps: list[int]) -> None:
    lines = ["# poses T_base_color of the camera", "# timestamp tx ty tz qx qy qz qw"]
    for stamp_ns in stamps:
        q, p = se3.split(tree.T_root_frame(frame, stamp_ns))
        w, x, y, z = (float(value) for value in q)
        numbers = " ".join(repr(value) for value in (*map(float, p), x, y, z, w))
        lines.append(f"{seconds_text(stamp_ns)} {numbers}")
    path.write_text("\n".join(lines) + "\n")


def _write_cameras(
    path: Path, episode: Episode, name: str, tree: TransformTree, color: CameraInfo
) -> None:
    has_depth = streams.find_camera_topic(episode, name, "depth/info") is not None
    depth = streams.camera_info(episode, name, "depth") if has_depth else color
    T_color_depth = np.eye(4)
    if depth.frame_id != color.frame_id:
        # The two sit on one rig, so any instant gives the same transform.
        T_base_color = tree.T_root_frame(color.frame_id, episode.start_ns)
        T_base_depth = tree.T_root_frame(depth.frame_id, episode.start_ns)
        T_color_depth = se3.invert(T_base_color) @ T_base_depth
        if np.allclose(T_color_depth, np.eye(4), atol=1e-9):
            T_color_depth = np.eye(4)
    record = {
        "about": "intrinsics in px with pixel centres at whole numbers; T_color_depth carries "
        "points of the depth camera to the colour camera, metres",
        "color": _camera_record(color.camera),
        "depth": _camera_record(depth.camera),
        "T_color_depth": T_color_depth.tolist(),
    }
    path.write_text(json.dumps(record, indent=1) + "\n")


def _camera_record(camera: Camera) -> dict[str, int | float]:
    fx, fy, cx, cy = camera.to_ros()
    return {"width": camera.width, "height": camera.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}


def write_scan(
    run: RunFolder, info: EpisodeInfo, messages: Iterable[StampedMessage], *, source: dict[str, Any]
) -> Path:
    """Write one episode; on any error nothing with its final name is left.

    Messages come in time order, logged at their source time; ``source`` is kept as metadata.
    """
    check_episode_id(info.id)
    writer = EpisodeWriter(run.episodes_dir / f"{info.id}.mcap")
    try:
        writer.describe(info)
        for message in messages:
            writer.write(
                message.topic,
                message.data,
                type_name=message.type_name,
                log_time_ns=message.stamp_ns,
            )
        writer.add_metadata("source", {name: json.dumps(v) for name, v in source.items()})
        return writer.close()
    except BaseException:
        writer.discard()
        raise
