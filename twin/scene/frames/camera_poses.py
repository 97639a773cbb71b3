"""Where a camera was at each of its images: from ``/tf``, or from the images themselves."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Int

from bridge.episode import streams
from bridge.episode.cdr.messages import FrameTransform
from bridge.episode.reader import Episode
from bridge.episode.transforms import TransformTree
from bridge.geometry import se3
from bridge.terminal import Output
from twin.scene.frames.aligner import TrackConfig
from twin.scene.frames.base import base_tree
from twin.scene.frames.odometry import CameraPath, follow_camera
from twin.scene.frames.pairs import paired_stamps_ns
from twin.scene.frames.stated import FAR_NS, apart_s, unknown_mask
from twin.scene.frames.usable import UnusableCameraError, name_of
from twin.scene.settings import FrameConfig
from twin.scene.store.calibration import Calibration, CameraPlace, calibrated_tree, without_joints

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
    quality: Mapping[str, Any] = field(default_factory=dict)
    """What the odometry says of itself."""


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
        FrameNotFoundError: When ``/tf`` is asked for and does not know the camera.
        UnusableCameraError: When no image was taken while ``/tf`` or the joints said where the
            camera is, or ``/tf`` does not connect its colour and depth frames.
        LostError: When the odometry cannot follow the camera.
    """
    place = None if calibration is None else calibration.cameras.get(camera_id)
    if config.poses == "auto" and calibration is not None and place is not None:
        poses = calibrated_poses(episode, camera_id, place, stamps_ns)
        _say_unposed(poses, episode, camera_id, stamps_ns, output)
        return replace(poses, quality={"calibration_id": calibration.calibration_id})
    tree = base_tree(episode)
    if config.poses == "tf" or (config.poses == "auto" and places_camera(tree, episode, camera_id)):
        check_connected(tree, episode, camera_id)
        unknown = unknown_mask(tree, _frame_ids(episode, camera_id), stamps_ns)
        unposed = frozenset(stamps_ns[unknown].tolist())
        poses = CameraPoses(tree=tree, source="tf", unposed_ns=unposed)
        _say_unposed(poses, episode, camera_id, stamps_ns, output)
        return poses
    bare = _bare_tree(tree, episode, camera_id)
    with output.progress(f"follow camera {camera_id}", len(stamps_ns)) as advance:
        path = follow_camera(
            streams.rgbd_frames(episode, camera_id, bare),
            held_out_ns,
            TrackConfig(max_depth_m=config.max_depth_m),
            advance,
            name=name_of(episode, camera_id),
        )
    lost = frozenset(set(stamps_ns.tolist()) - path.Ts_first_depth.keys())
    output.say(f"camera {camera_id} of {episode.info.id}: {_describe(path, len(lost))}")
    return CameraPoses(
        tree=_tree_of(path, bare, episode, camera_id),
        source="odometry",
        unposed_ns=lost,
        quality=path.quality,
    )


def check_connected(tree: TransformTree, episode: Episode, camera_id: str) -> None:
    """See that colour and depth are posed in one frame.

    Raises:
        FrameNotFoundError: When the tree does not know the colour frame.
        UnusableCameraError: When nothing says how the depth frame lies to it.
    """
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
    place: CameraPlace,
    stamps_ns: Int[np.ndarray, " num_frames"],
) -> CameraPoses:
    """Pose a camera's images as ``robot-gst calibrate`` says it is mounted.

    Raises:
        EpisodeError: A camera in the hand, and no joint states.
        RobotDescriptionError: A camera in the hand, and no usable robot description.
    """
    return CameraPoses(
        tree=calibrated_tree(episode, camera_id, place, stamps_ns),
        source="hand-eye",
        unposed_ns=without_joints(episode, place, stamps_ns),
        depth_scale=place.depth_scale,
    )


