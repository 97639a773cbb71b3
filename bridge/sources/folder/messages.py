"""An RGB-D folder as the messages of a live camera.

Three layouts are told apart by their files: our own index ``scene.json``, the lists of the TUM
RGB-D benchmark (``rgb.txt`` and ``depth.txt``), and the numbered files of
7-Scenes (``frame-000000.color.png``). ``docs/rgbd_folder.md`` describes each.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16

from bridge.clock import ns_from_s
from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.episode.provenance import hash_file
from bridge.episode.schema import StampedMessage
from bridge.episode.topics import COLOR_IMAGE, DEPTH_IMAGE, TF, TF_STATIC, camera_topic
from bridge.errors import PathNotFoundError, UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.depth import to_millimetres
from bridge.sources.folder.config import DEFAULT_RATE_HZ, FolderConfig, FolderError
from bridge.sources.folder.frames import (
    FolderFrame,
    FolderIndex,
    StoredColor,
    camera_of,
    check_size,
    pose_of,
    read_color,
    read_stored_depth,
    require_image,
)
from bridge.sources.folder.scene_json import INDEX_NAME, read_scene
from bridge.sources.folder.transforms import TRANSFORMS, read_transforms
from bridge.sources.folder.tum import find_lists, read_tum

DEFAULTS = FolderConfig()


def read_index(folder: Path, config: FolderConfig = DEFAULTS) -> FolderIndex:
    """Find out a folder's layout and read it; every image it names must exist."""
    if not folder.is_dir():
        raise PathNotFoundError(
            path=folder, what="RGB-D folder", hint="Give a folder of one of the known layouts."
        )
    if (folder / INDEX_NAME).is_file():
        return read_scene(folder, config)
    if (folder / TRANSFORMS).is_file():
        return read_transforms(folder, config)
    if find_lists(folder):
        return read_tum(folder, config)
    if find_frames(folder):
        return read_sevenscenes(folder, config)
    hint = "robot-gst open says what is there; docs/rgbd_folder.md has the layouts."
    raise PathNotFoundError(path=folder / INDEX_NAME, what="index", hint=hint)


WORLD = "world"
INFO_PERIOD_S = 1.0
"""Calibration and static transforms are repeated this often [s]."""


def frame_times_ns(index: FolderIndex, config: FolderConfig) -> list[tuple[int, int]]:
    """Stamps of colour and depth of every frame [ns]: real times, or the rate asked for, from 0.

    Raises:
        UsageError: When a rate is asked of a folder that has real times.
    """
    if not index.has_times:
        period_ns = ns_from_s(1.0 / (config.rate_hz or DEFAULT_RATE_HZ))
        return [(number * period_ns, number * period_ns) for number in range(len(index.frames))]
    if config.rate_hz is not None:
        raise UsageError(
            f"--rate-hz {config.rate_hz:g} was given, but {index.path} says when each frame was "
            "taken. Leave the option out."
        )
    return [(frame.color_stamp_ns or 0, frame.depth_stamp_ns or 0) for frame in index.frames]


def describe_folder(index: FolderIndex, config: FolderConfig) -> dict[str, Any]:
    """What an episode's metadata says about the folder it came from."""
    rate_hz = config.rate_hz or DEFAULT_RATE_HZ
    nominal = f"nominal, {rate_hz:g} Hz from 0; the folder has none"
    return {
        "folder": index.name,
        "layout": index.layout,
        "index_sha256": hash_file(index.path) if index.path.is_file() else None,
        "depth_unit_m": index.depth_unit_m,
        "depth_rounded_to_m": 1e-3,
        "frames_left_out_without_pose": index.num_unposed,
        "frames_left_out_without_depth": index.num_unpaired,
        "times": "the folder's own" if index.has_times else nominal,
        "assumed": index.assumed,
    }


def folder_messages(index: FolderIndex, config: FolderConfig) -> Iterator[list[StampedMessage]]:
    """Yield the messages of one frame after another."""
    times = frame_times_ns(index, config)
    poses = _pose_messages(index, config, times)
    pose = next(poses, None)
    color_camera: Camera | None = None
    next_info_ns = min(times[0])
    for number, (frame, stamps) in enumerate(zip(index.frames, times, strict=True), start=1):
        color = read_color(frame.color_path)
        if color_camera is None:
            shown = color.image_u8.shape[1] / index.depth_camera.width
            color_camera = index.color_camera or index.depth_camera.scaled(shown)
        check_size(frame.color_path, color.image_u8.shape[:2], color_camera)
        messages = []
        if min(stamps) >= next_info_ns:
            messages += _calibration(index, config, color_camera, min(stamps))
            next_info_ns = min(stamps) + ns_from_s(INFO_PERIOD_S)
        while pose is not None and (pose.stamp_ns <= max(stamps) or number == len(times)):
            messages.append(pose)
            pose = next(poses, None)
        messages += _images(index, config, frame, color, stamps)
        yield sorted(messages, key=lambda message: message.stamp_ns)


