"""The layout of NeRF programs: ``transforms.json``, with depth images beside colour or without.

Poses go from camera to world with OpenGL's axes (+Y up, +Z backwards); depth is registered to
colour. Lenses that bend straight lines are refused.
"""

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import PathNotFoundError
from bridge.geometry.camera import Camera
from bridge.sources.folder.config import FolderConfig, FolderError
from bridge.sources.folder.frames import (
    FolderFrame,
    FolderIndex,
    pose_of,
    read_stored_depth,
    refuse_bent,
    refuse_scale_without_use,
    unread,
)

TRANSFORMS = "transforms.json"
DEPTH_UNIT_M = 1e-3
"""Where ``depth_unit_scale_factor`` does not say it."""
MOST_PX = 65_500
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_READ = {"frames", "w", "h", "camera_angle_x", "fl_x", "fl_y", "cx", "cy"} | {
    *("file_path", "transform_matrix", "depth_file_path", "depth_unit_scale_factor")
}


def read_transforms(folder: Path, config: FolderConfig) -> FolderIndex:
    """Read and check ``transforms.json``; every image file it names must exist."""
    path = folder / TRANSFORMS
    refuse_scale_without_use(replace(config, depth_unit_m=None), path)
    record, entries = _load(path)
    keys = Counter(record.keys())
    frames, cameras, assumed = [], set(), {"registration": "any depth is registered to colour"}
    for number, frame in enumerate(entries, start=1):
        if not isinstance(frame, dict):
            raise FolderError(path=path, found=f"frame {number} is no object")
        keys.update(frame.keys())
        camera, is_centred = _frame_camera(path, number, {**record, **frame})
        cameras.add(camera)
        if is_centred:
            assumed["principal point"] = "the centre of the image"
        depth = frame.get("depth_file_path")
        frames.append(
            FolderFrame(
                color_path=_image_below(folder, str(frame.get("file_path", ""))),
                depth_path=_image_below(folder, str(depth)) if depth else None,
                T_world_depth=_frame_pose(path, number, frame),
            )
        )
    if len(cameras) != 1:
        found = f"{len(cameras)} different cameras in {len(frames)} frames"
        raise FolderError(path=path, found=found, hint="One folder is of one camera; split it.")
    (camera,) = cameras
    depths = [frame.depth_path for frame in frames if frame.depth_path is not None]
    shown = read_stored_depth(depths[0]).shape[1] if depths else camera.width
    unit = config.depth_unit_m or record.get("depth_unit_scale_factor", DEPTH_UNIT_M)
    return FolderIndex(
        path=path,
        layout=TRANSFORMS,
        name=folder.resolve().name,
        depth_unit_m=_number(path, unit, "depth_unit_scale_factor"),
        depth_invalid_values=(0,),
        depth_encoding="",
        depth_camera=camera.scaled(shown / camera.width),
        color_camera=camera,
        T_depth_color=np.eye(4),
        frames=tuple(sorted(frames, key=lambda frame: str(frame.color_path))),
        num_unposed=0,
        assumed=assumed,
        unused=tuple(unread(keys, _READ, {})),
    )


def _load(path: Path) -> tuple[dict[str, Any], list[Any]]:
    try:
        record = json.loads(path.read_text())
        return record, list(record["frames"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise FolderError(path=path, found=f"no list of frames ({error})") from error


def _image_below(folder: Path, name: str) -> Path:
    """Where an image is, its ending left out or not; nothing outside the folder is read."""
    root, endings = folder.resolve(), ("",) if Path(name).suffix else (".png", ".jpg", ".jpeg")
    for ending in endings:
        try:
            found = (folder / f"{name}{ending}").resolve()
            if found.is_file() and found.is_relative_to(root):
                return found
        except (OSError, ValueError):  # too long for a name, or with a NUL in it
            continue
    hint = f"{TRANSFORMS} names it; restore it inside the folder, or remove the frame."
    raise PathNotFoundError(path=folder / name, what="image", hint=hint)


def _frame_camera(path: Path, number: int, record: dict[str, Any]) -> tuple[Camera, bool]:
    """The camera of one frame, and whether its principal point had to be assumed."""
    what = f"frame {number}"
    refuse_bent(path, what, record)
    missing = [key for key in ("w", "h") if key not in record]
    if missing or not ("fl_x" in record or "camera_angle_x" in record):
        found = f"{what}: {', '.join(missing) or 'fl_x'} is missing"
        raise FolderError(path=path, found=found, hint="Give w, h and fl_x or camera_angle_x.")

    def number_of(key: str, default: float) -> float:
        return _number(path, record.get(key, default), f"{what}, {key}")

    width, height = int(number_of("w", 0.0)), int(number_of("h", 0.0))
    angle_rad = number_of("camera_angle_x", 1.0)
    if not 0 < angle_rad < math.pi:
        found = f"{what}: a camera_angle_x of {angle_rad:g}"
        raise FolderError(path=path, found=found, hint="It is in radians, above 0 and below pi.")
    fx = number_of("fl_x", 0.5 * width / math.tan(0.5 * angle_rad))
    fy, cx, cy = (number_of(*of) for of in (("fl_y", fx), ("cx", width / 2), ("cy", height / 2)))
    if min(fx, fy, width, height) <= 0:
        found = f"{what}: {width} x {height} pixels and focal lengths {fx:g}, {fy:g}"
        raise FolderError(path=path, found=found, hint="All of them are above zero.")
    if max(width, height) > MOST_PX:
        found = f"{what}: {width} x {height} pixels"
        raise FolderError(path=path, found=found, hint=f"At most {MOST_PX} a side are read.")
    camera = Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
    return camera, "cx" not in record or "cy" not in record


def _frame_pose(path: Path, number: int, frame: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    what = f"transform_matrix of frame {number}"
    T = pose_of(path, frame.get("transform_matrix"), what)
    if T is None:
        raise FolderError(path=path, found=f"{what} is not finite")
    return np.asarray(T @ OPENCV_FROM_OPENGL)


def _number(path: Path, value: Any, what: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise FolderError(path=path, found=f"{what}: no number ({error})") from error
    if not math.isfinite(number):
        raise FolderError(path=path, found=f"{what}: not finite")
    return number
