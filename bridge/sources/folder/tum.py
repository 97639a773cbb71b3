"""The layout of the TUM RGB-D benchmark: lists of stamped files and of stamped poses.

``rgb.txt`` and ``depth.txt`` hold "stamp file", ``groundtruth.txt`` "stamp tx ty tz qx qy qz qw" of
the colour camera, stamps in seconds; depth is registered to colour, 5000 stored per metre, 0 is
"no measurement" (Sturm et al., IROS 2012, and the benchmark's page on file formats). Stamps are
read as decimals, so that nanoseconds survive. ``camera.json`` is ours: ``export tum`` writes it,
because the layout itself has no place for intrinsics.
"""

import json
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.clock import NS_PER_S
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.geometry.trajectory import PoseTrajectory
from bridge.sources.folder.config import FolderConfig, FolderError
from bridge.sources.folder.frames import (
    FolderFrame,
    FolderIndex,
    camera_of,
    read_stored_depth,
    require_image,
)

PAIRING_TOLERANCE_NS = 20_000_000
"""Colour and depth of one frame lie at most this far apart (the benchmark's own choice)."""
MAX_STAMP_S = 2**31
"""ROS stamps count seconds in 32 bits; a larger number is milli- or nanoseconds."""
QUATERNION_TOLERANCE = 0.05
"""Four digits are off by 1e-4; a norm farther from one is not a rotation."""


@dataclass(frozen=True, kw_only=True)
class StampedFile:
    """One line of a list."""

    stamp_ns: int
    name: str
    line: int


def read_files(path: Path) -> list[StampedFile]:
    """Read "stamp file" lines in time order."""
    files = [
        StampedFile(stamp_ns=_stamp_ns(path, line, cells[0]), name=cells[1], line=line)
        for line, cells in _rows(path, 2)
    ]
    if not files:
        raise FolderError(path=path, found="no images listed", hint="Write: stamp file.")
    return sorted(files, key=lambda item: item.stamp_ns)


def associate(
    colors: Sequence[StampedFile], depths: Sequence[StampedFile]
) -> list[tuple[StampedFile, StampedFile]]:
    """Pair each colour with a depth image of its own, the closest pairs first, within 20 ms."""
    stamps = [depth.stamp_ns for depth in depths]
    candidates = []
    for number, color in enumerate(colors):
        first = bisect_left(stamps, color.stamp_ns - PAIRING_TOLERANCE_NS)
        for other in range(first, len(stamps)):
            gap_ns = abs(stamps[other] - color.stamp_ns)
            if stamps[other] > color.stamp_ns + PAIRING_TOLERANCE_NS:
                break
            candidates.append((gap_ns, number, other))
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for _, number, other in sorted(candidates):
        if number not in partner and other not in taken:
            partner[number] = other
            taken.add(other)
    return [(colors[number], depths[partner[number]]) for number in sorted(partner)]


def read_poses(path: Path) -> PoseTrajectory:
    """Read "stamp tx ty tz qx qy qz qw" lines, without rows of nan and repeated stamps."""
    poses: dict[int, tuple[list[float], list[float]]] = {}
    for line, cells in _rows(path, 8):
        stamp_ns = _stamp_ns(path, line, cells[0])
        try:
            numbers = [float(cell) for cell in cells[1:]]
        except ValueError as error:
            raise FolderError(
                path=path, found=f"line {line}: {error}", hint="Write: stamp tx ty tz qx qy qz qw."
            ) from error
        if not np.isfinite(numbers).all():
            continue
        x, y, z, w = numbers[3:]
        norm = float(np.linalg.norm(numbers[3:]))
        if abs(norm - 1) > QUATERNION_TOLERANCE:
            raise FolderError(
                path=path,
                found=f"line {line}: quaternion of length {norm:.3g}",
                hint="Its length is one; the order is qx qy qz qw.",
            )
        poses.setdefault(stamp_ns, (numbers[:3], [w / norm, x / norm, y / norm, z / norm]))
    if not poses:
        raise FolderError(path=path, found="no poses", hint="Write: stamp tx ty tz qx qy qz qw.")
    stamps = sorted(poses)
    return PoseTrajectory(
        np.array(stamps, dtype=np.int64),
        np.array([poses[stamp][0] for stamp in stamps]),
        np.array([poses[stamp][1] for stamp in stamps]),
    )


def _rows(path: Path, count: int) -> Iterator[tuple[int, list[str]]]:
    """Yield numbered lines of cells, blank lines and comments left out."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise FolderError(path=path, found=f"not readable as text ({error})") from error
    for line, row in enumerate(text.splitlines(), start=1):
        cells = row.replace(",", " ").split()
        if not cells or cells[0].startswith("#"):
            continue
        if len(cells) != count:
            raise FolderError(
                path=path,
                found=f"line {line} has {len(cells)} fields, expected {count}",
                hint="Correct the line or remove it.",
            )
        yield line, cells


def _stamp_ns(path: Path, line: int, text: str) -> int:
    """Turn seconds in decimal notation into nanoseconds without rounding through a float."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal("NaN")
    if not seconds.is_finite() or not 0 <= seconds < MAX_STAMP_S:
        raise FolderError(
            path=path,
            found=f"line {line}: {text!r} is no time in seconds",
            hint="Stamps are seconds with decimals, for example 1305031098.665900000.",
        )
    return int((seconds * NS_PER_S).to_integral_value())


COLOR_LIST, DEPTH_LIST, POSE_LIST = "rgb.txt", "depth.txt", "groundtruth.txt"
CAMERA_FILE = "camera.json"
DEPTH_UNIT_M = 1 / 5000
INTRINSICS = (525.0, 525.0, 319.5, 239.5)
"""What the benchmark's makers recommend for its registered images [px]."""
POSE_TOLERANCE_NS = 50_000_000
"""A frame farther than this from any pose has none; motion capture has holes."""


