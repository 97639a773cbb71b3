"""Folders of posed colour images without depth: ``transforms.json``, as messages of cameras.

``transforms.json`` of NeRF programs holds poses from camera to world with OpenGL's axes (+Y up, +Z
backwards). Lenses that bend straight lines are refused.
"""

import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.clock import ns_from_s
from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.episode.provenance import hash_file
from bridge.episode.schema import StampedMessage
from bridge.episode.topics import COLOR_IMAGE, COLOR_INFO, TF, camera_topic
from bridge.errors import PathNotFoundError
from bridge.geometry.camera import Camera
from bridge.sources.folder.config import FolderError, PosedConfig
from bridge.sources.folder.frames import (
    check_size,
    checked_rotation,
    read_color,
    refuse_bent,
    unread,
)
from bridge.sources.folder.messages import WORLD, stamped

TRANSFORMS = "transforms.json"
COLMAP_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")
"""Where COLMAP leaves its model, which is not read."""
CALIBRATION_EVERY = 30
"""Images between two repetitions of a camera's intrinsics."""
_READ = {"frames", "w", "h", "camera_angle_x", "fl_x", "fl_y", "cx", "cy"} | {
    *("file_path", "transform_matrix")
}
_NEEDED = {"depth_file_path": "depth is read from scene.json alone (docs/rgbd_folder.md)"}
MOST_PX = 65_500
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class PosedImage:
    """An image, its camera by name, and where it was taken."""

    path: Path
    camera: str
    T_world_camera: Float[np.ndarray, "4 4"]
    """In the folder's own unit of length."""


@dataclass(frozen=True, kw_only=True)
class PosedIndex:
    """Everything a folder says about its images, checked."""

    path: Path
    name: str
    cameras: dict[str, Camera]
    images: tuple[PosedImage, ...]
    assumed: dict[str, str] = field(default_factory=dict)
    unused: tuple[tuple[str, str, bool], ...] = ()
    """Keys that are not read, why, and whether a later command needs them."""


def has_poses(folder: Path) -> bool:
    """Whether a folder holds posed images, read or refused by ``read_posed_index``."""
    return (folder / TRANSFORMS).is_file() or _colmap_model(folder) is not None


def _colmap_model(folder: Path) -> Path | None:
    names = ("images.txt", "images.bin")
    places = [folder / place / name for place in COLMAP_FOLDERS for name in names]
    return next((path for path in places if path.is_file()), None)


def read_posed_index(folder: Path) -> PosedIndex:
    """Read ``transforms.json``; COLMAP's model is refused with what converts it."""
    path = folder / TRANSFORMS
    if not path.is_file():
        hint = f"It reads {TRANSFORMS}."
        if model := _colmap_model(folder):
            hint += f" {model} is COLMAP's: ns-process-data of nerfstudio writes one of it."
        raise PathNotFoundError(path=folder, what="posed images", hint=hint)
    record, frames = _load(path)
    cameras: dict[str, Camera] = {}
    names: dict[Camera, str] = {}
    images, assumed = [], {}
    keys = Counter(record.keys())
    for number, frame in enumerate(frames, start=1):
        if not isinstance(frame, dict):
            raise FolderError(path=path, found=f"frame {number} is no object")
        keys.update(frame.keys())
        camera, centred = _frame_camera(path, number, {**record, **frame})
        if centred:
            assumed["principal point"] = "the centre of the image"
        name = names.setdefault(camera, str(len(names) + 1))
        cameras[name] = camera
        images.append(
            PosedImage(
                path=_frame_path(folder, path, frame),
                camera=name,
                T_world_camera=_frame_pose(path, number, frame),
            )
        )
    if not images:
        raise FolderError(path=path, found="no frame")
    ordered = tuple(sorted(images, key=lambda image: str(image.path)))
    return PosedIndex(
        path=path,
        name=folder.resolve().name,
        cameras=cameras,
        images=ordered,
        assumed=assumed,
        unused=tuple(unread(keys, _READ, _NEEDED)),
    )


