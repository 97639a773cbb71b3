"""Pose pairs of a hand-eye calibration, from recorded episodes.

An episode holds the target's pose in the camera on ``/<cell>/cam/<id>/target/pose``
(geometry_msgs/PoseStamped); the robot's side comes from its joints at the same instant.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.episode import schema
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.reader import Episode
from bridge.episode.topics import CAMERAS, TARGET_POSE
from bridge.geometry import se3
from twin.robot.model import load_robot
from twin.robot.posture import PostureTrack, posture_track

SAME_PLACE_RAD = 0.004
"""Detections at joints nearer than this belong to one stop of the robot and are averaged."""


@dataclass(frozen=True, kw_only=True)
class PosePairs:
    """What robot and camera said at the same instants."""

    Ts_base_effector: Float[np.ndarray, "num_pairs 4 4"]
    Ts_camera_target: Float[np.ndarray, "num_pairs 4 4"]
    source: str
    """Episode ids."""

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.Ts_base_effector)


def target_cameras(episodes: Sequence[Episode]) -> list[str]:
    """Cameras with recorded target poses; stand-in truth is never among them."""
    return sorted(
        {
            topic.split("/")[-3]
            for episode in episodes
            for topic in episode.topics_of_type(schema.POSE_STAMPED)
            if topic.endswith(TARGET_POSE) and CAMERAS in topic
        }
    )


def recorded_pairs(episodes: Sequence[Episode], camera_id: str, link: str) -> PosePairs:
    """Pair recorded target poses of one camera with the robot's link, robot standing still.

    Poses that are no numbers, as some detectors send when they see nothing, are left out.

    Args:
        episodes: Those without poses of a target from this camera are passed over.
        link: Robot link whose pose in the base is the other half of a pair.
    """
    stops: list[tuple[np.ndarray, np.ndarray]] = []
    used = []
    for episode in episodes:
        topics = [
            topic
            for topic in episode.topics_of_type(schema.POSE_STAMPED)
            if topic.endswith(f"{CAMERAS}{camera_id}{TARGET_POSE}")
        ]
        samples = [PoseSample.from_cdr(message.data) for message in episode.messages(topics)]
        samples = [sample for sample in samples if np.isfinite(sample.T_frame_body).all()]
        if not samples:
            continue
        used.append(episode.info.id)
        stops += _stops(posture_track(episode), samples, link)
    hands, targets = np.array(stops).reshape(-1, 2, 4, 4).swapaxes(0, 1)
    return PosePairs(Ts_base_effector=hands, Ts_camera_target=targets, source=", ".join(used))


def _stops(
    track: PostureTrack, samples: list[PoseSample], link: str
) -> list[tuple[np.ndarray, np.ndarray]]:
    """One averaged pair for each stop of the robot; detections on the move are left out."""
    robot = load_robot(track.urdf)
    groups: list[tuple[np.ndarray, list[np.ndarray]]] = []
    for sample in sorted(samples, key=lambda item: item.stamp_ns):
        if not track.is_stationary(sample.stamp_ns):
            continue
        joints = track.at(sample.stamp_ns).joints_rad
        if groups and np.abs(groups[-1][0] - joints).max() < SAME_PLACE_RAD:
            groups[-1][1].append(sample.T_frame_body)
        else:
            groups.append((joints, [sample.T_frame_body]))
    means = [np.mean(Ts, axis=0) for _, Ts in groups]
    for T in means:
        T[:3, :3] = se3.nearest_rotation(T[:3, :3])  # the chordal mean
    return [(robot.T_base_link(link, q), T) for (q, _), T in zip(groups, means, strict=True)]
