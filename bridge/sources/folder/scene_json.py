"""The index ``scene.json`` of an RGB-D folder: cameras, depth rules, frames and their poses.

Keys: ``depth_unit_m``, ``depth_invalid_values``, ``depth_intrinsics`` (OpenCV pixel centres),
``color_registered_to_depth`` with, where false, ``color_camera_estimate`` (intrinsics and
``t_color_from_depth_m``), optional ``depth_encoding``, and ``frames`` with ``color``, ``depth``
and ``T_world_cam`` (of the depth camera, metres, OpenCV axes; null where tracking was lost).
"""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.depth import ROTATED_ENCODING
from bridge.sources.folder.config import FolderConfig, FolderError
from bridge.sources.folder.frames import (
    FolderFrame,
    FolderIndex,
    checked_rotation,
    pose_of,
    refuse_bent,
    refuse_scale_without_use,
    require_image,
    unread,
)

INDEX_NAME = "scene.json"
_READ = {"name", "depth_unit_m", "depth_invalid_values", "depth_encoding", "depth_intrinsics"} | {
    *("color_registered_to_depth", "color_camera_estimate", "frames", "color", "depth"),
    *("T_world_cam", "id", "pose_convention", "note", "formula", "fx", "fy", "cx", "cy", "width"),
    *("height", "t_color_from_depth_m", "R_color_from_depth"),
}
"""Keys that are read, and those that say something to people."""
_KEYS_HINT = "docs/rgbd_folder.md lists the keys."


def read_scene(folder: Path, config: FolderConfig) -> FolderIndex:
    """Read and check ``scene.json``; every image file it names must exist."""
    path = folder / INDEX_NAME
    refuse_scale_without_use(config, path)
    try:
        return _read(folder, path, _load(path))
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        found = f"a value of another kind ({error})"
        raise FolderError(path=path, found=found, hint=_KEYS_HINT) from error


def _read(folder: Path, path: Path, record: dict[str, Any]) -> FolderIndex:
    registered = record.get("color_registered_to_depth", True)
    color_camera, T_depth_color = (None, np.eye(4)) if registered else _color(path, record)
    frames, num_unposed = _frames(path, record)
    parts = [record, *record["frames"]]
    for part in parts:
        refuse_bent(path, "the folder", part)
    parts += [part for part in record.values() if isinstance(part, dict)]
    keys = Counter(key for part in parts for key in part)
    return FolderIndex(
        path=path,
        layout="scene.json",
        name=str(record.get("name", folder.name)),
        depth_unit_m=_positive(path, record, "depth_unit_m"),
        depth_invalid_values=tuple(int(v) for v in record.get("depth_invalid_values", (0,))),
        depth_encoding=_encoding(path, record.get("depth_encoding", "")),
        depth_camera=_camera(path, record, "depth_intrinsics"),
        color_camera=color_camera,
        T_depth_color=T_depth_color,
        frames=frames,
        num_unposed=num_unposed,
        unused=tuple(unread(keys, _READ, {})),
    )


def _load(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise FolderError(
            path=path, found=f"not readable as JSON ({error})", hint="Repair the file."
        ) from error


def _value(path: Path, record: dict[str, Any], key: str) -> Any:
    if key not in record:
        there = ", ".join(sorted(record)) or "none"
        raise FolderError(
            path=path, found=f"key {key!r} is missing (there: {there})", hint=_KEYS_HINT
        )
    return record[key]


def _positive(path: Path, record: dict[str, Any], key: str) -> float:
    value = _value(path, record, key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise FolderError(
            path=path, found=f"{key} = {value!r}", hint="It must be a number above zero."
        )
    return float(value)


def _camera(path: Path, record: dict[str, Any], key: str) -> Camera:
    values = _value(path, record, key)
    refuse_bent(path, key, values)
    numbers = {name: _positive(path, values, name) for name in ("fx", "fy", "cx", "cy")}
    return Camera.from_ros(
        width=int(_positive(path, values, "width")),
        height=int(_positive(path, values, "height")),
        **numbers,
    )


def _encoding(path: Path, text: str) -> str:
    if not text:
        return ""
    if "rotated" in text.lower():
        return ROTATED_ENCODING
    raise FolderError(
        path=path,
        found=f"depth_encoding {text!r} is unknown",
        hint=f"Known: {ROTATED_ENCODING!r} (v = ((d>>3)|(d<<13)) & 0xFFFF), or leave the key out.",
    )


def _color(path: Path, record: dict[str, Any]) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
    """The colour camera and ``T_depth_color`` of a folder whose images are not registered."""
    estimate = dict(_value(path, record, "color_camera_estimate"))
    size = _value(path, record, "depth_intrinsics")
    for name in ("width", "height"):  # the estimate is for images of the depth camera's size
        estimate.setdefault(name, size.get(name) if isinstance(size, dict) else None)
    camera = _camera(path, {"color_camera_estimate": estimate}, "color_camera_estimate")
    T_color_depth = np.eye(4)
    T_color_depth[:3, 3] = _value(path, estimate, "t_color_from_depth_m")
    R_color_depth = estimate.get("R_color_from_depth", "identity assumed")
    if not isinstance(R_color_depth, str):
        T_color_depth[:3, :3] = checked_rotation(
            path, np.array(R_color_depth, dtype=float), "R_color_from_depth"
        )
    return camera, se3.invert(T_color_depth)


def _frames(path: Path, record: dict[str, Any]) -> tuple[tuple[FolderFrame, ...], int]:
    entries = _value(path, record, "frames")
    if not isinstance(entries, list) or not entries:
        raise FolderError(path=path, found="no frames", hint="List at least one frame.")
    found = [_frame(path, entry, f"frames[{number}]") for number, entry in enumerate(entries)]
    frames = [frame for frame in found if frame is not None]
    if not frames:
        raise FolderError(path=path, found="no frame has a pose", hint="Poses are T_world_cam.")
    return tuple(frames), len(entries) - len(frames)


def _frame(path: Path, entry: Any, where: str) -> FolderFrame | None:
    if not isinstance(entry, dict):
        raise FolderError(path=path, found=f"{where} is not an object", hint=_KEYS_HINT)
    if "depth" not in entry:
        raise FolderError(
            path=path,
            found="a frame has no depth image",
            hint="A scene is rebuilt from depth images.",
        )
    files = {name: path.parent / str(_value(path, entry, name)) for name in ("color", "depth")}
    for name, file in files.items():
        require_image(file, what=name, named_by=f"{path} names it in {where}")
    pose = _value(path, entry, "T_world_cam")
    T = None if pose is None else pose_of(path, pose, f"T_world_cam of {where}")
    if T is None:
        return None
    return FolderFrame(color_path=files["color"], depth_path=files["depth"], T_world_depth=T)
