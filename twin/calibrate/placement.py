"""Which cameras of a run stand still, which the robot carries, as far as its transforms say."""

from collections.abc import Sequence

import numpy as np

from bridge.episode import schema, streams
from bridge.episode.reader import Episode
from bridge.errors import BridgeError
from twin.scene.frames.still import same_pose

FIXED, MOVING, NO_DEPTH = "fixed", "moving", "no depth"
STILL_M, STILL_RAD = 0.002, 0.0035
NUM_LOOKS = 12


def placement(episodes: Sequence[Episode]) -> dict[str, str]:
    """Cameras with depth images and intrinsics: ``fixed``, or ``moving`` in any episode.

    A camera that no transform mentions counts as fixed: it can still be found from the robot.
    """
    found: dict[str, str] = {}
    for episode in episodes:
        for camera_id in depth_cameras(episode):
            moves = _moves(episode, camera_id)
            if moves or found.get(camera_id) != MOVING:
                found[camera_id] = MOVING if moves else FIXED
    return found


def depth_cameras(episode: Episode) -> list[str]:
    """Cameras of an episode with depth images and their intrinsics, never those of truth."""
    topics = {topic for topic in episode.topics() if not schema.is_truth(topic)}
    ending = "/depth/image"
    stems = [topic.removesuffix(ending) for topic in topics if topic.endswith(ending)]
    return sorted(
        stem.split("/")[-1] for stem in stems if f"{stem}/depth/info" in topics and "/cam/" in stem
    )


def _moves(episode: Episode, camera_id: str) -> bool:
    frame = streams.camera_info(episode, camera_id, "depth").frame_id
    tree = streams.transform_tree(episode)
    stamps = np.linspace(episode.start_ns, episode.end_ns, NUM_LOOKS).astype(np.int64)
    try:
        poses = [tree.T_root_frame(frame, int(stamp)) for stamp in stamps]
    except BridgeError:
        return False
    return not all(
        same_pose(poses[0], T, distance_m=STILL_M, angle_rad=STILL_RAD) for T in poses[1:]
    )
