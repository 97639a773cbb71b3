"""What every layout of an RGB-D folder is read into, and the checks they share."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from bridge.errors import PathNotFoundError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.geometry.trajectory import PoseTrajectory
from bridge.media.color import JPEG_MAGIC, UnreadableImageError, decode_color, encode_jpeg
from bridge.media.depth import decode_depth_png
from bridge.sources.folder.config import FolderConfig, FolderError

ROTATION_TOLERANCE = 0.01
"""Poses written with five digits are off by 5e-4; more than this is not a rotation."""
VGA = (640, 480)
"""Size of the images that nominal intrinsics are given for."""
Image = TypeVar("Image")


@dataclass(frozen=True, kw_only=True)
class FolderFrame:
    """The files of one instant, without depth where there is none."""

    color_path: Path
    depth_path: Path | None
    T_world_depth: Float[np.ndarray, "4 4"]
    color_stamp_ns: int | None = None
    """When the colour image was taken, where the folder says so [ns]."""
    depth_stamp_ns: int | None = None


@dataclass(frozen=True, kw_only=True)
class FolderIndex:
    """Everything a folder says about its frames, checked."""

    path: Path
    """The file that lists the frames, or the folder where file names do."""
    layout: str
    name: str
    depth_unit_m: float
    depth_invalid_values: tuple[int, ...]
    depth_encoding: str
    depth_camera: Camera
    color_camera: Camera | None
    """None: the same as the depth camera, at the size of the colour images."""
    T_depth_color: Float[np.ndarray, "4 4"]
    frames: tuple[FolderFrame, ...]
    num_unposed: int
    """Frames left out because their pose is not known."""
    num_unpaired: int = 0
    """Colour images left out because no depth image was taken at their time."""
    poses: PoseTrajectory | None = None
    """``T_world_depth`` at the folder's own rate; None: one pose per frame."""
    assumed: dict[str, str] = field(default_factory=dict)
    """What the folder does not say and which values were taken instead."""
    unused: tuple[tuple[str, str, bool], ...] = ()
    """Keys that are not read, why, and whether a later command needs them."""

    @property
    def has_times(self) -> bool:
        """Whether the frames carry the times they were taken at."""
        return self.frames[0].color_stamp_ns is not None

    @property
    def summary(self) -> str:
        """What was found, for people."""
        times = "with its own times" if self.has_times else "without times"
        text = f"{self.layout} layout {times}: {len(self.frames)} frames"
        if self.num_unposed:
            text += f", {self.num_unposed} without a pose left out"
        if self.num_unpaired:
            text += f", {self.num_unpaired} colour images without depth left out"
        return text


_MODELS = ("camera_model", "distortion_model", "model")
_BENDING = (
    *("is_fisheye", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "distortion", "coeffs"),
    *("distortion_coefficients", "distortion_params", "D", "d"),
)
"""Keys under which a lens is described."""
STRAIGHT = ("SIMPLE_PINHOLE", "PINHOLE", "OPENCV", "PLUMB_BOB", "NONE", "")
"""Models that keep straight lines straight where all their numbers are 0."""
_STRAIGHTEN = "Straighten the images: colmap image_undistorter writes PINHOLE."


def refuse_bent(path: Path, what: str, record: Mapping[str, Any]) -> None:
    """Refuse a lens that bends straight lines, whichever key says so."""
    for key in (*_MODELS, *_BENDING):
        value = record.get(key) or ""
        if key in _MODELS and str(value).upper() not in STRAIGHT:
            raise FolderError(path=path, found=f"{what} has the model {value!r}", hint=_STRAIGHTEN)
        numbers = value.values() if isinstance(value, dict) else value
        if key in _BENDING and any(numbers if isinstance(value, list | dict) else [value]):
            raise FolderError(path=path, found=f"{what} has {key}", hint=_STRAIGHTEN)


def unread(
    keys: Counter[str], read: Collection[str], why_of: Mapping[str, str]
) -> Iterator[tuple[str, str, bool]]:
    """Say which keys nobody reads, in how many frames, and which are needed and why not read."""
    for key, count in keys.items():
        if key not in (*read, *_MODELS, *_BENDING):
            where = f"{key} of {count} frames" if count > 1 else key
            yield where, why_of.get(key, "not read"), key in why_of


