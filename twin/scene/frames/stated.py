"""At which instants a recording says where a camera was, and at which it only seems to.

A transform tree answers at any instant: between two poses it interpolates, before the first and
after the last it gives the nearest. Far from any pose that is a guess, and it may be a bad one:
images stamped by another clock than /tf all get the first pose, or all the last.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Int

from bridge.episode.transforms import TransformTree
from twin.scene.frames.still import same_pose

FAR_NS = 500_000_000
"""A pose stated farther away in time says nothing of a camera that moves."""
STILL_M, STILL_RAD = 0.002, 0.0035
"""A camera whose pose varies less than these stands still."""
LOOKS = 40
"""Poses that are compared to see whether a camera ever moves."""


def unknown_mask(
    tree: TransformTree, frames: Iterable[str], stamps_ns: Int[np.ndarray, " num_stamps"]
) -> Bool[np.ndarray, " num_stamps"]:
    """Mark instants at which the pose of a frame is no number, or was stated by nobody around.

    Args:
        tree: Knows the frames.
        frames: All of them have to be known.
        stamps_ns: Source times.
    """
    unknown = np.zeros(len(stamps_ns), dtype=bool)
    for frame in frames:
        with np.errstate(invalid="ignore"):
            unknown |= ~np.isfinite(tree.Ts_root_frame(frame, stamps_ns)).all(axis=(1, 2))
        unknown |= _far_from_any(tree, frame, stamps_ns)
    return unknown


def apart_s(
    tree: TransformTree, frame: str, stamps_ns: Int[np.ndarray, " num_stamps"]
) -> float | None:
    """Least time between an instant and a stated pose [s]; None without either."""
    stated = tree.stamps_ns(frame)
    if len(stated) == 0 or len(stamps_ns) == 0:
        return None
    return float(np.min(_gaps_ns(stated, stamps_ns))) * 1e-9


def _far_from_any(
    tree: TransformTree, frame: str, stamps_ns: Int[np.ndarray, " num_stamps"]
) -> Bool[np.ndarray, " num_stamps"]:
    stated = tree.stamps_ns(frame)
    none = np.zeros(len(stamps_ns), dtype=bool)
    if len(stated) < 2:  # static
        return none
    far = _gaps_ns(stated, stamps_ns) > FAR_NS
    if not far.any() or _never_moves(tree, frame, stated):
        return none
    for index in np.flatnonzero(far):
        after = int(np.searchsorted(stated, stamps_ns[index]))
        if 0 < after < len(stated):  # whoever stands still may say so once
            before, behind = (tree.T_root_frame(frame, int(stated[k])) for k in (after - 1, after))
            far[index] = not same_pose(before, behind, distance_m=STILL_M, angle_rad=STILL_RAD)
    return np.asarray(far)


def _gaps_ns(
    stated: Int[np.ndarray, " num_stated"], stamps_ns: Int[np.ndarray, " num_stamps"]
) -> Int[np.ndarray, " num_stamps"]:
    """Time from each instant to the nearest stated one."""
    after = np.clip(np.searchsorted(stated, stamps_ns), 0, len(stated) - 1)
    before = np.maximum(after - 1, 0)
    gaps = np.minimum(np.abs(stated[after] - stamps_ns), np.abs(stated[before] - stamps_ns))
    return np.asarray(gaps)


def _never_moves(tree: TransformTree, frame: str, stated: Int[np.ndarray, " num_stated"]) -> bool:
    some = stated[np.unique(np.linspace(0, len(stated) - 1, LOOKS).round().astype(int))]
    Ts = tree.Ts_root_frame(frame, some)
    return all(same_pose(Ts[0], T, distance_m=STILL_M, angle_rad=STILL_RAD) for T in Ts)
