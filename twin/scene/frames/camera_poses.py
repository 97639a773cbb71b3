"""Where a camera was at each of its images: from ``/tf``, a calibration, or the images themselves.

A transform tree answers at any instant: between two poses it interpolates, before the first and
after the last it gives the nearest. Far from any pose that is a guess: images stamped by another
clock than ``/tf`` all get the first pose, or all the last. Such instants are marked as unknown. The
root of all frames is the robot's base, wherever ``/tf`` says where it is.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.episode import streams
from bridge.episode.cdr.messages import FrameTransform
from bridge.episode.reader import Episode
from bridge.episode.transforms import TransformTree
from bridge.geometry import se3
from bridge.terminal import Output
from twin.scene.frames.odometry import CameraPath, follow_camera
from twin.scene.frames.pairing import UnusableCameraError, has_depth, name_of, paired_stamps_ns
from twin.scene.settings import FrameConfig
from twin.scene.store.calibration import (
    Calibration,
    MountedCamera,
    calibrated_tree,
    edge,
    without_joints,
)


def same_pose(
    T_base_a: Float[np.ndarray, "4 4"],
    T_base_b: Float[np.ndarray, "4 4"],
    *,
    distance_m: float,
    angle_rad: float,
) -> bool:
    """Say whether two poses lie nearer to each other than both limits."""
    near = np.linalg.norm(T_base_a[:3, 3] - T_base_b[:3, 3]) < distance_m
    return bool(near and se3.rotation_angle_rad(T_base_a[:3, :3].T @ T_base_b[:3, :3]) < angle_rad)


FAR_NS = 500_000_000
"""A pose published farther away in time says nothing of a camera that moves."""
AROUND_NS = 40_000_000
"""A camera is still when its pose is the same this long before and after an image."""
STATIONARY_M, STATIONARY_RAD = 0.002, 0.0035
"""A camera whose pose varies less than these stands still."""
LOOKS = 40
"""Poses that are compared to see whether a camera ever moves."""


def unknown_mask(
    tree: TransformTree, frames: Iterable[str], stamps_ns: Int[np.ndarray, " num_stamps"]
) -> Bool[np.ndarray, " num_stamps"]:
    """Mark instants at which the pose of a frame is not finite, or was not published near by."""
    unknown = np.zeros(len(stamps_ns), dtype=bool)
    for frame in frames:
        with np.errstate(invalid="ignore"):
            unknown |= ~np.isfinite(tree.Ts_root_frame(frame, stamps_ns)).all(axis=(1, 2))
        unknown |= _far_from_any(tree, frame, stamps_ns)
    return unknown


def _far_from_any(
    tree: TransformTree, frame: str, stamps_ns: Int[np.ndarray, " num_stamps"]
) -> Bool[np.ndarray, " num_stamps"]:
    posed_ns = tree.stamps_ns(frame)
    none = np.zeros(len(stamps_ns), dtype=bool)
    if len(posed_ns) < 2:  # static
        return none
    far = _gaps_ns(posed_ns, stamps_ns) > FAR_NS
    if not far.any() or never_moves(tree, frame, posed_ns):
        return none
    for index in np.flatnonzero(far):
        after = int(np.searchsorted(posed_ns, stamps_ns[index]))
        if 0 < after < len(posed_ns):  # a stationary camera may say so once
            before, behind = (
                tree.T_root_frame(frame, int(posed_ns[k])) for k in (after - 1, after)
            )
            far[index] = not same_pose(
                before, behind, distance_m=STATIONARY_M, angle_rad=STATIONARY_RAD
            )
    return np.asarray(far)


def _gaps_ns(
    posed_ns: Int[np.ndarray, " num_poses"], stamps_ns: Int[np.ndarray, " num_stamps"]
) -> Int[np.ndarray, " num_stamps"]:
    """Time from each instant to the nearest published pose."""
    after = np.clip(np.searchsorted(posed_ns, stamps_ns), 0, len(posed_ns) - 1)
    before = np.maximum(after - 1, 0)
    gaps = np.minimum(np.abs(posed_ns[after] - stamps_ns), np.abs(posed_ns[before] - stamps_ns))
    return np.asarray(gaps)


def never_moves(tree: TransformTree, frame: str, posed_ns: Int[np.ndarray, " num_poses"]) -> bool:
    """Say whether a frame stays where it is in its root frame."""
    some = posed_ns[np.unique(np.linspace(0, len(posed_ns) - 1, LOOKS).round().astype(int))]
    Ts = tree.Ts_root_frame(frame, some)
    return all(same_pose(Ts[0], T, distance_m=STATIONARY_M, angle_rad=STATIONARY_RAD) for T in Ts)


SAME = 1e-6
"""A base whose pose varies by more, in metres or in a rotation's entries, drives about."""


