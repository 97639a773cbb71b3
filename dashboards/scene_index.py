"""An index for a folder with colour and depth images in folders of their own.

Open3D and its recorders, Redwood, ScanNet and Replica export so: ``color/`` beside ``depth/``, and
poses and intrinsics in one of a few files. What is read becomes a proposal of ``scene.json``.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import UsageError
from bridge.sources.folder.frames import read_stored_depth
from bridge.sources.folder.scene_json import INDEX_NAME
from bridge.terminal import Output

COLOR, DEPTH = ("color", "colour", "rgb", "image", "images"), ("depth", "depths")
POSES, PATHS = ("pose", "poses"), ("trajectory.log", "traj.txt")
MATRICES = ("intrinsic/intrinsic_depth.txt", "intrinsic_depth.txt", "camera-intrinsics.txt")
OPEN3D = ("camera_intrinsic.json", "intrinsic.json")
IMAGES = (".png", ".jpg", ".jpeg")
UNIT_M = 0.001


def subfolder(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The first folder of these names that is there."""
    return next((folder / name for name in names if (folder / name).is_dir()), None)


def is_paired(folder: Path) -> bool:
    """Whether colour and depth images lie in folders of their own."""
    return bool(subfolder(folder, COLOR) and subfolder(folder, DEPTH))


def propose_index(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Return what ``scene.json`` would hold, and what was assumed.

    Raises:
        UsageError: No images belong together, or the folder does not say how its camera sees.
    """
    color, depth = _numbered(subfolder(folder, COLOR)), _numbered(subfolder(folder, DEPTH))
    both = sorted(color.keys() & depth.keys())
    if not both:
        raise UsageError(f"{folder}: no colour and depth image have the same number in their names")
    height, width = read_stored_depth(depth[both[0]]).shape
    poses, place = _poses(folder)
    found = [poses.get(number, np.full((4, 4), np.nan)) for number in both]
    notes = [f"{len(both)} frames of {len(color)} colour and {len(depth)} depth images"]
    notes.append("depth is taken for millimetres, and colour for seen by the depth camera")
    posed = sum(bool(np.isfinite(pose).all()) for pose in found)
    notes.append(f"poses of {posed} frames from {place}" if poses else "no poses")
    index = {
        "name": folder.resolve().name,
        "depth_unit_m": UNIT_M,
        "depth_invalid_values": [0, 65535],
        "depth_intrinsics": {**_intrinsics(folder), "width": width, "height": height},
        "color_registered_to_depth": True,
        "frames": [
            {
                "color": color[number].relative_to(folder).as_posix(),
                "depth": depth[number].relative_to(folder).as_posix(),
                "T_world_cam": pose.tolist() if np.isfinite(pose).all() else None,
            }
            for number, pose in zip(both, found if poses else [np.eye(4)] * len(both), strict=True)
        ],
    }
    return index, notes


def write_index(folder: Path, path: Path, /, *, output: Output) -> int:
    """Write a proposal into its folder."""
    if path.resolve() != folder.resolve() / INDEX_NAME:
        raise UsageError(f"its index lies in it: robot-gst open {folder} {folder / INDEX_NAME}")
    index, notes = propose_index(folder)
    path.write_text(json.dumps(index, indent=1))
    posed = "" if "no poses" not in notes else ", then rebuild RUN --poses odometry"
    output.say(f"{path} was written; look at it. next: robot-gst import rgbd {folder} RUN{posed}")
    return 0


def _numbered(folder: Path | None) -> dict[int, Path]:
    """Images by the last number in their names."""
    found = {}
    for path in sorted(folder.iterdir()) if folder else ():
        numbers = re.findall(r"\d+", path.stem)
        if numbers and path.suffix.lower() in IMAGES:
            found[int(numbers[-1])] = path
    return found


def _poses(folder: Path) -> tuple[dict[int, Float[np.ndarray, "4 4"]], str]:
    """Camera-to-world poses by number of frame, and where they stand."""
    files = subfolder(folder, POSES)
    if files is not None:
        texts = {int(re.findall(r"\d+", p.stem)[-1]): p for p in files.glob("*[0-9].txt")}
        return {n: _matrix(_rows(path), path, 4) for n, path in texts.items()}, files.name
    for name in PATHS:
        if (folder / name).is_file():
            return dict(enumerate(_path(folder / name))), name
    return {}, ""


def _path(path: Path) -> Iterator[Float[np.ndarray, "4 4"]]:
    """Poses one after another; in a Redwood log three numbers come before each."""
    numbers = _rows(path)
    each = 16 + 3 * (path.suffix == ".log")
    if len(numbers) % each:
        raise UsageError(f"{path} holds {len(numbers)} numbers, which are no poses of {each} each")
    yield from numbers.reshape(-1, each)[:, -16:].reshape(-1, 4, 4)


def _rows(path: Path) -> Float[np.ndarray, " n"]:
    try:
        return np.array(path.read_text().split(), dtype=np.float64)
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error


def _matrix(numbers: Float[np.ndarray, " n"], path: Path, size: int) -> Float[np.ndarray, "k k"]:
    if numbers.size != size * size:
        raise UsageError(f"{path} holds {numbers.size} numbers, not {size} x {size}")
    return numbers.reshape(size, size)


def _intrinsics(folder: Path) -> dict[str, float]:
    """Focal lengths and centre [px]."""
    for name in OPEN3D:
        if (folder / name).is_file():
            try:
                columns = json.loads((folder / name).read_text())["intrinsic_matrix"]
                K = _matrix(np.array(columns, dtype=np.float64), folder / name, 3).T
            except (ValueError, KeyError, TypeError) as error:
                raise UsageError(f"{folder / name}: no intrinsic_matrix ({error})") from error
            break
    else:
        place = next((folder / name for name in MATRICES if (folder / name).is_file()), None)
        if place is None:
            raise UsageError(
                f"{folder} does not say how its camera sees: none of {', '.join(OPEN3D + MATRICES)}"
                " is there (3 x 3: fx 0 cx, 0 fy cy, 0 0 1, in px)"
            )
        numbers = _rows(place)
        K = _matrix(numbers, place, 4 if numbers.size == 16 else 3)
    names = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    return {name: float(K[row]) for name, row in names.items()}
