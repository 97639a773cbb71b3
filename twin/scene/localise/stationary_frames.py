"""Frames taken while their camera stood still, posed in the robot's base."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.streams import RgbdFrame
from bridge.episode.transforms import TransformTree
from bridge.errors import GstError
from twin.scene.frames.camera_poses import (
    AROUND_NS,
    CameraPoses,
    base_tree,
    calibrated_poses,
    check_connected,
    same_pose,
)
from twin.scene.frames.pairing import check_camera, paired_stamps_ns
from twin.scene.frames.selection import rgbd_camera_ids, spread, with_true_depth
from twin.scene.store.calibration import Calibration

STATIONARY_DISTANCE_M, STATIONARY_ANGLE_RAD = 1e-3, 3e-3

HeldOut = Mapping[str, Collection[int]]
"""Stamps of frames to leave out, by camera id."""
Poses = Mapping[str, CameraPoses]
"""Of cameras that were calibrated, by id; all others are where ``/tf`` says."""


def stationary_frames(
    episode: Episode,
    max_per_camera: int,
    after_ns: int | None = None,
    before_ns: int | None = None,
    *,
    evenly: bool = False,
    held_out_ns: HeldOut | None = None,
    poses: Poses | None = None,
) -> list[RgbdFrame]:
    """Frames of each camera taken in an interval while that camera did not move.

    Only the frames that are returned are ever in memory. A camera that cannot be used, or whose
    place in the robot's base nobody knows, is passed over as long as another one can.

    Args:
        evenly: Spread them evenly over the interval instead of taking the last ones.
    """
    tree = base_tree(episode)
    failed: list[GstError] = []
    usable: dict[str, tuple[CameraPoses, str, np.ndarray]] = {}
    camera_ids = rgbd_camera_ids(episode)
    for camera_id in camera_ids:
        known = (poses or {}).get(camera_id) or CameraPoses(tree=tree, source="tf")
        hidden = known.unposed_ns.union((held_out_ns or {}).get(camera_id, ()))
        try:
            known = replace(known, unposed_ns=hidden)
            usable[camera_id] = known, *_stationary(episode, camera_id, known, after_ns, before_ns)
        except GstError as error:
            failed.append(error)
    if failed and not usable:
        raise failed[0]
    base_frame = streams.recorded_robot(episode).base_frame
    root = common_root([own_root for _, own_root, _ in usable.values()], base_frame)
    frames: list[RgbdFrame] = []
    for camera_id, (posed, own_root, stamps) in usable.items():
        if own_root != root:
            continue
        chosen = spread(stamps, max_per_camera) if evenly else stamps[-max_per_camera:]
        found = streams.rgbd_frames(episode, camera_id, posed.tree, set(chosen.tolist()))
        frames.extend(with_true_depth(frame, posed) for frame in found)
    return frames


def _stationary(
    episode: Episode,
    camera_id: str,
    poses: CameraPoses,
    after_ns: int | None,
    before_ns: int | None,
) -> tuple[str, Int[np.ndarray, " num_frames"]]:
    """The frame a camera's poses are in, and when it stood still in an interval."""
    check_camera(episode, camera_id)
    frame_id = streams.camera_info(episode, camera_id, "color").frame_id
    check_connected(poses.tree, episode, camera_id)
    stamps = paired_stamps_ns(episode, camera_id)
    if after_ns is not None:
        stamps = stamps[stamps > after_ns]
    if before_ns is not None:
        stamps = stamps[stamps < before_ns]
    stationary = [
        stamp
        for stamp in stamps.tolist()
        if stamp not in poses.unposed_ns and is_stationary(poses.tree, frame_id, stamp, before_ns)
    ]
    return poses.tree.root_of(frame_id), np.array(stationary, dtype=np.int64)


def common_root(roots: Sequence[str], base_frame: str) -> str | None:
    """The frame in which objects are looked for: the robot's base where a camera is posed in it."""
    return base_frame if base_frame in roots else next(iter(roots), None)


def is_stationary(
    tree: TransformTree, frame_id: str, stamp_ns: int, until_ns: int | None = None
) -> bool:
    """Say whether a frame's pose is the same shortly before and after an instant."""
    last_ns = stamp_ns + AROUND_NS
    last_ns = last_ns if until_ns is None else min(last_ns, until_ns)
    before = tree.T_root_frame(frame_id, stamp_ns - AROUND_NS)
    after = tree.T_root_frame(frame_id, last_ns)
    return same_pose(
        before, after, distance_m=STATIONARY_DISTANCE_M, angle_rad=STATIONARY_ANGLE_RAD
    )


def calibrated_cameras(episode: Episode, calibration: Calibration | None) -> Poses:
    """Where the cameras of an episode are, as far as they were calibrated."""
    mounts = {} if calibration is None else calibration.cameras
    return {
        key: calibrated_poses(episode, key, mounts[key], paired_stamps_ns(episode, key))
        for key in rgbd_camera_ids(episode)
        if key in mounts
    }
