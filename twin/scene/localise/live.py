"""The latest still frames of a live cell, in bounded memory.

Takes messages as they arrive and turns them into posed frames when asked. Says in a sentence why
there are none. Knows nothing of the network: whoever is connected hands the messages over.
"""

import threading
from collections import deque
from dataclasses import dataclass

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import (
    CameraInfo,
    DepthImage,
    FrameTransform,
    JointSample,
    color_from_message,
    string_from_cdr,
    transforms_from_cdr,
)
from bridge.episode.streams import RgbdFrame
from bridge.episode.transforms import TransformTree
from bridge.errors import GstError
from bridge.task.record import parse_record
from twin.scene.frames.base import rooted_in_base
from twin.scene.localise.live_frames import LiveCamera, LiveCell, PosedFrames, frames_of
from twin.scene.localise.still_frames import common_root
from twin.scene.store.calibration import Calibration

KEPT_TRANSFORMS = 1000
KEPT_JOINTS = 2000
"""Four seconds of a robot that sends at 500 Hz."""
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

    def __init__(self, cell: str, calibration: Calibration | None = None) -> None:
        """Listen for ``/<cell>/cam/...``, ``/<cell>/event``, transforms and the URDF.

        Args:
            cell: Its name.
            calibration: Of the run. Cameras in it are where it says, and never where ``/tf`` does;
                for those in the hand ``/<cell>/joint_states`` is listened for, too.
        """
        self._cell = cell
        self._calibration = calibration
        self._places = {} if calibration is None else dict(calibration.cameras)
        self._joints: deque[bytes] = deque(maxlen=KEPT_JOINTS)
        self._lock = threading.Lock()
        self._cameras: dict[str, LiveCamera] = {}
        self._static: dict[str, FrameTransform] = {}
        self._moving: deque[FrameTransform] = deque(maxlen=KEPT_TRANSFORMS)
        self._urdf: str | None = None
        self._executing: str | None = None
        self._quiet_since_ns = 0
        self._newest_ns = 0
        self._heard_ns = 0
        self.malformed = 0

    def take(self, topic: str, data: bytes, received_ns: int, type_name: str = "") -> None:
        """Remember one message; one that cannot be read is counted and passed over.

        Args:
            topic: Where it was published.
            data: As it came.
            received_ns: On the receiver's clock.
            type_name: Of an image: raw or compressed; "" is what the topic's name promises.
        """
        if schema.is_truth(topic) or (topic == self._joint_topic and not self.needs_joints):
            return
        try:
            with self._lock:
                self._take(topic, data, type_name or schema.type_of_topic(topic) or "")
                self._heard_ns = max(self._heard_ns, received_ns)
        except (GstError, codec.MalformedMessageError, ValueError):
            self.malformed += 1

    def _take(self, topic: str, data: bytes, type_name: str) -> None:
        if topic == "/tf":
            items = transforms_from_cdr(data)
            self._moving.extend(items)
            self._newest_ns = max([self._newest_ns, *(item.stamp_ns for item in items)])
        elif topic == "/tf_static":
            for item in transforms_from_cdr(data):
                if item.child in self._static or len(self._static) < MAX_FRAMES:
                    self._static[item.child] = item
        elif topic == "/robot_description":
            self._urdf = string_from_cdr(data)
        elif topic == self._joint_topic:
            sample = JointSample.from_cdr(data)
            self._joints.append(data)
            self._newest_ns = max(self._newest_ns, sample.stamp_ns)
        elif topic == f"/{self._cell}/event":
            self._take_event(data)
        elif topic.startswith(f"/{self._cell}/cam/"):
            self._take_image(topic, data, type_name)

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

    @property
    def _joint_topic(self) -> str:
        return f"/{self._cell}/joint_states"

    @property
    def needs_joints(self) -> bool:
        """Whether a camera was calibrated in the hand."""
        return any(not place.fixed for place in self._places.values())

    def cameras_from(self) -> str:
        """By what the cameras are posed, in words."""
        if self._calibration is None or not self._places:
            return "cameras by /tf"
        names = sorted(self._places)
        return (
            f"camera{'s' if len(names) > 1 else ''} {', '.join(names)} by robot-gst calibrate "
            f"({self._calibration.calibration_id}), others by /tf"
        )

    def urdf(self) -> str | None:
        """The robot description, None before it arrived."""
        with self._lock:
            return self._urdf

    def newest_ns(self) -> int:
        """Latest source time seen, on the cell's own clock; 0 before anything arrived."""
        with self._lock:
            return self._newest_ns

    def heard_ns(self) -> int:
        """When the last message arrived, on the receiver's clock; 0 before the first."""
        with self._lock:
            return self._heard_ns

    def executing(self) -> str | None:
        """Id of the plan that is being executed right now, None at rest."""
        with self._lock:
            return self._executing

    def frames(self, *, max_age_ns: int, max_per_camera: int) -> LiveFrames:
        """The newest frames of each camera since the last execution ended.

        Args:
            max_age_ns: A camera gives nothing when its last image is older than this, on the
                cell's own clock: the cell went on talking and the camera did not.
            max_per_camera: At most so many frames of one camera.
        """
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
            return LiveFrames(frames=[], reasons=[f"no images on /{self._cell}/cam/**"])
        cell = LiveCell(
            tree=TransformTree(rooted_in_base(transforms)),
            places=self._places,
            joints=joints,
            urdf=urdf,
        )
        found: dict[str, PosedFrames] = {}
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
        root = common_root([item.root for item in found.values()])
        reasons += [
            f"{camera_id}: its poses are in frame {item.root!r}, not in {root!r}"
            for camera_id, item in found.items()
            if item.root != root
        ]
        frames = [f for item in found.values() if item.root == root for f in item.frames]
        return LiveFrames(frames=frames, reasons=reasons)