def base_tree(episode: Episode) -> TransformTree:
    """Collect ``/tf`` and ``/tf_static``; see ``rooted_in_base``."""
    base_frame = streams.recorded_robot(episode).base_frame
    return TransformTree(rooted_in_base(streams.transforms(episode), base_frame))


def rooted_in_base(transforms: Sequence[FrameTransform], base_frame: str) -> list[FrameTransform]:
    """Turn round what lies between the robot's base and the root above it.

    Drivers often hang the base on a frame ``world``. Joints, plans and objects are given in the
    base, so the scene has to be, too. A base that moves in its root keeps it: the surroundings
    do not move then.
    """
    parents = {item.child: item.parent for item in transforms}
    above: list[str] = []
    frame = base_frame
    while frame in parents and frame not in above:
        above.append(frame)
        frame = parents[frame]
    first = {item.child: item for item in reversed(transforms)}
    stands = all(  # each has always the same place in the same parent
        item.parent == first[item.child].parent
        and np.allclose(item.T_parent_child, first[item.child].T_parent_child, rtol=0.0, atol=SAME)
        for item in transforms
        if item.child in above
    )
    if not above or not stands:
        return list(transforms)
    return [
        FrameTransform(
            stamp_ns=item.stamp_ns,
            parent=item.child,
            child=item.parent,
            T_parent_child=se3.invert(item.T_parent_child),
        )
        if item.child in above
        else item
        for item in transforms
    ]


ODOMETRY_FRAME = "odometry"
"""Begin of the name of the root frame of a scan without poses: the depth camera at the first frame
that is not held out. Each recording has its own."""
SAYS = {
    "tf": "/tf of the recording",
    "hand-eye": "robot-gst calibrate",
    "odometry": "RGB-D odometry of the images themselves",
}
PoseSource = Literal["tf", "hand-eye", "odometry"]


@dataclass(frozen=True, kw_only=True)
class CameraPoses:
    """Poses of one camera's images, and how much to think of them."""

    tree: TransformTree
    """Knows the camera's colour and depth frame."""
    source: PoseSource
    unposed_ns: frozenset[int] = frozenset()
    """Images whose pose is not known."""
    depth_scale: float = 1.0
    """True depth divided by measured depth, where a calibration knows it."""


