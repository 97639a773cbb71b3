"""Folders of posed colour images without depth: COLMAP's text model, or ``transforms.json``.

COLMAP's ``cameras.txt`` and ``images.txt`` (https://colmap.github.io/format.html) hold poses from
world to camera and pixel centres at +0.5, as ours; ``points3D.txt`` is read for distances only.
``transforms.json`` of NeRF programs holds poses from camera to world with OpenGL's axes (+Y up, +Z
backwards). Lenses that bend straight lines are refused.
"""

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import PathNotFoundError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.geometry.cameras_view import distance_to_what_is_seen
from bridge.sources.folder.config import FolderError
from bridge.sources.folder.frames import STRAIGHTEN, checked_rotation, refuse_bent, unread

COLMAP_FILES = ("cameras.txt", "images.txt")
COLMAP_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")
TRANSFORMS = "transforms.json"
IMAGE_FOLDERS = ("images", ".")
PARAMETERS = {"SIMPLE_PINHOLE": ("f", "cx", "cy"), "PINHOLE": ("fx", "fy", "cx", "cy")}
"""COLMAP's models that are read, with the names of their numbers."""
_READ = {"frames", "w", "h", "camera_angle_x", "fl_x", "fl_y", "cx", "cy"} | {
    *("file_path", "transform_matrix")
}
_NEEDED = {"depth_file_path": "depth is read from scene.json alone (docs/rgbd_folder.md)"}
MOST_PX = 65_500
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
SPARSE_PERCENT = (2.0, 98.0)
"""Sparse points nearer or farther than these percentiles are taken for outliers."""


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
    layout: str
    name: str
    cameras: dict[str, Camera]
    images: tuple[PosedImage, ...]
    sparse_range: tuple[float, float] | None
    """Distances of COLMAP's points along the optical axes; None without points."""
    assumed: dict[str, str] = field(default_factory=dict)
    unused: tuple[tuple[str, str, bool], ...] = ()
    """Keys that are not read, why, and whether a later command needs them."""

    def typical_distance(self) -> float:
        """How far the cameras are from what they look at, in the folder's own unit of length.

        The geometric mean of the range of COLMAP's points, else the median distance to the point
        that all optical axes pass nearest.
        """
        if self.sparse_range is not None:
            return math.sqrt(self.sparse_range[0] * self.sparse_range[1])
        found = distance_to_what_is_seen(np.stack([image.T_world_camera for image in self.images]))
        if found is None:
            raise FolderError(
                path=self.path,
                found="poses without a scale, and cameras that do not look at one place",
                hint="Give the scale: --metres-per-unit, 1 where the poses are in metres.",
            )
        return found


def read_posed_index(folder: Path) -> PosedIndex:
    """Read whichever of the two layouts the folder has."""
    if (folder / TRANSFORMS).is_file():
        return _read_transforms(folder)
    for place in COLMAP_FOLDERS:
        if all((folder / place / name).is_file() for name in COLMAP_FILES):
            return _read_colmap(folder, folder / place)
    binary = [p for place in COLMAP_FOLDERS for p in (folder / place).glob("images.bin")]
    hint = (
        f"Write {binary[0]} as text: colmap model_converter --output_type TXT."
        if binary
        else f"It reads {TRANSFORMS}, or cameras.txt and images.txt of COLMAP, here or in sparse/0."
    )
    raise PathNotFoundError(path=folder, what="posed images", hint=hint)


def _read_colmap(folder: Path, model: Path) -> PosedIndex:
    cameras = _colmap_cameras(model / "cameras.txt")
    path = model / "images.txt"
    images, range_found = [], _sparse_depths(model / "points3D.txt")
    for number, line in enumerate(_pose_lines(path), start=1):
        images.append(_colmap_image(path, number, line, folder, cameras))
    if not images:
        raise FolderError(path=path, found="no image", hint="Reconstruct again.")
    ordered = tuple(sorted(images, key=lambda image: str(image.path)))
    return PosedIndex(
        path=path, layout="COLMAP", name=folder.resolve().name, cameras=cameras, images=ordered,
        sparse_range=_range_along(ordered, range_found),
    )  # fmt: skip