def _pose_messages(
    index: FolderIndex, config: FolderConfig, times: list[tuple[int, int]]
) -> Iterator[StampedMessage]:
    """One pose per frame, or all that the folder has from before the first to after the last."""
    if index.poses is None:
        stamps = [color_ns for color_ns, _ in times]
        transforms = [frame.T_world_depth for frame in index.frames]
    else:
        inside = index.poses.stamps_ns
        ends = [at for pair in times for at in pair]
        first = max(int(np.searchsorted(inside, min(ends), side="right")) - 1, 0)
        last = int(np.searchsorted(inside, max(ends))) + 1
        stamps = [int(at) for at in inside[first:last]]
        transforms = list(index.poses.transforms()[first:last])
    for stamp_ns, T_world_depth in zip(stamps, transforms, strict=True):
        pose = FrameTransform(
            stamp_ns=stamp_ns,
            parent=WORLD,
            child=f"{config.camera}_depth_optical",
            T_parent_child=T_world_depth,
        )
        yield stamped(TF, schema.TF_MESSAGE, transforms_to_cdr([pose]), stamp_ns)


def _images(
    index: FolderIndex,
    config: FolderConfig,
    frame: FolderFrame,
    color: StoredColor,
    stamps: tuple[int, int],
) -> list[StampedMessage]:
    color_ns, depth_ns = stamps
    prefix = camera_topic(config.cell, config.camera)
    image = CompressedColor(
        stamp_ns=color_ns,
        frame_id=f"{config.camera}_color_optical",
        format="jpeg",
        data=color.as_jpeg(),
    )
    seen = stamped(f"{prefix}{COLOR_IMAGE}", schema.COMPRESSED_IMAGE, image.to_cdr(), color_ns)
    if frame.depth_path is None:
        return [seen]
    depth_mm, frame_id = _read_depth(index, frame.depth_path), f"{config.camera}_depth_optical"
    depth = DepthImage(stamp_ns=depth_ns, frame_id=frame_id, depth_mm=depth_mm)
    return [stamped(f"{prefix}{DEPTH_IMAGE}", schema.IMAGE, depth.to_cdr(), depth_ns), seen]


def _calibration(
    index: FolderIndex, config: FolderConfig, color_camera: Camera, stamp_ns: int
) -> list[StampedMessage]:
    messages = []
    for stream, camera in (("depth", index.depth_camera), ("color", color_camera)):
        frame_id = f"{config.camera}_{stream}_optical"
        info = CameraInfo(stamp_ns=stamp_ns, frame_id=frame_id, camera=camera)
        topic = camera_topic(config.cell, config.camera, f"/{stream}/info")
        messages.append(stamped(topic, schema.CAMERA_INFO, info.to_cdr(), stamp_ns))
    between = FrameTransform(
        stamp_ns=stamp_ns,
        parent=f"{config.camera}_depth_optical",
        child=f"{config.camera}_color_optical",
        T_parent_child=index.T_depth_color,
    )
    messages.append(stamped(TF_STATIC, schema.TF_MESSAGE, transforms_to_cdr([between]), stamp_ns))
    return messages


def stamped(topic: str, type_name: str, data: bytes, stamp_ns: int) -> StampedMessage:
    """Name what a message is."""
    return StampedMessage(topic=topic, type_name=type_name, data=data, stamp_ns=stamp_ns)


def _read_depth(index: FolderIndex, path: Path) -> UInt16[np.ndarray, "height width"]:
    stored = read_stored_depth(path)
    check_size(path, stored.shape, index.depth_camera)
    depth_mm = to_millimetres(
        stored,
        unit_m=index.depth_unit_m,
        invalid_values=index.depth_invalid_values,
        encoding=index.depth_encoding,
    )
    was_measured = ~np.isin(stored, [0, *index.depth_invalid_values])
    if was_measured.any() and not depth_mm.any():
        raise FolderError(
            path=path,
            found=f"with {index.depth_unit_m:g} m for each stored number no pixel lies between "
            "0.5 mm and 65.5 m",
            hint="Correct the unit: depth_unit_m in scene.json, else --depth-unit-m.",
        )
    return depth_mm


# 7-Scenes: depth is in millimetres, 65535 and 0 are "no measurement"; a pose is camera-to-world, in
# metres (Shotton et al., CVPR 2013). Its makers give 585, 585, 320, 240 for the depth camera and
# nothing for the colour camera, whose images are not registered to depth: that is taken as nominal
# and said so. TSDF-fusion copies of the data add a camera-intrinsics.txt of the depth camera.

