"""The latest frames of stationary cameras of a live cell, in bounded memory.

Takes messages as they arrive and turns them into frames, posed as recorded ones are, when asked;
says why there are none. Knows nothing of the network: whoever is connected hands the messages over.
"""

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Int

from bridge.clock import STEP_NS
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    JointSample,
    RawColor,
    color_from_message,
    string_from_cdr,
    transforms_from_cdr,
)
from bridge.episode.streams import PAIRING_TOLERANCE_NS, RgbdFrame, joint_track_of
from bridge.episode.topics import (
    CAMERAS,
    EVENT,
    JOINT_STATES,
    ROBOT_DESCRIPTION,
    TF,
    TF_STATIC,
    cell_topic,
    is_truth,
    type_of_topic,
)
from bridge.episode.transforms import TransformTree
from bridge.errors import GstError
from bridge.robots.robot import robot_of
from bridge.task.record import parse_record
from twin.errors import TwinError
from twin.robot.posture import PostureTrack, check_joints
from twin.scene.frames.camera_poses import AROUND_NS, CameraPoses, rooted_in_base
from twin.scene.frames.selection import with_true_depth
from twin.scene.localise.stationary_frames import common_root, is_stationary
from twin.scene.store.calibration import Calibration, MountedCamera, mounted_tree, unknown_postures

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
class LiveCell:
    """What is known at one moment of where things are."""

    tree: TransformTree
    mounts: Mapping[str, MountedCamera]
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
        check_joints(arm, "the cell", robot_of(self.urdf))
        return PostureTrack(urdf=self.urdf, arm=arm, widths=None)

    def poses(
        self, camera_id: str, color: str, depth: str, stamps_ns: Int[np.ndarray, " num_stamps"]
    ) -> CameraPoses:
        """Where a camera was: where it was calibrated, else where ``/tf`` says."""
        mount = self.mounts.get(camera_id)
        if mount is None:
            known = set(self.tree.frames())
            unknown = [frame for frame in (color, depth) if frame not in known]
            if unknown:
                raise CameraNotReadyError(f"no transform to {unknown[0]}")
            return CameraPoses(tree=self.tree, source="tf")
        track = None if mount.fixed else self.track
        # Around each image too: between far images a motion of the hand would not show.
        window = np.array([-AROUND_NS, 0, AROUND_NS])
        instants = np.unique(stamps_ns[:, None] + window)
        lost = unknown_postures(track, instants)
        if lost.issuperset(stamps_ns.tolist()) and len(stamps_ns):
            raise CameraNotReadyError("no joint states around its images, and it is in the hand")
        posed = np.array([t for t in instants.tolist() if t not in lost], dtype=np.int64)
        return CameraPoses(
            tree=mounted_tree(mount, (color, depth), self.tree, posed, track),
            source="hand-eye",
            unposed_ns=lost,
            depth_scale=mount.depth_scale,
        )


def frames_of(
    camera_id: str, camera: LiveCamera, cell: LiveCell, quiet_since_ns: int, max_frames: int
) -> tuple[str, list[RgbdFrame]]:
    """The frame that poses are in, and one camera's newest frames at rest.

    They are later than the last execution (cell's clock).
    """
    missing = [f"{name}/info" for name in ("color", "depth") if name not in camera.infos]
    if missing:
        raise CameraNotReadyError(f"no calibration on {' and '.join(missing)}")
    frame_id = camera.infos["color"].frame_id
    pairs = [
        (color, depth)
        for color, depth in _pairs(camera)
        if color.stamp_ns - AROUND_NS >= quiet_since_ns
    ]
    stamps_ns = np.array([color.stamp_ns for color, _ in pairs], dtype=np.int64)
    poses = cell.poses(camera_id, frame_id, camera.infos["depth"].frame_id, stamps_ns)
    pairs = [
        (color, depth)
        for color, depth in pairs
        if color.stamp_ns not in poses.unposed_ns
        and is_stationary(poses.tree, frame_id, color.stamp_ns)
    ]
    if not pairs:
        raise CameraNotReadyError("no colour and depth pair taken at rest since the last motion")
    oldest_ns = pairs[-1][0].stamp_ns - MAX_SPAN_NS
    tree, infos = poses.tree, camera.infos
    frames = [
        RgbdFrame(
            camera_id=camera_id,
            stamp_ns=color.stamp_ns,
            image_u8=replace(color, lens=infos["color"].lens).image_u8(),
            depth_m=depth.through(infos["depth"].lens).depth_m(),
            color_camera=infos["color"].camera,
            depth_camera=infos["depth"].camera,
            T_base_color=tree.T_root_frame(frame_id, color.stamp_ns),
            T_base_depth=tree.T_root_frame(camera.infos["depth"].frame_id, depth.stamp_ns),
        )
        for color, depth in pairs[-max_frames:]
        if color.stamp_ns >= oldest_ns
    ]
    return tree.root_of(frame_id), [with_true_depth(frame, poses) for frame in frames]