def calibrated_tree_at(
    episode: Episode,
    camera_id: str,
    place: CameraPlace,
    stamps_ns: Int[np.ndarray, " num_stamps"],
) -> TransformTree:
    """Pose a calibrated camera at its images and at some more instants, where joints are known.

    Raises:
        EpisodeError: A camera in the hand, and no joint states.
        RobotDescriptionError: A camera in the hand, and no usable robot description.
    """
    stamps = np.unique(np.concatenate([paired_stamps_ns(episode, camera_id), stamps_ns]))
    lost = without_joints(episode, place, stamps)
    known = np.array([t for t in stamps.tolist() if t not in lost], dtype=np.int64)
    return calibrated_tree(episode, camera_id, place, known)


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
    witness = "/tf" if poses.source == "tf" else "joints"
    if len(poses.unposed_ns) < len(stamps_ns):
        output.say(
            f"{len(poses.unposed_ns)} of {len(stamps_ns)} frames of camera {camera_id} are left "
            f"out: {witness} says nothing within {FAR_NS * 1e-9:g} s of them, or a pose that is "
            "not finite"
        )
        return
    gap_s = apart_s(poses.tree, _frame_ids(episode, camera_id)[0], stamps_ns)
    least = f", {gap_s:.1f} s away at least" if gap_s and poses.source == "tf" else ""
    message = (
        f"no image of {name_of(episode, camera_id)} was taken while {witness} said where it "
        f"is{least}: clocks that differ, or recordings of different times. Record images and "
        f"{witness} by one clock, or rebuild with --poses odometry."
    )
    raise UnusableCameraError(message)


def places_camera(tree: TransformTree, episode: Episode, camera_id: str) -> bool:
    """Say whether ``/tf`` holds more of a camera than how its own parts lie to each other."""
    frame = streams.camera_info(episode, camera_id).frame_id
    if frame not in tree.frames():
        return False
    root = tree.root_of(frame)
    own = {frame, streams.camera_info(episode, camera_id, "depth").frame_id}
    return root not in own and not root.startswith(f"{camera_id}_")


def _bare_tree(tree: TransformTree, episode: Episode, camera_id: str) -> TransformTree:
    """The camera's own frames, its depth camera in the origin."""
    color, depth = _frame_ids(episode, camera_id)
    edges = [_edge(_root_name(episode, camera_id), depth, np.eye(4), 0)]
    if color != depth:
        T_depth_color = np.eye(4)
        known = set(tree.frames())
        if {color, depth} <= known and tree.root_of(color) == tree.root_of(depth):
            at = episode.start_ns
            T_depth_color = se3.invert(tree.T_root_frame(depth, at)) @ tree.T_root_frame(color, at)
        edges.append(_edge(depth, color, T_depth_color, 0))
    return TransformTree(edges)


def _tree_of(
    path: CameraPath, bare: TransformTree, episode: Episode, camera_id: str
) -> TransformTree:
    color, depth = _frame_ids(episode, camera_id)
    edges = [
        _edge(_root_name(episode, camera_id), depth, T_first_depth, stamp_ns)
        for stamp_ns, T_first_depth in path.Ts_first_depth.items()
    ]
    if color != depth:
        edges.append(_edge(depth, color, bare.T_root_frame(color, 0), 0))
    return TransformTree(edges)


def _root_name(episode: Episode, camera_id: str) -> str:
    return f"{ODOMETRY_FRAME}_{episode.info.id}_{camera_id}"


def _frame_ids(episode: Episode, camera_id: str) -> tuple[str, str]:
    color, depth = (
        streams.camera_info(episode, camera_id, stream).frame_id for stream in ("color", "depth")
    )
    return color, depth


def _edge(parent: str, child: str, T: np.ndarray, stamp_ns: int) -> FrameTransform:
    return FrameTransform(stamp_ns=stamp_ns, parent=parent, child=child, T_parent_child=T)


def _describe(path: CameraPath, num_lost: int) -> str:
    quality = path.quality
    text = (
        f"/tf has no poses; followed by RGB-D odometry: {quality['keyframes']} keyframes, "
        f"{quality['loop_closures']} loop closures, {100 * quality['agreement']:.0f} % of the "
        "depth agrees between them"
    )
    return text if num_lost == 0 else f"{text}; {num_lost} frames could not be placed"