DEPTH_UNIT_M = 1e-3
INVALID_VALUES = (0, 65535)
DEPTH_INTRINSICS = (585.0, 585.0, 320.0, 240.0)
"""As the data set's makers state them [px]."""
COLOR_INTRINSICS = (525.0, 525.0, 319.5, 239.5)
"""Nominal for the colour camera of a Kinect v1 [px]; the makers give none."""
T_COLOR_DEPTH_NOMINAL_M = (-0.025, 0.0, 0.0)
"""The colour camera of a Kinect v1 sits 25 mm beside the depth camera by design."""
INTRINSICS_FILE = "camera-intrinsics.txt"
_COLOR_NAME = re.compile(r"frame-(\d+)\.color\.(png|jpg|jpeg)")


def find_frames(folder: Path) -> list[Path]:
    """Return the colour images of the layout, in order of their numbers."""
    found = [
        (int(match[1]), path)
        for path in folder.glob("frame-*.color.*")
        if (match := _COLOR_NAME.fullmatch(path.name))
    ]
    return [path for _, path in sorted(found)]


def read_sevenscenes(folder: Path, config: FolderConfig) -> FolderIndex:
    """Read a sequence folder."""
    frames, depth_paths, num_unposed = list[FolderFrame](), list[Path](), 0
    for color_path in find_frames(folder):
        stem = color_path.name.split(".")[0]
        depth_path = require_image(
            folder / f"{stem}.depth.png", what="depth", named_by=f"{color_path.name} belongs to it"
        )
        pose_path, T_world_depth = folder / f"{stem}.pose.txt", None
        if pose_path.is_file():
            T_world_depth = pose_of(pose_path, _matrix(pose_path, (4, 4)), "the pose")
        if T_world_depth is None:
            num_unposed += 1
            continue
        depth_paths.append(depth_path)
        frames.append(
            FolderFrame(color_path=color_path, depth_path=depth_path, T_world_depth=T_world_depth)
        )
    if not frames:
        raise FolderError(
            path=folder, found="no frame has a pose", hint="Add frame-XXXXXX.pose.txt files."
        )
    size = read_stored_depth(depth_paths[0]).shape[::-1]
    given = _read_intrinsics(folder / INTRINSICS_FILE)
    depth, color = config.depth_intrinsics or given, config.color_intrinsics
    T_color_depth = se3.from_rotation(np.eye(3), T_COLOR_DEPTH_NOMINAL_M)
    return FolderIndex(
        path=folder,
        layout="7-Scenes",
        name=folder.resolve().name,
        depth_unit_m=config.depth_unit_m or DEPTH_UNIT_M,
        depth_invalid_values=INVALID_VALUES,
        depth_encoding="",
        depth_camera=camera_of(
            depth, DEPTH_INTRINSICS, size, option="--depth-intrinsics", path=folder
        ),
        color_camera=camera_of(
            color, COLOR_INTRINSICS, size, option="--color-intrinsics", path=folder
        ),
        T_depth_color=se3.invert(T_color_depth),
        frames=tuple(frames),
        num_unposed=num_unposed,
        assumed=_assumed(config, given_by_file=given is not None),
    )


def _assumed(config: FolderConfig, *, given_by_file: bool) -> dict[str, str]:
    assumed = {"color_from_depth": "25 mm beside the depth camera, nominal, not measured"}
    if config.depth_intrinsics is None:
        assumed["depth_intrinsics"] = (
            f"from {INTRINSICS_FILE}" if given_by_file else f"{DEPTH_INTRINSICS}, the makers'"
        )
    if config.color_intrinsics is None:
        assumed["color_intrinsics"] = f"{COLOR_INTRINSICS}, nominal, not measured"
    return assumed


def _read_intrinsics(path: Path) -> tuple[float, float, float, float] | None:
    if not path.is_file():
        return None
    K = _matrix(path, (3, 3))
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise FolderError(
            path=path, found="no camera matrix", hint="It reads fx 0 cx / 0 fy cy / 0 0 1 [px]."
        )
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _matrix(path: Path, shape: tuple[int, int]) -> Float[np.ndarray, "rows columns"]:
    rows = [line.split() for line in path.read_text(errors="replace").splitlines() if line.strip()]
    try:
        numbers = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise FolderError(path=path, found=f"not a matrix of numbers ({error})") from error
    if numbers.shape != shape:
        found = f"{len(rows)} rows of numbers, expected {shape[0]} x {shape[1]}"
        raise FolderError(path=path, found=found)
    return numbers
