"""The latest still frames of a live cell, in bounded memory.

Takes messages as they arrive and turns them into posed frames when asked. Says in a sentence why
there are none. Knows nothing of the network: whoever is connected hands the messages over.
"""

import threading
from collections import deque
from dataclasses import dataclass, field

from bridge.episode import cdr, schema
from bridge.episode.records import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    RawColor,
    color_from_message,
    string_from_cdr,
    transforms_from_cdr,
)
from bridge.episode.streams import PAIRING_TOLERANCE_NS, RgbdFrame
from bridge.episode.transforms import TransformTree
from bridge.errors import GstError
from bridge.task.record import parse_record
from twin.errors import TwinError
from twin.scene.frames.base import rooted_in_base
from twin.scene.localise.still_frames import STILL_WINDOW_NS, is_still

KEPT_IMAGES = 6
KEPT_TRANSFORMS = 1000
MAX_CAMERAS = 16
MAX_FRAMES = 1000
"""Static frames; a flood of names must not fill the memory."""
MAX_SPAN_NS = 1_000_000_000
"""Frames of one camera that are used together lie at most this far apart."""


@dataclass(kw_only=True)
class _Camera:
    """What one camera sent last."""

    infos: dict[str, CameraInfo] = field(default_factory=dict)
    colors: deque[CompressedColor | RawColor] = field(
        default_factory=lambda: deque(maxlen=KEPT_IMAGES)
    )
    depths: deque[DepthImage] = field(default_factory=lambda: deque(maxlen=KEPT_IMAGES))


@dataclass(frozen=True, kw_only=True)
class LiveFrames:
    """Frames taken since the last motion, and why cameras gave none."""

    frames: list[RgbdFrame]
    reasons: list[str]


class LiveView:
    """Remembers images, transforms and the robot description of one cell; thread safe."""

    def __init__(self, cell: str) -> None:
        """Listen for ``/<cell>/cam/...``, ``/<cell>/event``, transforms and the URDF."""
        self._cell = cell
        self._lock = threading.Lock()
        self._cameras: dict[str, _Camera] = {}
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
        if schema.is_truth(topic):
            return
        try:
            with self._lock:
                self._take(topic, data, type_name or schema.type_of_topic(topic) or "")
                self._heard_ns = max(self._heard_ns, received_ns)
        except (GstError, cdr.MalformedMessageError, ValueError):
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
        camera = self._cameras.setdefault(camera_id, _Camera())
        if kind == "info":
            camera.infos[stream] = CameraInfo.from_cdr(data)
        elif kind == "image" and stream == "color":
            camera.colors.append(color_from_message(type_name, data))
            self._newest_ns = max(self._newest_ns, camera.colors[-1].stamp_ns)
        elif kind == "image" and stream == "depth":
            camera.depths.append(DepthImage.from_message(type_name, data))

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
                camera_id: _Camera(
                    infos=dict(camera.infos),
                    colors=camera.colors.copy(),
                    depths=camera.depths.copy(),
                )
                for camera_id, camera in sorted(self._cameras.items())
            }
            transforms = [*self._static.values(), *self._moving]
            quiet_since_ns, newest_ns = self._quiet_since_ns, self._newest_ns
        if not cameras:
            return LiveFrames(frames=[], reasons=[f"no images on /{self._cell}/cam/**"])
        tree = TransformTree(rooted_in_base(transforms))
        frames: list[RgbdFrame] = []
        reasons: list[str] = []
        for camera_id, camera in cameras.items():
            age_ns = newest_ns - max((image.stamp_ns for image in camera.colors), default=newest_ns)
            if age_ns > max_age_ns:
                reasons.append(f"{camera_id}: silent for {age_ns * 1e-9:.1f} s of the cell's time")
                continue
            try:
                frames += _frames_of(camera_id, camera, tree, quiet_since_ns, max_per_camera)
            except GstError as error:
                reasons.append(f"{camera_id}: {error}")
        return LiveFrames(frames=frames, reasons=reasons)


class CameraNotReadyError(TwinError):
    """A camera gives no frames yet; the message says what is missing."""


def _frames_of(
    camera_id: str, camera: _Camera, tree: TransformTree, quiet_since_ns: int, max_frames: int
) -> list[RgbdFrame]:
    missing = [f"{name}/info" for name in ("color", "depth") if name not in camera.infos]
    if missing:
        raise CameraNotReadyError(f"no calibration on {' and '.join(missing)}")
    known = set(tree.frames())
    unknown = [info.frame_id for info in camera.infos.values() if info.frame_id not in known]
    if unknown:
        raise CameraNotReadyError(f"no transform to {unknown[0]}")
    frame_id = camera.infos["color"].frame_id
    pairs = [
        (color, depth)
        for color, depth in _pairs(camera)
        if color.stamp_ns - STILL_WINDOW_NS >= quiet_since_ns
        and is_still(tree, frame_id, color.stamp_ns)
    ]
    if not pairs:
        raise CameraNotReadyError("no colour and depth pair taken at rest since the last motion")
    oldest_ns = pairs[-1][0].stamp_ns - MAX_SPAN_NS
    return [
        _frame(camera_id, camera.infos, tree, color, depth)
        for color, depth in pairs[-max_frames:]
        if color.stamp_ns >= oldest_ns
    ]


def _pairs(camera: _Camera) -> list[tuple[CompressedColor | RawColor, DepthImage]]:
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
