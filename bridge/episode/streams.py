"""Decode what an episode holds: joints, plans, events, cameras, poses."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from bridge.episode import schema
from bridge.episode.cdr.batch import joint_layout
from bridge.episode.cdr.codec import decode
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    JointSample,
    PoseSample,
    RawColor,
    color_from_message,
    stamp_of,
    string_from_cdr,
    transforms_from_cdr,
)
from bridge.episode.cdr.straighten import Straightening
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import (
    CAMERAS,
    COLOR_TOPIC,
    JOINT_STATES,
    OBJECTS,
    ROBOT_DESCRIPTION,
    TCP_POSE,
    is_truth,
)
from bridge.episode.transforms import TransformTree
from bridge.errors import EpisodeError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.geometry.trajectory import PoseTrajectory
from bridge.robots.robot import Robot, robot_of
from bridge.task.find import ATTACHMENT, Attached, find_task_file
from bridge.task.plan import Plan
from bridge.task.record import parse_record
from bridge.task.task_file import TaskFile
from bridge.task.verdict import Verdict

RgbdPair = tuple[CompressedColor | RawColor, DepthImage]
PAIRING_TOLERANCE_NS = 20_000_000
"""Colour and depth of one frame lie at most this far apart."""


@dataclass(frozen=True, kw_only=True)
class RgbdFrame:
    """Colour and depth of one instant with both cameras and both poses in the root frame."""

    camera_id: str
    stamp_ns: int
    image_u8: UInt8[np.ndarray, "height width 3"]
    depth_m: Float[np.ndarray, "depth_height depth_width"]
    color_camera: Camera
    depth_camera: Camera
    T_base_color: Float[np.ndarray, "4 4"]
    T_base_depth: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class JointTrack:
    """Joint positions over source time."""

    names: tuple[str, ...]
    stamps_ns: np.ndarray
    position: Float[np.ndarray, "num_samples num_joints"]

    def at(self, stamps_ns: np.ndarray) -> Float[np.ndarray, "num_queries num_joints"]:
        """Interpolate linearly; outside the range the nearest end."""
        columns = [np.interp(stamps_ns, self.stamps_ns, each) for each in self.position.T]
        return np.stack(columns, axis=1)


def first_stamp_ns(episode: Episode) -> int | None:
    """Return the source time of the first sample of robot, tool, objects, cameras or events.

    Seconds into an episode count from here, wherever a person reads or gives them. None without
    any. When messages arrived does not matter: that is another clock.
    """
    stamps = [int(event["stamp_ns"]) for event in events(episode)[:1]]
    poses = episode.topics_of_type(schema.POSE_STAMPED)
    joints = episode.topics_of_type(schema.JOINT_STATE)
    images = (schema.COMPRESSED_IMAGE, schema.IMAGE)
    topics = [
        *(topic for topic in joints if topic.endswith(JOINT_STATES)),
        *(topic for topic in poses if topic.endswith(TCP_POSE) or OBJECTS in topic),
        *(t for name in images for t in episode.topics_of_type(name) if COLOR_TOPIC.search(t)),
    ]
    for topic in topics:
        for message in episode.messages([topic]):
            stamps.append(stamp_of(decode(message.type_name, message.data)))
            break
    return min(stamps, default=None)


@lru_cache(maxsize=1)
def transforms(episode: Episode) -> tuple[FrameTransform, ...]:
    """What ``/tf`` and ``/tf_static`` say; those of the last episode are kept."""
    messages = episode.messages(episode.topics_of_type(schema.TF_MESSAGE))
    return tuple(item for message in messages for item in transforms_from_cdr(message.data))


def transform_tree(episode: Episode) -> TransformTree:
    """Collect ``/tf`` and ``/tf_static``."""
    return TransformTree(transforms(episode))


def camera_ids(episode: Episode) -> list[str]:
    """Cameras that have colour images: the ``<id>`` of ``.../cam/<id>/color/image``."""
    found = (COLOR_TOPIC.search(topic) for topic in _readable(episode))
    return sorted({match[1] for match in found if match is not None})


def find_camera_topic(episode: Episode, camera_id: str, tail: str) -> str | None:
    """Return a camera's topic by its end (``depth/image``); stand-in truth is never found."""
    ending = f"{CAMERAS}{camera_id}/{tail}"
    return next((topic for topic in _readable(episode) if topic.endswith(ending)), None)


def _readable(episode: Episode) -> Iterator[str]:
    """Topics but ground truth, and videos: their frames are kept as they came, and not decoded."""
    for topic, about in episode.topics().items():
        if not is_truth(topic) and about.type_name != schema.COMPRESSED_VIDEO:
            yield topic


def camera_info(episode: Episode, camera_id: str, stream: str = "color") -> CameraInfo:
    """Return the first intrinsics of ``color`` or ``depth``."""
    topic = find_camera_topic(episode, camera_id, f"{stream}/info")
    for message in episode.messages([topic] if topic else []):
        return CameraInfo.from_cdr(message.data)
    raise EpisodeError(
        path=episode.path,
        found=f"no message on a topic that ends with {CAMERAS}{camera_id}/{stream}/info",
        hint=f"Cameras here: {', '.join(camera_ids(episode)) or 'none'}.",
    )


