"""Frames of one camera of a live cell, posed as recorded ones are."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Int

from bridge.episode.cdr.messages import CameraInfo, CompressedColor, DepthImage, RawColor
from bridge.episode.streams import PAIRING_TOLERANCE_NS, RgbdFrame, joint_track_of
from bridge.episode.transforms import TransformTree
from twin.errors import TwinError
from twin.robot.posture import PostureTrack, check_joints
from twin.scene.frames.camera_poses import CameraPoses
from twin.scene.localise.still_frames import STILL_WINDOW_NS, is_still, with_true_depth
from twin.scene.store.calibration import CameraPlace, mounted_tree, unknown_postures

KEPT_IMAGES = 6
MAX_SPAN_NS = 1_000_000_000
"""Frames of one camera that are used together lie at most this far apart."""


@dataclass(kw_only=True)
class LiveCamera:
    """What one camera sent last."""

    infos: dict[str, CameraInfo] = field(default_factory=dict)
    colors: deque[CompressedColor | RawColor] = field(
        default_factory=lambda: deque(maxlen=KEPT_IMAGES)
    )
    depths: deque[DepthImage] = field(default_factory=lambda: deque(maxlen=KEPT_IMAGES))


class CameraNotReadyError(TwinError):
    """A camera gives no frames yet; the message says what is missing."""


@dataclass(frozen=True, kw_only=True)
class PosedFrames:
    """Frames of one camera, and the frame their poses are in."""

    root: str
    frames: list[RgbdFrame]


@dataclass(frozen=True, kw_only=True)
class LiveCell:
    """What is known at one moment of where things are."""

    tree: TransformTree
    places: Mapping[str, CameraPlace]
    joints: Sequence[bytes]
    urdf: str | None

    @cached_property
    def track(self) -> PostureTrack:
        """Where the hand was lately."""
        if self.urdf is None:
            raise CameraNotReadyError("no robot description has arrived, and it is in the hand")
        arm = joint_track_of(self.joints)
        if arm is None:
            raise CameraNotReadyError("no joint states have arrived, and it is in the hand")
        check_joints(arm, "the cell")
        return PostureTrack(urdf=self.urdf, arm=arm, widths=None)

    def poses(
        self, camera_id: str, color: str, depth: str, stamps_ns: Int[np.ndarray, " num_stamps"]
    ) -> CameraPoses:
        """Where a camera was: where it was calibrated, else where ``/tf`` says."""
        place = self.places.get(camera_id)
        if place is None:
            known = set(self.tree.frames())
            unknown = [frame for frame in (color, depth) if frame not in known]
            if unknown:
                raise CameraNotReadyError(f"no transform to {unknown[0]}")
            return CameraPoses(tree=self.tree, source="tf")
        track = None if place.fixed else self.track
        # Around each image too: between far images a motion of the hand would not show.
        window = np.array([-STILL_WINDOW_NS, 0, STILL_WINDOW_NS])
        instants = np.unique(stamps_ns[:, None] + window)
        lost = unknown_postures(track, instants)
        if lost.issuperset(stamps_ns.tolist()) and len(stamps_ns):
            raise CameraNotReadyError("no joint states around its images, and it is in the hand")
        posed = np.array([t for t in instants.tolist() if t not in lost], dtype=np.int64)
        return CameraPoses(
            tree=mounted_tree(place, (color, depth), self.tree, posed, track),
            source="hand-eye",
            unposed_ns=lost,
            depth_scale=place.depth_scale,
        )


def frames_of(
    camera_id: str, camera: LiveCamera, cell: LiveCell, quiet_since_ns: int, max_frames: int
) -> PosedFrames:
    """The newest frames of one camera, taken at rest since the last execution ended.

    Raises:
        CameraNotReadyError: When there are none; what is missing.
        RobotDescriptionError: A camera in the hand of another robot.
    """
    missing = [f"{name}/info" for name in ("color", "depth") if name not in camera.infos]
    if missing:
        raise CameraNotReadyError(f"no calibration on {' and '.join(missing)}")
    frame_id = camera.infos["color"].frame_id
    pairs = [
        (color, depth)
        for color, depth in _pairs(camera)
        if color.stamp_ns - STILL_WINDOW_NS >= quiet_since_ns
    ]
    stamps_ns = np.array([color.stamp_ns for color, _ in pairs], dtype=np.int64)
    poses = cell.poses(camera_id, frame_id, camera.infos["depth"].frame_id, stamps_ns)
    pairs = [
        (color, depth)
        for color, depth in pairs
        if color.stamp_ns not in poses.unposed_ns and is_still(poses.tree, frame_id, color.stamp_ns)
    ]
    if not pairs:
        raise CameraNotReadyError("no colour and depth pair taken at rest since the last motion")
    oldest_ns = pairs[-1][0].stamp_ns - MAX_SPAN_NS
    frames = [
        with_true_depth(_frame(camera_id, camera.infos, poses.tree, color, depth), poses)
        for color, depth in pairs[-max_frames:]
        if color.stamp_ns >= oldest_ns
    ]
    return PosedFrames(root=poses.tree.root_of(frame_id), frames=frames)


def _pairs(camera: LiveCamera) -> list[tuple[CompressedColor | RawColor, DepthImage]]:
    pairs = []
    for color in camera.colors:
        gaps_ns = [abs(depth.stamp_ns - color.stamp_ns) for depth in camera.depths]
        if gaps_ns and min(gaps_ns) <= PAIRING_TOLERANCE_NS:
            pairs.append((color, camera.depths[gaps_ns.index(min(gaps_ns))]))
    return pairs


def _frame(
    camera_id: str,
    infos: dict[str, CameraInfo],
    tree: TransformTree,
    color: CompressedColor | RawColor,
    depth: DepthImage,
) -> RgbdFrame:
    return RgbdFrame(
        camera_id=camera_id,
        stamp_ns=color.stamp_ns,
        image_u8=color.image_u8(),
        depth_m=depth.depth_m(),
        color_camera=infos["color"].camera,
        depth_camera=infos["depth"].camera,
        T_base_color=tree.T_root_frame(infos["color"].frame_id, color.stamp_ns),
        T_base_depth=tree.T_root_frame(infos["depth"].frame_id, depth.stamp_ns),
    )