def _load(path: Path) -> tuple[dict[str, Any], list[Any]]:
    try:
        record = json.loads(path.read_text())
        return record, list(record["frames"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise FolderError(path=path, found=f"no list of frames ({error})") from error


def _image_below(folder: Path, candidates: Sequence[str], index: Path) -> Path:
    """The first of some files that is there; nothing outside the folder is read."""
    root = folder.resolve()
    for name in candidates:
        try:
            found = (folder / name).resolve()
            if found.is_file() and found.is_relative_to(root):
                return found
        except (OSError, ValueError):  # too long for a name, or with a NUL in it
            continue
    raise PathNotFoundError(
        path=folder / candidates[0],
        what="color image",
        hint=f"{index.name} names it; restore it inside the folder, or remove the image.",
    )


def _frame_camera(path: Path, number: int, record: dict[str, Any]) -> tuple[Camera, bool]:
    """The camera of one frame, and whether its principal point had to be assumed."""
    what = f"frame {number}"
    refuse_bent(path, what, record)
    missing = [key for key in ("w", "h") if key not in record]
    if missing or not ("fl_x" in record or "camera_angle_x" in record):
        found = f"{what}: {', '.join(missing) or 'fl_x'} is missing"
        raise FolderError(path=path, found=found, hint="Give w, h and fl_x or camera_angle_x.")

    def number_of(key: str, default: float) -> float:
        return _numbers(path, [record.get(key, default)], f"{what}, {key}")[0]

    width, height = number_of("w", 0.0), number_of("h", 0.0)
    angle_rad = number_of("camera_angle_x", 1.0)
    if not 0 < angle_rad < math.pi:
        found = f"{what}: a camera_angle_x of {angle_rad:g}"
        raise FolderError(path=path, found=found, hint="It is in radians, above 0 and below pi.")
    fx = number_of("fl_x", 0.5 * width / math.tan(0.5 * angle_rad))
    of = {"fx": fx, "fy": number_of("fl_y", fx)}
    of |= {"cx": number_of("cx", width / 2), "cy": number_of("cy", height / 2)}
    return _camera(path, int(width), int(height), of), "cx" not in record or "cy" not in record


def _frame_path(folder: Path, index: Path, frame: dict[str, Any]) -> Path:
    name = str(frame.get("file_path", ""))
    endings = ("",) if Path(name).suffix else (".png", ".jpg", ".jpeg")
    return _image_below(folder, [f"{name}{ending}" for ending in endings], index)


def _frame_pose(path: Path, number: int, frame: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    try:
        T = np.array(frame["transform_matrix"], dtype=np.float64)
    except (KeyError, ValueError, TypeError) as error:
        found = f"frame {number} has no transform_matrix ({error})"
        raise FolderError(path=path, found=found) from error
    if T.shape not in ((4, 4), (3, 4)) or not np.isfinite(T).all():
        found = f"frame {number}: transform_matrix is no 4 x 4 of numbers"
        raise FolderError(path=path, found=found)
    T = np.vstack([T[:3], [0.0, 0.0, 0.0, 1.0]])
    T[:3, :3] = checked_rotation(path, T[:3, :3], f"frame {number}")
    return np.asarray(T @ OPENCV_FROM_OPENGL)


def _camera(path: Path, width: int, height: int, of: dict[str, float]) -> Camera:
    fx, fy = of["fx"], of["fy"]
    if min(fx, fy, width, height) <= 0:
        found = f"a camera of {width} x {height} pixels and focal lengths {fx:g}, {fy:g}"
        raise FolderError(path=path, found=found, hint="All of them are above zero.")
    if max(width, height) > MOST_PX:
        found = f"a camera of {width} x {height} pixels"
        raise FolderError(path=path, found=found, hint=f"At most {MOST_PX} a side are read.")
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=of["cx"], cy=of["cy"])


def _numbers(path: Path, words: list[Any], what: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except (TypeError, ValueError, OverflowError) as error:
        raise FolderError(path=path, found=f"{what}: no number ({error})") from error
    if not np.isfinite(numbers).all():
        raise FolderError(path=path, found=f"{what}: not finite")
    return numbers


def describe_posed(index: PosedIndex, config: PosedConfig) -> dict[str, Any]:
    """What an episode's metadata says about the folder it came from."""
    return {
        "folder": index.name,
        "layout": TRANSFORMS,
        "index_sha256": hash_file(index.path),
        "is_metric": config.metres_per_unit is not None,
        "metres_per_unit": config.metres_per_unit or 1.0,
        "times": f"nominal, {config.rate_hz:g} Hz from 0; the folder has none",
        "assumed": index.assumed,
    }


def posed_messages(index: PosedIndex, config: PosedConfig) -> Iterator[list[StampedMessage]]:
    """Yield the messages of one image after another."""
    scale = config.metres_per_unit or 1.0
    sent = dict.fromkeys(index.cameras, 0)
    for number, image in enumerate(index.images):
        stamp_ns = number * ns_from_s(1.0 / config.rate_hz)
        name = camera_name(index, config, image.camera)
        camera = index.cameras[image.camera]
        messages = []
        if sent[image.camera] % CALIBRATION_EVERY == 0:
            messages.append(_info(config, name, camera, stamp_ns))
        sent[image.camera] += 1
        T = image.T_world_camera.copy()
        T[:3, 3] *= scale
        messages.append(_pose(name, T, stamp_ns))
        read = read_color(image.path)
        check_size(image.path, read.image_u8.shape[:2], camera)
        color = CompressedColor(
            stamp_ns=stamp_ns, frame_id=frame_of(name), format="jpeg", data=read.as_jpeg()
        )
        topic = camera_topic(config.cell, name, COLOR_IMAGE)
        messages.append(stamped(topic, schema.COMPRESSED_IMAGE, color.to_cdr(), stamp_ns))
        yield messages


def camera_name(index: PosedIndex, config: PosedConfig, camera: str) -> str:
    """Name of a folder's camera in topics."""
    return config.camera if len(index.cameras) == 1 else f"{config.camera}{camera}"


def frame_of(camera: str) -> str:
    """Frame of a camera's images."""
    return f"{camera}_color_optical"


def _pose(camera: str, T_world_camera: Float[np.ndarray, "4 4"], stamp_ns: int) -> StampedMessage:
    pose = FrameTransform(
        stamp_ns=stamp_ns, parent=WORLD, child=frame_of(camera), T_parent_child=T_world_camera
    )
    return stamped(TF, schema.TF_MESSAGE, transforms_to_cdr([pose]), stamp_ns)


def _info(config: PosedConfig, name: str, camera: Camera, stamp_ns: int) -> StampedMessage:
    info = CameraInfo(stamp_ns=stamp_ns, frame_id=frame_of(name), camera=camera)
    topic = camera_topic(config.cell, name, COLOR_INFO)
    return stamped(topic, schema.CAMERA_INFO, info.to_cdr(), stamp_ns)