def lens_of(episode: Episode, camera_id: str, stream: str = "color") -> Straightening | None:
    """What straightens the images of ``color`` or ``depth``; None without a lens, or any word."""
    topic = find_camera_topic(episode, camera_id, f"{stream}/info")
    first = next(iter(episode.messages([topic] if topic else [])), None)
    return None if first is None else CameraInfo.from_cdr(first.data).lens


def color_images(episode: Episode, camera_id: str) -> Iterator[CompressedColor | RawColor]:
    """Colour images of a camera in log order, straightened when they are decoded."""
    topic = find_camera_topic(episode, camera_id, "color/image")
    lens = lens_of(episode, camera_id)
    for message in episode.messages([topic] if topic else []):
        yield color_from_message(message.type_name, message.data, lens)


def depth_images(episode: Episode, camera_id: str) -> Iterator[DepthImage]:
    """Depth images of a camera in log order, straightened."""
    topic = find_camera_topic(episode, camera_id, "depth/image")
    lens = lens_of(episode, camera_id, "depth")
    for message in episode.messages([topic] if topic else []):
        yield DepthImage.from_message(message.type_name, message.data, lens)


def rgbd_pairs(episode: Episode, camera_id: str) -> Iterator[RgbdPair]:
    """Yield colour and depth that belong together; colour without depth nearby is passed over."""
    tails = ("color/image", "depth/image")
    color_topic, depth_topic = (find_camera_topic(episode, camera_id, tail) for tail in tails)
    if color_topic is None or depth_topic is None:
        return
    color_lens, depth_lens = (lens_of(episode, camera_id, stream) for stream in ("color", "depth"))
    colors: list[CompressedColor | RawColor] = []
    depths: list[DepthImage] = []
    for message in episode.messages([color_topic, depth_topic]):
        if message.topic == color_topic:
            colors.append(color_from_message(message.type_name, message.data, color_lens))
        else:
            depths.append(DepthImage.from_message(message.type_name, message.data, depth_lens))
        while colors and depths:
            if abs(gap_ns := colors[0].stamp_ns - depths[0].stamp_ns) <= PAIRING_TOLERANCE_NS:
                yield colors.pop(0), depths.pop(0)
            else:
                (depths if gap_ns > 0 else colors).pop(0)


def rgbd_frames(
    episode: Episode,
    camera_id: str,
    tree: TransformTree | None = None,
    stamps_ns: Collection[int] | None = None,
) -> Iterator[RgbdFrame]:
    """Yield posed frames in time order, of these colour stamps alone where some are given."""
    tree = transform_tree(episode) if tree is None else tree
    infos = [camera_info(episode, camera_id, stream) for stream in ("color", "depth")]
    for color, depth in rgbd_pairs(episode, camera_id):
        if stamps_ns is None or color.stamp_ns in stamps_ns:
            yield RgbdFrame(
                camera_id=camera_id,
                stamp_ns=color.stamp_ns,
                image_u8=color.image_u8(),
                depth_m=depth.depth_m(),
                color_camera=infos[0].camera,
                depth_camera=infos[1].camera,
                T_base_color=tree.T_root_frame(infos[0].frame_id, color.stamp_ns),
                T_base_depth=tree.T_root_frame(infos[1].frame_id, depth.stamp_ns),
            )


def joint_track(episode: Episode, ending: str = JOINT_STATES) -> JointTrack:
    """Collect the joint states of the topic with this ending, ordered by source time.

    ROS lets several nodes publish on one topic, each its own joints in its own order; see
    ``joint_track_of``.
    """
    topics = [
        topic for topic in episode.topics_of_type(schema.JOINT_STATE) if topic.endswith(ending)
    ]
    messages = (m for m in episode.messages(topics) if m.type_name == schema.JOINT_STATE)
    track = joint_track_of([message.data for message in messages])
    if track is None:
        raise EpisodeError(
            path=episode.path,
            found=f"no joint states on a topic ending with {ending}",
            hint="Record the robot's joint states; robot-gst info lists the topics.",
        )
    return track


def joint_track_of(payloads: Sequence[bytes]) -> JointTrack | None:
    """Order sensor_msgs/JointState messages by source time; None when none holds a position.

    Those who know the most joints are taken, in the order of the first of them. Joints that only
    others know are interpolated between theirs, if these span most of the time.
    """
    alike = joint_layout(payloads[0]) if payloads else None
    if alike is not None and all(map(alike.is_like, payloads)):  # ten times faster
        stamps_ns, position = alike.read(payloads)
        order = np.argsort(stamps_ns, kind="stable")
        return JointTrack(names=alike.names, stamps_ns=stamps_ns[order], position=position[order])
    samples = [JointSample.from_cdr(payload) for payload in payloads]
    samples = [sample for sample in samples if len(sample.position)]
    return _joined(sorted(samples, key=lambda sample: sample.stamp_ns))