def find_poses(
    episode: Episode,
    camera_id: str,
    stamps_ns: Int[np.ndarray, " num_frames"],
    held_out_ns: frozenset[int],
    config: FrameConfig,
    output: Output,
    calibration: Calibration | None = None,
) -> CameraPoses:
    """Take what ``calibrate`` found, else the poses of ``/tf``, else follow the images.

    Frames that are held out get a pose from the odometry too, but nothing is learnt from them:
    neither the path of the camera nor its loop closures.

    Raises:
        BridgeError: When ``/tf`` is asked for and does not know the camera.
        UnusableCameraError: When no image was taken while ``/tf`` or the joints said where the
            camera is, or ``/tf`` does not connect its colour and depth frames.
        LostError: When the odometry cannot follow the camera.
    """
    mount = None if calibration is None else calibration.cameras.get(camera_id)
    if config.poses == "auto" and mount is not None:
        poses = calibrated_poses(episode, camera_id, mount, stamps_ns)
        _say_unposed(poses, episode, camera_id, stamps_ns, output)
        return poses
    tree = base_tree(episode)
    if config.poses == "tf" or (config.poses == "auto" and places_camera(tree, episode, camera_id)):
        check_connected(tree, episode, camera_id)
        unknown = unknown_mask(tree, _frame_ids(episode, camera_id), stamps_ns)
        unposed = frozenset(stamps_ns[unknown].tolist())
        poses = CameraPoses(tree=tree, source="tf", unposed_ns=unposed)
        _say_unposed(poses, episode, camera_id, stamps_ns, output)
        return poses
    if not has_depth(episode, camera_id):
        message = (
            f"/tf does not say where {name_of(episode, camera_id)} was, and without depth its "
            "images cannot be followed. Record its poses, or depth."
        )
        raise UnusableCameraError(message)
    bare = _bare_tree(tree, episode, camera_id)
    with output.progress(f"follow camera {camera_id}", len(stamps_ns)) as advance:
        path = follow_camera(
            streams.rgbd_frames(episode, camera_id, bare),
            held_out_ns,
            config.max_depth_m,
            advance,
            name=name_of(episode, camera_id),
        )
    lost = frozenset(set(stamps_ns.tolist()) - path.Ts_first_depth.keys())
    output.say(f"camera {camera_id} of {episode.info.id}: {_describe(path, len(lost))}")
    return CameraPoses(
        tree=_tree_of(path, bare, episode, camera_id),
        source="odometry",
        unposed_ns=lost,
    )


def check_connected(tree: TransformTree, episode: Episode, camera_id: str) -> None:
    """See that colour and depth are posed in one frame."""
    color, depth = _frame_ids(episode, camera_id)
    root = tree.root_of(color)
    if depth not in tree.frames() or tree.root_of(depth) != root:
        message = (
            f"{name_of(episode, camera_id)}: /tf does not say how its depth frame {depth!r} lies "
            f"to its colour frame {color!r}. Record the transform between them, or give both "
            "streams one frame where depth is registered to colour."
        )
        raise UnusableCameraError(message)


def calibrated_poses(
    episode: Episode,
    camera_id: str,
    mount: MountedCamera,
    stamps_ns: Int[np.ndarray, " num_frames"],
) -> CameraPoses:
    """Pose a camera around its images as ``robot-gst calibrate`` says it is mounted."""
    instants = np.unique(stamps_ns[:, None] + np.array([-AROUND_NS, 0, AROUND_NS]))
    return CameraPoses(
        tree=calibrated_tree(episode, camera_id, mount, instants),
        source="hand-eye",
        unposed_ns=without_joints(episode, mount, stamps_ns),
        depth_scale=mount.depth_scale,
    )


def poses_shifted(
    poses: CameraPoses,
    episode: Episode,
    camera_id: str,
    T_posed_true: Float[np.ndarray, "4 4"] | None,
) -> CameraPoses:
    """Poses of a camera that is elsewhere than they say.

    Args:
        T_posed_true: Its colour frame, seen from where it was said to be; None: nobody knows.
    """
    stamps = paired_stamps_ns(episode, camera_id)
    if T_posed_true is None:
        return replace(poses, unposed_ns=frozenset(stamps.tolist()))
    (color, depth), tree, edges = _frame_ids(episode, camera_id), poses.tree, []
    for stamp in (t for t in stamps.tolist() if t not in poses.unposed_ns):
        T_posed = tree.T_root_frame(color, stamp)
        T_new_old = T_posed @ T_posed_true @ se3.invert(T_posed)
        for frame in {color, depth}:
            T = T_new_old @ tree.T_root_frame(frame, stamp)
            edges.append(edge(tree.root_of(color), frame, T, stamp))
    return replace(poses, tree=TransformTree(edges))


def calibrated_tree_at(
    episode: Episode,
    camera_id: str,
    mount: MountedCamera,
    stamps_ns: Int[np.ndarray, " num_stamps"],
) -> TransformTree:
    """Pose a calibrated camera at its images and at some more instants, where joints are known."""
    stamps = np.unique(np.concatenate([paired_stamps_ns(episode, camera_id), stamps_ns]))
    lost = without_joints(episode, mount, stamps)
    known = np.array([t for t in stamps.tolist() if t not in lost], dtype=np.int64)
    return calibrated_tree(episode, camera_id, mount, known)


