"""An index for a folder with colour and depth images in folders of their own.

Open3D and its recorders, Redwood, ScanNet and Replica export so: ``color/`` beside ``depth/``, and
poses and intrinsics in one of a few files. What is read becomes a proposal of ``scene.json``.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import UsageError
from bridge.sources.folder.frames import read_color, read_stored_depth
from bridge.sources.folder.scene_json import INDEX_NAME
from bridge.terminal import Output
from bridge.whole_file import write_whole

COLOR, DEPTH = ("color", "colour", "rgb", "image", "images"), ("depth", "depths")
POSES, PATHS = ("pose", "poses"), ("trajectory.log", "traj.txt", "traj_w_c.txt")
REPLICA = "results"
"""Holds Replica's images of both kinds, told apart by their names."""
MATRICES = ("intrinsic/intrinsic_depth.txt", "intrinsic_depth.txt", "camera-intrinsics.txt")
COLOR_MATRICES = ("intrinsic/intrinsic_color.txt", "intrinsic_color.txt")
OPEN3D, PARAMETERS = ("camera_intrinsic.json", "intrinsic.json"), "cam_params.json"
IMAGES = (".png", ".jpg", ".jpeg")
UNIT_M = 0.001


def subfolder(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The first folder of these names that is there."""
    return next((folder / name for name in names if (folder / name).is_dir()), None)


def _first(files: Iterable[Path]) -> Path | None:
    return next((path for path in files if path.is_file()), None)


def is_paired(folder: Path) -> bool:
    """Whether colour and depth images lie in folders of their own, or as Replica has them."""
    replica = folder / REPLICA
    both = any(replica.glob("frame*")) and any(replica.glob("depth*"))
    return bool(both or (subfolder(folder, COLOR) and subfolder(folder, DEPTH)))


def propose_index(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Return what ``scene.json`` would hold, and what was assumed.

    Raises:
        UsageError: No images belong together, poses fit no frames, or the folder does not say how
            its cameras see.
    """
    color = _numbered(subfolder(folder, COLOR) or folder / REPLICA, "depth")
    depth = _numbered(subfolder(folder, DEPTH) or folder / REPLICA, "frame")
    both = sorted(color.keys() & depth.keys())
    if not both:
        raise UsageError(f"{folder}: no colour and depth image have the same number in their names")
    height, width = read_stored_depth(depth[both[0]]).shape
    shown = read_color(color[both[0]]).image_u8.shape[1::-1]
    poses, place = _poses(folder, both)
    found = [poses.get(number, np.full((4, 4), np.nan)) for number in both]
    unit_m = _unit_m(folder)
    notes = [f"{len(both)} frames of {len(color)} colour and {len(depth)} depth images"]
    notes.append(f"depth is taken for {unit_m:.6g} m a number")
    posed = sum(bool(np.isfinite(pose).all()) for pose in found)
    notes.append(f"poses of {posed} frames from {place}" if poses else "no poses")
    index = {
        "name": folder.resolve().name,
        "depth_unit_m": unit_m,
        "depth_invalid_values": [0, 65535],
        "depth_intrinsics": {**_intrinsics(folder), "width": width, "height": height},
        **_color_camera(folder, shown, (width, height)),
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


def _color_camera(folder: Path, shown: tuple[int, int], size: tuple[int, int]) -> dict[str, Any]:
    """Say by which camera colour is seen: that of depth, or one of its own where depth is."""
    place = _first(folder / name for name in COLOR_MATRICES)
    if shown[0] * size[1] == shown[1] * size[0]:
        return {"color_registered_to_depth": True}
    if place is None:
        raise UsageError(
            f"{folder}: colour of {shown[0]} x {shown[1]} px is not what a depth camera of "
            f"{size[0]} x {size[1]} px sees, and {COLOR_MATRICES[0]} is not there"
        )
    camera: dict[str, Any] = {**_of_matrix(place), "width": shown[0], "height": shown[1]}
    camera["t_color_from_depth_m"] = [0.0, 0.0, 0.0]
    return {"color_registered_to_depth": False, "color_camera_estimate": camera}


def write_index(folder: Path, path: Path, /, *, output: Output) -> int:
    """Write a proposal into its folder."""
    if path.resolve() != folder.resolve() / INDEX_NAME:
        raise UsageError(f"its index lies in it: robot-gst open {folder} {folder / INDEX_NAME}")
    index, notes = propose_index(folder)
    write_whole(path, json.dumps(index, indent=1).encode())
    posed = "" if "no poses" not in notes else ", then rebuild RUN --poses odometry"
    output.say(f"{path} was written; look at it. next: robot-gst import rgbd {folder} RUN{posed}")
    return 0


def _numbered(folder: Path, but: str) -> dict[int, Path]:
    """Images by the last number in their names; in a folder of both kinds without the other."""
    found = {}
    for path in sorted(folder.iterdir()):
        numbers = re.findall(r"\d+", path.stem)
        is_other = folder.name == REPLICA and path.name.startswith(but)
        if numbers and path.suffix.lower() in IMAGES and not is_other:
            found[int(numbers[-1])] = path
    return found


def _poses(folder: Path, frames: list[int]) -> tuple[dict[int, Float[np.ndarray, "4 4"]], str]:
    """Camera-to-world poses by number of frame, and where they stand."""
    files = subfolder(folder, POSES)
    if files is not None:
        texts = {int(re.findall(r"\d+", p.stem)[-1]): p for p in files.glob("*[0-9].txt")}
        return {n: _matrix(_rows(path), path, 4) for n, path in texts.items()}, files.name
    path = _first(folder / name for name in PATHS)
    return (_path(path, frames), path.name) if path else ({}, "")


def _path(path: Path, frames: list[int]) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Poses one after another: of all frames, else of those that a Redwood log names."""
    numbers = _rows(path)
    each = 16 + 3 * (path.suffix == ".log")
    if numbers.size % each:
        raise UsageError(f"{path} holds {numbers.size} numbers, which are no poses of {each} each")
    rows = numbers.reshape(-1, each)
    named = rows[:, 0].astype(int).tolist() if each > 16 else []
    if len(rows) != len(frames) and not (named and {*named} <= {*frames}):
        raise UsageError(f"{path} has {len(rows)} poses for {len(frames)} frames")
    which = frames if len(rows) == len(frames) else named
    return dict(zip(which, rows[:, -16:].reshape(-1, 4, 4), strict=True))


def _rows(path: Path) -> Float[np.ndarray, " n"]:
    try:
        return np.array(path.read_text().split(), dtype=np.float64)
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error


def _matrix(numbers: Float[np.ndarray, " n"], path: Path, size: int) -> Float[np.ndarray, "k k"]:
    if numbers.size != size * size:
        raise UsageError(f"{path} holds {numbers.size} numbers, not {size} x {size}")
    return numbers.reshape(size, size)


def _unit_m(folder: Path) -> float:
    scale = _parameters(folder).get("scale")
    return 1.0 / float(scale) if scale else UNIT_M


def _parameters(folder: Path) -> dict[str, Any]:
    """What Replica says of its camera, in the folder or above it."""
    path = _first(place / PARAMETERS for place in (folder, folder.parent))
    return dict(_read_json(path).get("camera", {})) if path else {}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise UsageError(f"{path} is no JSON object ({error})") from error


def _intrinsics(folder: Path) -> dict[str, float]:
    """Focal lengths and centre of the depth camera [px]."""
    known = _parameters(folder)
    if {"fx", "fy", "cx", "cy"} <= known.keys():
        return {name: float(known[name]) for name in ("fx", "fy", "cx", "cy")}
    place = _first(folder / name for name in (*OPEN3D, *MATRICES))
    if place is None:
        names = ", ".join((*OPEN3D, *MATRICES, PARAMETERS))
        raise UsageError(
            f"{folder} does not say how its camera sees: none of {names} is there (3 x 3: fx 0 cx, "
            "0 fy cy, 0 0 1, in px)"
        )
    return _of_matrix(place)


def _of_matrix(path: Path) -> dict[str, float]:
    if path.suffix == ".json":
        columns = np.array(_read_json(path).get("intrinsic_matrix", ()), dtype=np.float64)
        K = _matrix(columns, path, 3).T
    else:
        numbers = _rows(path)
        K = _matrix(numbers, path, 4 if numbers.size == 16 else 3)
    return {"fx": float(K[0, 0]), "fy": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