def _joined(samples: Sequence[JointSample]) -> JointTrack | None:
    if not samples:
        return None
    names = max((sample.names for sample in samples), key=len)
    complete = [sample for sample in samples if set(names) <= set(sample.names)]
    rows = [sample.position[[sample.names.index(name) for name in names]] for sample in complete]
    stamps_ns = np.array([sample.stamp_ns for sample in complete], dtype=np.int64)
    position = np.stack(rows)
    rest = _joined([sample for sample in samples if set(names).isdisjoint(sample.names)])
    if rest is not None:
        known = (stamps_ns >= rest.stamps_ns[0]) & (stamps_ns <= rest.stamps_ns[-1])
        if known.mean() > 0.5:
            stamps_ns, names = stamps_ns[known], names + rest.names
            position = np.hstack([position[known], rest.at(stamps_ns)])
    return JointTrack(names=names, stamps_ns=stamps_ns, position=position)


def plans(episode: Episode) -> list[tuple[int, Plan]]:
    """Return every plan with its source time [ns], in order, also those never executed."""
    messages = episode.messages(episode.topics_of_type(schema.PLAN))
    return [(message.publish_time_ns, Plan.from_json(message.data)) for message in messages]


def verdicts(episode: Episode) -> list[tuple[int, Verdict]]:
    """Return every verdict with its source time [ns]."""
    messages = episode.messages(episode.topics_of_type(schema.VERDICT))
    return [(message.publish_time_ns, Verdict.from_json(message.data)) for message in messages]


def events(episode: Episode) -> list[dict[str, Any]]:
    """Return every event record in log order."""
    return [
        parse_record(message.data, name="event", package="bridge.episode")
        for message in episode.messages(episode.topics_of_type(schema.EVENT))
    ]


def localisations(episode: Episode) -> list[dict[str, Any]]:
    """Return every localisation record in log order."""
    return [
        parse_record(message.data, name="localisation")
        for message in episode.messages(episode.topics_of_type(schema.LOCALISATION))
    ]


def execution_ns(
    records: Iterable[Mapping[str, Any]], plan_id: str
) -> tuple[int | None, int | None]:
    """Source times [ns] at which a plan's execution started and ended, as far as events say."""
    start: int | None = None
    for event in records:
        if event.get("plan_id") != plan_id:
            continue
        if event["type"] == "execution_started":
            start = int(event["stamp_ns"])
        elif event["type"] == "execution_ended" and start is not None:
            return start, int(event["stamp_ns"])
    return start, None


def pose_track(episode: Episode, topic: str) -> PoseTrajectory:
    """Collect the poses of one PoseStamped topic, ordered by source time, duplicates dropped."""
    track = pose_track_of([message.data for message in episode.messages([topic])])
    if track is None:
        raise EpisodeError(
            path=episode.path, found=f"no poses on {topic}", hint="robot-gst info lists the topics."
        )
    return track


def pose_track_of(payloads: Sequence[bytes]) -> PoseTrajectory | None:
    """Order geometry_msgs/PoseStamped messages by source time; of equal stamps the last counts.

    None without messages.
    """
    if not payloads:
        return None
    samples = [PoseSample.from_cdr(payload) for payload in payloads]
    stamps_ns = np.array([sample.stamp_ns for sample in samples], dtype=np.int64)
    Ts = np.stack([sample.T_frame_body for sample in samples])
    order = np.argsort(stamps_ns, kind="stable")
    order = order[np.append(np.diff(stamps_ns[order]) != 0, True)]
    q, p = se3.split(Ts[order])
    return PoseTrajectory(stamps_ns[order], p, q)


def object_pose_topics(episode: Episode) -> dict[str, str]:
    """Map object ids to their pose topics (derived episodes; never stand-in truth)."""
    return {
        topic.split("/")[-2]: topic
        for topic in episode.topics_of_type(schema.POSE_STAMPED)
        if OBJECTS in topic
    }


ROBOT_FILE = "robot.urdf"
"""Attachment with the robot's description, of more weight than a recorded one."""


def recorded_robot(episode: Episode) -> Robot:
    """Return the robot an episode was recorded with; one without a description: the default."""
    return robot_of(robot_description(episode) or "")


def robot_description(episode: Episode) -> str | None:
    """Return the URDF text: the attachment ``ROBOT_FILE``, else ``/robot_description``."""
    if (attached := episode.attachment(ROBOT_FILE)) is not None:
        return attached.decode()
    messages = episode.messages([ROBOT_DESCRIPTION])
    return next((string_from_cdr(message.data) for message in messages), None)


def task_file(episode: Episode, name: str = "") -> TaskFile:
    """Find the task file an episode was recorded with."""
    info = episode.info
    attached = Attached(info.task_sha256, episode.attachment(ATTACHMENT), episode.path.name)
    tasks_dir = RunFolder(episode.path.absolute().parent.parent).tasks_dir
    return find_task_file(info.task or name, tasks_dir=tasks_dir, attached=attached)