@dataclass(frozen=True, kw_only=True)
class TumCameras:
    """Both cameras of a folder, and how they stand to each other."""

    depth: Camera
    color: Camera | None
    T_color_depth: Float[np.ndarray, "4 4"]
    assumed: dict[str, str]


def find_lists(folder: Path) -> list[Path]:
    """Return the lists that name the images; empty when the folder has another layout."""
    both = [folder / COLOR_LIST, folder / DEPTH_LIST]
    return both if all(path.is_file() for path in both) else []


def read_tum(folder: Path, config: FolderConfig) -> FolderIndex:
    """Read a folder of the benchmark."""
    pairs, num_unpaired, path = _pairs(folder)
    pose_path = folder / POSE_LIST
    if not pose_path.is_file():
        raise FolderError(
            path=folder,
            found=f"no {POSE_LIST}, so no frame has a pose",
            hint="Add it: stamp tx ty tz qx qy qz qw of the camera.",
        )
    color_poses = read_poses(pose_path)
    height, width = read_stored_depth(folder / pairs[0][1].name).shape
    cameras = _cameras(folder, config, (width, height))
    Ts_world_depth = color_poses.transforms() @ cameras.T_color_depth
    q, p = se3.split(Ts_world_depth)
    poses = PoseTrajectory(color_poses.stamps_ns, p, q)
    frames = _frames(folder, pairs, poses, path)
    if not frames:
        raise FolderError(
            path=pose_path,
            found="no pose within 50 ms of any frame",
            hint=f"Poses and {path.name} must count time from the same origin.",
        )
    return FolderIndex(
        path=path,
        layout="TUM",
        name=folder.resolve().name,
        depth_unit_m=config.depth_unit_m or DEPTH_UNIT_M,
        depth_invalid_values=(0,),
        depth_encoding="",
        depth_camera=cameras.depth,
        color_camera=cameras.color,
        T_depth_color=se3.invert(cameras.T_color_depth),
        frames=tuple(frames),
        num_unposed=len(pairs) - len(frames),
        num_unpaired=num_unpaired,
        poses=poses,
        assumed=cameras.assumed,
    )


def _pairs(folder: Path) -> tuple[list[tuple[StampedFile, StampedFile]], int, Path]:
    """Return colour and depth of each frame, how many colours found no depth, and the list."""
    colors, depths = read_files(folder / COLOR_LIST), read_files(folder / DEPTH_LIST)
    pairs = associate(colors, depths)
    if not pairs:
        raise FolderError(
            path=folder / COLOR_LIST,
            found="no colour image lies within 20 ms of a depth image",
            hint=f"Check the stamps in {COLOR_LIST} and {DEPTH_LIST}.",
        )
    return pairs, len(colors) - len(pairs), folder / COLOR_LIST


def _frames(
    folder: Path,
    pairs: list[tuple[StampedFile, StampedFile]],
    poses: PoseTrajectory,
    path: Path,
) -> list[FolderFrame]:
    frames = []
    for color, depth in pairs:
        files = {
            what: require_image(
                folder / item.name, what=what, named_by=f"{path} line {item.line} names it"
            )
            for what, item in (("color", color), ("depth", depth))
        }
        stamps = np.array([color.stamp_ns], dtype=np.int64)
        if np.abs(poses.stamps_ns - color.stamp_ns).min() > POSE_TOLERANCE_NS:
            continue
        frames.append(
            FolderFrame(
                color_path=files["color"],
                depth_path=files["depth"],
                T_world_depth=poses.at(stamps).transforms()[0],
                color_stamp_ns=color.stamp_ns,
                depth_stamp_ns=depth.stamp_ns,
            )
        )
    return frames


def _cameras(folder: Path, config: FolderConfig, size: tuple[int, int]) -> TumCameras:
    path = folder / CAMERA_FILE
    if path.is_file() and config.depth_intrinsics is None and config.color_intrinsics is None:
        return _own_cameras(path)
    depth = camera_of(
        config.depth_intrinsics, INTRINSICS, size, option="--depth-intrinsics", path=folder
    )
    color = None
    if config.color_intrinsics is not None:
        color = camera_of(
            config.color_intrinsics, INTRINSICS, size, option="--color-intrinsics", path=folder
        )
    assumed = {"registration": "depth is registered to colour"}
    if config.depth_intrinsics is None:
        assumed["depth_intrinsics"] = f"{INTRINSICS}, the makers' recommendation, no distortion"
    return TumCameras(depth=depth, color=color, T_color_depth=np.eye(4), assumed=assumed)


def _own_cameras(path: Path) -> TumCameras:
    try:
        record = json.loads(path.read_text())
        depth, color = (_camera(record[name]) for name in ("depth", "color"))
        T_color_depth = np.array(record["T_color_depth"], dtype=np.float64)
        if T_color_depth.shape != (4, 4) or not np.isfinite(T_color_depth).all():
            raise ValueError("T_color_depth is not 4 x 4")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FolderError(
            path=path,
            found=f"cannot be read ({type(error).__name__}: {error})",
            hint="Export the folder again, or remove the file and give --depth-intrinsics.",
        ) from error
    registered = bool(np.array_equal(T_color_depth, np.eye(4))) and depth == color
    return TumCameras(
        depth=depth, color=None if registered else color, T_color_depth=T_color_depth, assumed={}
    )


def _camera(record: dict[str, Any]) -> Camera:
    return Camera.from_ros(
        width=int(record["width"]),
        height=int(record["height"]),
        **{name: float(record[name]) for name in ("fx", "fy", "cx", "cy")},
    )