def _pose_lines(path: Path) -> list[str]:
    """Every second line that is no comment: the others list key points, and may be empty."""
    lines = [line for line in path.read_text(errors="replace").splitlines() if line[:1] != "#"]
    return [line for line in lines[::2] if line.strip()]


def _colmap_cameras(path: Path) -> dict[str, Camera]:
    cameras = {}
    for line in path.read_text(errors="replace").splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        model = words[1] if len(words) > 1 else ""
        names = PARAMETERS.get(model)
        if names is None:
            raise FolderError(
                path=path,
                found=f"camera {words[0]} has the model {model or 'nothing'!r}",
                hint=f"Read are {', '.join(PARAMETERS)}. {STRAIGHTEN}",
            )
        width, height, *numbers = _numbers(path, words[2:], f"camera {words[0]}")
        if len(numbers) != len(names):
            found = f"camera {words[0]}: {len(numbers)} numbers, {model} has {len(names)}"
            raise FolderError(path=path, found=found)
        of = dict(zip(names, numbers, strict=True))
        cameras[words[0]] = _camera(path, int(width), int(height), of)
    return cameras


def _colmap_image(
    path: Path, number: int, line: str, folder: Path, cameras: dict[str, Camera]
) -> PosedImage:
    words = line.split(maxsplit=9)
    if len(words) < 10:
        raise FolderError(
            path=path, found=f"image {number} has {len(words)} fields", hint="It has 10 of them."
        )
    w, x, y, z, *p = _numbers(path, words[1:8], f"image {number}")
    q = np.array([w, x, y, z])
    if not 0.5 < np.linalg.norm(q) < 2:
        raise FolderError(path=path, found=f"image {number}: no quaternion")
    if words[8] not in cameras:
        raise FolderError(
            path=path,
            found=f"image {words[9]} is of camera {words[8]}, which cameras.txt lacks",
            hint=f"There are {', '.join(cameras) or 'none'}.",
        )
    T_camera_world = se3.transform_from(q / np.linalg.norm(q), np.array(p))
    return PosedImage(
        path=_image_below(folder, [f"{p}/{words[9].strip()}" for p in IMAGE_FOLDERS], path),
        camera=words[8],
        T_world_camera=se3.invert(T_camera_world),
    )


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


def _sparse_depths(path: Path) -> Float[np.ndarray, "num_points 3"]:
    if not path.is_file():
        return np.zeros((0, 3))
    rows = [
        _numbers(path, line.split()[1:4], "a point")
        for line in path.read_text(errors="replace").splitlines()
        if line.strip() and line[0] != "#"
    ]
    if any(len(row) < 3 for row in rows):
        found = "a point has fewer than three coordinates"
        raise FolderError(path=path, found=found)
    return np.array(rows).reshape(-1, 3)


def _range_along(
    images: tuple[PosedImage, ...], points: Float[np.ndarray, "num_points 3"]
) -> tuple[float, float] | None:
    """How far along the optical axes the sparse points before the cameras lie."""
    z = np.concatenate(
        [se3.apply(se3.invert(image.T_world_camera), points)[:, 2] for image in images]
    )
    z = z[z > 0]
    if len(z) == 0:
        return None
    near, far = np.percentile(z, SPARSE_PERCENT)
    return float(near), float(far)


def _read_transforms(folder: Path) -> PosedIndex:
    path = folder / TRANSFORMS
    try:
        record = json.loads(path.read_text())
        frames = list(record["frames"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise FolderError(path=path, found=f"no list of frames ({error})") from error
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
        path=path, layout=TRANSFORMS, name=folder.resolve().name, cameras=cameras, images=ordered,
        sparse_range=None, assumed=assumed, unused=tuple(unread(keys, _READ, _NEEDED)),
    )  # fmt: skip


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
    fx = of.get("fx", of.get("f", 0.0))
    fy = of.get("fy", fx)
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
