"""Where the cameras hang: the user's calibration, read from a small JSON file."""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bridge.errors import PathNotFoundError
from bridge.geometry import se3
from bridge.sources.realsense.errors import MountsError

ROUNDED = 0.01
"""Quaternions written by hand have few digits; a length this far from one is still a rotation."""
Mount = tuple[str, Float[np.ndarray, "4 4"]]
"""Parent frame and ``T_parent_color``."""


def read_mounts(path: Path, cameras: list[str]) -> dict[str, Mount]:
    """Read the pose of the colour cameras.

    Args:
        path: The file named by --mounts.
        cameras: Names that may occur in it.

    Raises:
        MountsError: When an entry is not a pose of a known camera.
    """
    if not path.is_file():
        raise PathNotFoundError(path=path, what="mounts file", hint="Check --mounts.")
    try:
        entries = json.loads(path.read_bytes())
    except ValueError as error:
        raise MountsError(path=path, found=f"not JSON ({error})") from error
    if not isinstance(entries, dict):
        raise MountsError(path=path, found="not a table of cameras")
    mounts = {}
    for name, entry in entries.items():
        if name not in cameras:
            listed = ", ".join(cameras)
            raise MountsError(path=path, found=f"camera {name!r} is not one of {listed}")
        mounts[name] = _mount(path, name, entry)
    return mounts


def _mount(path: Path, name: str, entry: object) -> Mount:
    try:
        parent = str(entry["parent"])  # type: ignore[index]
        p_m = np.array(entry["p_m"], dtype=np.float64)  # type: ignore[index]
        q_wxyz = np.array(entry["q_wxyz"], dtype=np.float64)  # type: ignore[index]
    except (KeyError, TypeError, ValueError) as error:
        raise MountsError(path=path, found=f"{name}: {error!r}") from error
    if p_m.shape != (3,) or q_wxyz.shape != (4,) or not parent:
        raise MountsError(path=path, found=f"{name}: wrong number of values")
    if not (np.isfinite(p_m).all() and abs(np.linalg.norm(q_wxyz) - 1.0) < ROUNDED):
        raise MountsError(path=path, found=f"{name}: q_wxyz is not a unit quaternion")
    return parent, se3.transform_from(q_wxyz, p_m)
