"""The 7-Scenes layout: ``frame-XXXXXX.color.png``, ``.depth.png`` and ``.pose.txt``.

Depth is in millimetres, 65535 and 0 are "no measurement"; a pose is camera-to-world, 4 x 4, in
metres (README of the data set; Shotton et al., CVPR 2013). Its makers give 585, 585, 320, 240 for
the depth camera and nothing for the colour camera, whose images are not registered to depth. What
is not given is taken as nominal and said so. A ``camera-intrinsics.txt`` (3 x 3, as in TSDF-fusion
copies of the data) is read for the depth camera.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.sources.folder.config import FolderConfig, FolderError
from bridge.sources.folder.frames import (
    FolderFrame,
    FolderIndex,
    camera_of,
    checked_rotation,
    read_stored_depth,
    require_image,
)

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
    """Read a sequence folder.

    Args:
        config: Its intrinsics and unit of depth go before those of the folder and the data set.
    """
    frames, num_unposed = [], 0
    for color_path in find_frames(folder):
        stem = color_path.name.split(".")[0]
        depth_path = require_image(
            folder / f"{stem}.depth.png", what="depth", named_by=f"{color_path.name} belongs to it"
        )
        T_world_depth = _read_pose(folder / f"{stem}.pose.txt")
        if T_world_depth is None:
            num_unposed += 1
            continue
        frames.append(
            FolderFrame(color_path=color_path, depth_path=depth_path, T_world_depth=T_world_depth)
        )
    if not frames:
        raise FolderError(
            path=folder, found="no frame has a pose", hint="Add frame-XXXXXX.pose.txt files."
        )
    height, width = read_stored_depth(frames[0].depth_path).shape
    given = _read_intrinsics(folder / INTRINSICS_FILE)
    depth = config.depth_intrinsics or given
    T_color_depth = np.eye(4)
    T_color_depth[:3, 3] = T_COLOR_DEPTH_NOMINAL_M
    return FolderIndex(
        path=folder,
        layout="7-Scenes",
        name=folder.resolve().name,
        depth_unit_m=config.depth_unit_m or DEPTH_UNIT_M,
        depth_invalid_values=INVALID_VALUES,
        depth_encoding="",
        depth_camera=camera_of(
            depth,
            DEPTH_INTRINSICS,
            (width, height),
            option="--depth-intrinsics",
            path=folder,
        ),
        color_camera=camera_of(
            config.color_intrinsics,
            COLOR_INTRINSICS,
            (width, height),
            option="--color-intrinsics",
            path=folder,
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


def _read_pose(path: Path) -> Float[np.ndarray, "4 4"] | None:
    """Return ``T_world_depth``; None where there is no file or tracking was lost."""
    if not path.is_file():
        return None
    T = _matrix(path, (4, 4))
    if not np.isfinite(T).all():
        return None
    T[:3, :3] = checked_rotation(path, T[:3, :3], "the pose")
    T[3] = (0.0, 0.0, 0.0, 1.0)
    return T


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