def _say_unposed(
    poses: CameraPoses,
    episode: Episode,
    camera_id: str,
    stamps_ns: Int[np.ndarray, " num_frames"],
    output: Output,
) -> None:
    """Count the images without a pose; refuse the camera when they are all of them."""
    if not poses.unposed_ns:
        return
    clock = "/tf" if poses.source == "tf" else "joints"
    if len(poses.unposed_ns) < len(stamps_ns):
        output.say(
            f"{len(poses.unposed_ns)} of {len(stamps_ns)} frames of camera {camera_id} are left "
            f"out: {clock} says nothing within {FAR_NS * 1e-9:g} s of them, or a pose that is "
            "not finite"
        )
        return
    posed_ns, least = poses.tree.stamps_ns(_frame_ids(episode, camera_id)[0]), ""
    if len(posed_ns) and poses.source == "tf":
        least = f", {1e-9 * float(np.min(_gaps_ns(posed_ns, stamps_ns))):.1f} s away at least"
    message = (
        f"no image of {name_of(episode, camera_id)} was taken while {clock} said where it "
        f"is{least}: clocks that differ, or recordings of different times. Record images and "
        f"{clock} by one clock, or rebuild with --poses odometry."
    )
    raise UnusableCameraError(message)


def places_camera(tree: TransformTree, episode: Episode, camera_id: str) -> bool:
    """Say whether ``/tf`` holds more of a camera than how its own parts lie to each other."""
    frame = streams.camera_info(episode, camera_id).frame_id
    if frame not in tree.frames():
        return False
    root = tree.root_of(frame)
    return root not in _frame_ids(episode, camera_id) and not root.startswith(f"{camera_id}_")


def _bare_tree(tree: TransformTree, episode: Episode, camera_id: str) -> TransformTree:
    """The camera's own frames, its depth camera in the origin."""
    color, depth = _frame_ids(episode, camera_id)
    edges = [edge(_root_name(episode, camera_id), depth, np.eye(4), 0)]
    if color != depth:
        T_depth_color = np.eye(4)
        known = set(tree.frames())
        if {color, depth} <= known and tree.root_of(color) == tree.root_of(depth):
            at = episode.start_ns
            T_depth_color = se3.invert(tree.T_root_frame(depth, at)) @ tree.T_root_frame(color, at)
        edges.append(edge(depth, color, T_depth_color, 0))
    return TransformTree(edges)


def _tree_of(
    path: CameraPath, bare: TransformTree, episode: Episode, camera_id: str
) -> TransformTree:
    color, depth = _frame_ids(episode, camera_id)
    edges = [
        edge(_root_name(episode, camera_id), depth, T_first_depth, stamp_ns)
        for stamp_ns, T_first_depth in path.Ts_first_depth.items()
    ]
    if color != depth:
        edges.append(edge(depth, color, bare.T_root_frame(color, 0), 0))
    return TransformTree(edges)


def _root_name(episode: Episode, camera_id: str) -> str:
    return f"{ODOMETRY_FRAME}_{episode.info.id}_{camera_id}"


def _frame_ids(episode: Episode, camera_id: str) -> tuple[str, str]:
    """Of colour and depth; of colour twice where no depth was recorded."""
    color = streams.camera_info(episode, camera_id).frame_id
    if not has_depth(episode, camera_id):
        return color, color
    return color, streams.camera_info(episode, camera_id, "depth").frame_id


def _describe(path: CameraPath, num_lost: int) -> str:
    quality = path.quality
    text = (
        f"/tf has no poses; followed by RGB-D odometry: {quality['keyframes']} keyframes, "
        f"{quality['loop_closures']} loop closures, {100 * quality['agreement']:.0f} % of the "
        "depth agrees between them"
    )
    return text if num_lost == 0 else f"{text}; {num_lost} frames could not be placed"