def checked_rotation(
    path: Path, R: Float[np.ndarray, "3 3"], where: str
) -> Float[np.ndarray, "3 3"]:
    """Return the rotation nearest to a matrix written with few digits."""
    singular = np.linalg.svd(R, compute_uv=False)
    if np.any(np.abs(singular - 1) > ROTATION_TOLERANCE) or np.linalg.det(R) < 0:
        raise FolderError(
            path=path,
            found=f"the rotation of {where} is none (singular values {np.round(singular, 3)})",
            hint="Poses are camera-to-world, row by row.",
        )
    return se3.nearest_rotation(R)


def pose_of(path: Path, values: Any, where: str) -> Float[np.ndarray, "4 4"] | None:
    """Read a pose of the camera in the world, 4 x 4; None where tracking was lost."""
    try:
        T = np.array(values, dtype=np.float64)
    except (ValueError, TypeError):
        T = np.empty(0)
    if T.shape not in ((4, 4), (3, 4)):
        raise FolderError(path=path, found=f"{where} is no 4 x 4 of numbers")
    if not np.isfinite(T).all():
        return None
    return se3.from_rotation(checked_rotation(path, T[:3, :3], where), T[:3, 3])


@dataclass(frozen=True, kw_only=True)
class StoredColor:
    """A colour image as it lies in a folder."""

    stored: bytes
    image_u8: UInt8[np.ndarray, "height width 3"]

    def as_jpeg(self) -> bytes:
        """The stored bytes where they are JPEG, else the image compressed."""
        return self.stored if self.stored[:2] == JPEG_MAGIC else encode_jpeg(self.image_u8)


def read_color(path: Path) -> StoredColor:
    """Read a colour image."""
    return _decoded(path, lambda stored: StoredColor(stored=stored, image_u8=decode_color(stored)))


def check_size(path: Path, shape: tuple[int, ...], camera: Camera) -> None:
    """Refuse an image of another size than its camera's."""
    if shape != (camera.height, camera.width):
        raise FolderError(
            path=path,
            found=f"{shape[1]} x {shape[0]} pixels, camera {camera.width} x {camera.height}",
            hint="Correct the intrinsics or the image.",
        )


def read_stored_depth(path: Path) -> UInt16[np.ndarray, "height width"]:
    """Read the numbers of a 16-bit depth image."""
    return _decoded(path, decode_depth_png)


def _decoded(path: Path, decode: Callable[[bytes], Image]) -> Image:
    try:
        return decode(path.read_bytes())
    except (UnreadableImageError, OSError) as error:
        raise FolderError(
            path=path, found=str(error).rstrip("."), hint="Restore the file or remove the frame."
        ) from error


def require_image(path: Path, *, what: str, named_by: str) -> Path:
    """Return the path if the file is there."""
    if not path.is_file():
        raise PathNotFoundError(
            path=path, what=f"{what} image", hint=f"{named_by}; restore it or remove the frame."
        )
    return path


def camera_of(
    intrinsics: Sequence[float] | None,
    nominal: tuple[float, float, float, float],
    size: tuple[int, int],
    *,
    option: str,
    path: Path,
) -> Camera:
    """Make a camera from ``(fx, fy, cx, cy)`` [px, pixel centres at whole numbers]."""
    if intrinsics is None and size != VGA:
        raise FolderError(
            path=path,
            found=f"images of {size[0]} x {size[1]} pixels, and no intrinsics for that size",
            hint=f"Give them: {option} FX FY CX CY.",
        )
    fx, fy, cx, cy = nominal if intrinsics is None else intrinsics
    return Camera.from_ros(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy)


def refuse_scale_without_use(config: FolderConfig, path: Path) -> None:
    """Refuse options that a self-describing index answers itself."""
    for name in ("depth_intrinsics", "color_intrinsics", "depth_unit_m"):
        if getattr(config, name) is not None:
            raise FolderError(
                path=path,
                found=f"--{name.replace('_', '-')} was given, but the file holds this itself",
                hint="Correct the file, or leave the option out.",
            )
