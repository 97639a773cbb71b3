"""A fixed camera found from the robot it sees: depth against the posed description."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.cdr.messages import DepthImage
from bridge.episode.reader import Episode
from bridge.errors import BridgeError, GstError
from bridge.task.robot import BASE_FRAME
from twin.robot.model import load_robot
from twin.robot.posture import Posture, PostureTrack, far_apart, posture_track
from twin.scene.align.align import AlignConfig, Alignment, RobotNotAlignedError, align_robot
from twin.scene.align.view import RobotView
from twin.scene.frames.base import base_tree


@dataclass(frozen=True, kw_only=True)
class FixedCamera:
    """What was found of one fixed camera."""

    alignment: Alignment
    """``T_base_source`` is ``T_base_depth``, the pose of the depth camera."""
    T_base_believed: Float[np.ndarray, "4 4"] | None
    """What the recording believed of it."""
    episodes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """A depth image that shows the robot standing still."""

    episode: Episode
    stamp_ns: int
    posture: Posture


def find_fixed_camera(
    episodes: Sequence[Episode], camera_id: str, *, max_postures: int, seed: int
) -> FixedCamera:
    """Find the pose and depth scale of a fixed camera in the robot's base frame.

    Where the recording believes the camera to be is where the search begins; when the robot is
    not there, or nothing is believed, the whole table is searched.

    Raises:
        RobotNotAlignedError: The images do not determine it, or none shows a robot that stands
            still.
        EpisodeError: No joint states.
        RobotDescriptionError: No usable robot description.
    """
    tracks = _tracks(episodes)
    seen = [
        item
        for episode in episodes
        if str(episode.path) in tracks
        for item in _still(episode, camera_id, tracks[str(episode.path)])
    ]
    if not seen:
        raise RobotNotAlignedError(
            found=f"camera {camera_id} has no depth image with the robot standing still",
            hint="Stop the robot for half a second at each of several postures while recording.",
        )
    joints = np.array([item.posture.joints_rad for item in seen])
    chosen = [seen[index] for index in far_apart(joints, max_postures)]
    views = [view for episode in episodes for view in _load(episode, camera_id, chosen)]
    robot = load_robot(tracks[str(chosen[0].episode.path)].urdf)
    believed = _believed(chosen[0], camera_id)
    config = AlignConfig(seed=seed)
    try:
        if believed is None:
            alignment = align_robot(views, robot, config=config)
        else:
            alignment = align_robot(views, robot, start=believed, config=config)
    except RobotNotAlignedError:
        if believed is None:
            raise
        alignment = align_robot(views, robot, config=config)
    return FixedCamera(
        alignment=alignment,
        T_base_believed=believed,
        episodes=tuple(dict.fromkeys(item.episode.info.id for item in chosen)),
    )


def _tracks(episodes: Sequence[Episode]) -> dict[str, PostureTrack]:
    """Postures of the episodes that have them; when none has, the first one's reason."""
    tracks: dict[str, PostureTrack] = {}
    reasons: list[GstError] = []
    for episode in episodes:
        try:
            tracks[str(episode.path)] = posture_track(episode)
        except GstError as error:
            reasons.append(error)
    if not tracks and reasons:
        raise reasons[0]
    return tracks


def _still(episode: Episode, camera_id: str, track: PostureTrack) -> Iterator[_Seen]:
    topic = streams.find_camera_topic(episode, camera_id, "depth/image")
    if topic is None:
        return
    for message in episode.messages([topic]):
        stamp = DepthImage.from_message(message.type_name, message.data).stamp_ns
        if track.is_still(stamp):
            yield _Seen(episode=episode, stamp_ns=stamp, posture=track.at(stamp))


def _load(episode: Episode, camera_id: str, chosen: Sequence[_Seen]) -> Iterator[RobotView]:
    wanted = {i.stamp_ns: i.posture for i in chosen if i.episode.path == episode.path}
    topic = streams.find_camera_topic(episode, camera_id, "depth/image")
    if topic is None or not wanted:
        return
    camera = streams.camera_info(episode, camera_id, "depth").camera
    for message in episode.messages([topic]):
        image = DepthImage.from_message(message.type_name, message.data)
        if image.stamp_ns in wanted:
            yield RobotView(
                camera=camera,
                depth_m=image.depth_m(),
                T_source_camera=np.eye(4),
                posture=wanted[image.stamp_ns],
            )


def _believed(seen: _Seen, camera_id: str) -> Float[np.ndarray, "4 4"] | None:
    """The pose of the depth camera in the robot's base as the recording has it, if it has one."""
    tree = base_tree(seen.episode)
    frame = streams.camera_info(seen.episode, camera_id, "depth").frame_id
    try:
        T = tree.T_root_frame(frame, seen.stamp_ns)
        root = tree.root_of(frame)
    except BridgeError:
        return None
    return T if root == BASE_FRAME else None