def _pairs(camera: LiveCamera) -> list[tuple[CompressedColor | RawColor, DepthImage]]:
    pairs = []
    for color in camera.colors:
        gaps_ns = [abs(depth.stamp_ns - color.stamp_ns) for depth in camera.depths]
        if gaps_ns and min(gaps_ns) <= PAIRING_TOLERANCE_NS:
            pairs.append((color, camera.depths[gaps_ns.index(min(gaps_ns))]))
    return pairs


KEPT_TRANSFORMS = 1000
KEPT_JOINTS = 2000
"""Four seconds of a robot that sends at 500 Hz."""
SET_BACK_SAMPLES = 25
"""So many joint states of the arm in a row from before the newest: the cell's clock was set back.
Fewer may be late, or another publisher's that speaks in between."""
MAX_CAMERAS = 16
MAX_FRAMES = 1000
"""Static frames; a flood of names must not fill the memory."""


@dataclass(frozen=True, kw_only=True)
class LiveFrames:
    """Frames taken since the last motion, and why cameras gave none."""

    frames: list[RgbdFrame]
    reasons: list[str]


class LiveView:
    """Remembers images, transforms and the robot description of one cell; thread safe."""

    def __init__(
        self, cell: str, calibration: Calibration | None = None, urdf: str | None = None
    ) -> None:
        """Listen for ``/<cell>/cam/...``, events, joint states, transforms and the URDF."""
        self._cell = cell
        self._calibration = calibration
        self._places = {} if calibration is None else dict(calibration.cameras)  # never ``/tf``
        self._joints: deque[bytes] = deque(maxlen=KEPT_JOINTS)
        self._heard_joints: tuple[JointSample, int] | None = None
        self._lock = threading.Lock()
        self._cameras: dict[str, LiveCamera] = {}
        self._static: dict[str, FrameTransform] = {}
        self._moving: deque[FrameTransform] = deque(maxlen=KEPT_TRANSFORMS)
        self._urdf = urdf
        self._hears_urdf = urdf is None
        self._executing: str | None = None
        self._quiet_since_ns = 0
        self._newest_ns = 0
        self._newest_joint_ns = 0
        self._num_behind = 0
        self._heard_ns = 0
        self.malformed = 0

    def take(self, topic: str, data: bytes, received_ns: int, type_name: str = "") -> None:
        """Remember one message (receiver's clock); an unreadable one is counted and passed over."""
        if is_truth(topic):
            return
        try:
            with self._lock:
                if topic == cell_topic(self._cell, JOINT_STATES):
                    self._take_joints(data, received_ns)
                else:
                    self._take(topic, data, type_name or type_of_topic(topic) or "")
                self._heard_ns = max(self._heard_ns, received_ns)
        except (GstError, codec.MalformedMessageError, ValueError):
            self.malformed += 1

    def _take(self, topic: str, data: bytes, type_name: str) -> None:
        if topic == TF:
            items = transforms_from_cdr(data)
            self._moving.extend(items)
            self._newest_ns = max([self._newest_ns, *(item.stamp_ns for item in items)])
        elif topic == TF_STATIC:
            for item in transforms_from_cdr(data):
                if item.child in self._static or len(self._static) < MAX_FRAMES:
                    self._static[item.child] = item
        elif topic == ROBOT_DESCRIPTION:
            self._urdf = string_from_cdr(data) if self._hears_urdf else self._urdf
        elif topic == cell_topic(self._cell, EVENT):
            self._take_event(data)
        elif topic.startswith(cell_topic(self._cell, CAMERAS)):
            self._take_image(topic, data, type_name)

    def _take_joints(self, data: bytes, received_ns: int) -> None:
        sample = JointSample.from_cdr(data)
        if self._is_of_arm(sample.names):
            self._watch_clock(sample.stamp_ns)
        self._joints.append(data)
        self._newest_ns = max(self._newest_ns, sample.stamp_ns)
        # A gripper may publish beside the arm: it does not take the arm's place.
        known = self._heard_joints
        if known is None or self._is_of_arm(sample.names) or not self._is_of_arm(known[0].names):
            self._heard_joints = sample, received_ns

    def _watch_clock(self, stamp_ns: int) -> None:
        """Notice a clock that was set back: a cell started again, a simulation from its start.

        What was seen by the old clock would be younger than all that follows, so it is forgotten,
        as tf2 clears its buffer when time jumps back. An execution that is running goes on.
        """
        if stamp_ns >= self._newest_joint_ns - STEP_NS:
            self._num_behind = 0
            self._newest_joint_ns = max(self._newest_joint_ns, stamp_ns)
            return
        self._num_behind += 1
        if self._num_behind < SET_BACK_SAMPLES:
            return
        self._num_behind = 0
        self._newest_joint_ns = self._newest_ns = self._quiet_since_ns = stamp_ns
        self._joints.clear()
        self._moving.clear()
        for camera in self._cameras.values():
            camera.colors.clear()
            camera.depths.clear()

    def _is_of_arm(self, names: Sequence[str]) -> bool:
        """Whether joint states name the whole arm; before its description, as many as ever."""
        if self._urdf is not None:
            return set(robot_of(self._urdf).joints) <= set(names)
        known = self._heard_joints
        return known is None or len(names) >= len(known[0].names)

    def _take_event(self, data: bytes) -> None:
        event = parse_record(data, name="event", package="bridge.episode")
        self._newest_ns = max(self._newest_ns, int(event["stamp_ns"]))
        if event["type"] == "execution_started":
            self._executing = str(event.get("plan_id") or "a plan")
        elif event["type"] == "execution_ended":
            self._executing = None
            self._quiet_since_ns = max(self._quiet_since_ns, int(event["stamp_ns"]))

    def _take_image(self, topic: str, data: bytes, type_name: str) -> None:
        parts = topic.split("/")
        if len(parts) != 6:
            return
        camera_id, stream, kind = parts[3:]
        if camera_id not in self._cameras and len(self._cameras) >= MAX_CAMERAS:
            return
        camera = self._cameras.setdefault(camera_id, LiveCamera())
        if kind == "info":
            camera.infos[stream] = CameraInfo.from_cdr(data)
        elif kind == "image" and stream == "color":
            camera.colors.append(color_from_message(type_name, data))
            self._newest_ns = max(self._newest_ns, camera.colors[-1].stamp_ns)
        elif kind == "image" and stream == "depth":
            camera.depths.append(DepthImage.from_message(type_name, data))

    def cameras_from(self) -> str:
        """By what the cameras are posed, in words."""
        if self._calibration is None or not self._places:
            return "cameras by /tf"
        names, known = ", ".join(sorted(self._places)), self._calibration.calibration_id
        cameras = "cameras" if len(self._places) > 1 else "camera"
        return f"{cameras} {names} by robot-gst calibrate ({known}), others by /tf"

    def urdf(self) -> str | None:
        """The robot description, None before it arrived."""
        return self._urdf

    def newest_ns(self) -> int:
        """Latest source time seen, on the cell's own clock; 0 before anything arrived."""
        return self._newest_ns

    def heard_ns(self) -> int:
        """When the last message arrived, on the receiver's clock; 0 before the first."""
        return self._heard_ns

    def joints(self) -> tuple[JointSample, int] | None:
        """The latest joint states, the arm's where there are several, and when they arrived.

        Stamped by the cell's clock, arrived by the receiver's; None before any.
        """
        return self._heard_joints

    def executing(self) -> str | None:
        """Id of the plan that is being executed right now, None at rest."""
        return self._executing

    def frames(self, *, max_age_ns: int, max_per_camera: int) -> LiveFrames:
        """Each camera's newest frames after the last execution; none too old on cell's clock."""
        with self._lock:  # copy only: decoding must not hold up the network
            cameras = {
                camera_id: LiveCamera(
                    infos=dict(camera.infos),
                    colors=camera.colors.copy(),
                    depths=camera.depths.copy(),
                )
                for camera_id, camera in sorted(self._cameras.items())
            }
            transforms = [*self._static.values(), *self._moving]
            joints, urdf = list(self._joints), self._urdf
            quiet_since_ns, newest_ns = self._quiet_since_ns, self._newest_ns
        if not cameras:
            return LiveFrames(
                frames=[], reasons=[f"no images on {cell_topic(self._cell, CAMERAS)}**"]
            )
        base_frame = robot_of(urdf or "").base_frame
        cell = LiveCell(
            tree=TransformTree(rooted_in_base(transforms, base_frame)),
            mounts=self._places,
            joints=joints,
            urdf=urdf,
        )
        found: dict[str, tuple[str, list[RgbdFrame]]] = {}
        reasons: list[str] = []
        for camera_id, camera in cameras.items():
            age_ns = newest_ns - max((image.stamp_ns for image in camera.colors), default=newest_ns)
            if age_ns > max_age_ns:
                reasons.append(f"{camera_id}: silent for {age_ns * 1e-9:.1f} s of the cell's time")
                continue
            try:
                found[camera_id] = frames_of(
                    camera_id, camera, cell, quiet_since_ns, max_per_camera
                )
            except GstError as error:
                reasons.append(f"{camera_id}: {error}")
        root = common_root([own for own, _ in found.values()], base_frame)
        reasons += [
            f"{camera_id}: its poses are in frame {own!r}, not in {root!r}"
            for camera_id, (own, _) in found.items()
            if own != root
        ]
        frames = [frame for own, some in found.values() if own == root for frame in some]
        return LiveFrames(frames=frames, reasons=reasons)
