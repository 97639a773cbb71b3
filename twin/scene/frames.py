"""Choose posed RGB-D frames of a run: some to learn from, some held out."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bridge.episode import schema, streams
from bridge.episode.reader import Episode
from bridge.episode.records import DepthImage, color_from_message
from bridge.episode.run import RunFolder
from bridge.episode.streams import RgbdFrame
from twin.errors import TwinError
from twin.scene.settings import FrameConfig
from twin.scene.still import same_pose

STILL_M = 0.002
STILL_RAD = 0.0035
"""A camera whose pose varies less than these stands still."""
STILL_TRAIN_FRAMES = 4
STILL_HOLDOUT_FRAMES = 2
"""A camera that stands still shows the same again and again; this many frames are enough."""


class NoFramesError(TwinError):
    """There is nothing to rebuild from."""


@dataclass(frozen=True, kw_only=True)
class FrameChoice:
    """Stamps of one camera of one episode: what to learn from and what to hold out."""

    episode: Episode
    camera_id: str
    still: bool
    train_ns: frozenset[int]
    holdout_ns: frozenset[int]
    """Nothing is learnt from these, the objects' places included."""


@dataclass(frozen=True, kw_only=True)
class Sources:
    """The episodes a scene is made from."""

    episodes: tuple[Episode, ...]
    remark: str
    """Empty when there are scans."""


def find_sources(run: RunFolder) -> Sources:
    """Take all scans; without a scan, every episode that has posed RGB-D frames.

    Raises:
        NoFramesError: When no episode has a camera with colour, depth and intrinsics.
    """
    usable = [e for path in run.episodes() if rgbd_camera_ids(e := Episode.open(path))]
    scans = [episode for episode in usable if episode.info.kind == "scan"]
    if scans:
        return Sources(episodes=tuple(scans), remark="")
    if not usable:
        message = (
            f"no episode in {run.episodes_dir} has colour and depth images with intrinsics. "
            "Record a scan, or import an RGB-D folder: robot-gst import rgbd FOLDER RUN."
        )
        raise NoFramesError(message)
    kinds = sorted({episode.info.kind for episode in usable})
    remark = f"no scan in this run: using {len(usable)} episode(s) of kind {', '.join(kinds)}"
    return Sources(episodes=tuple(usable), remark=remark)


def rgbd_camera_ids(episode: Episode) -> list[str]:
    """Cameras with colour and depth, both with intrinsics; never those of stand-in truth."""
    topics = {topic for topic in episode.topics() if not schema.is_truth(topic)}
    tails = ("color/image", "color/info", "depth/image", "depth/info")
    stems = {topic.removesuffix(tails[0]) for topic in topics if topic.endswith("/" + tails[0])}
    return sorted(
        stem.split("/")[-2] for stem in stems if all(stem + tail in topics for tail in tails)
    )


def choose_frames(sources: Sources, config: FrameConfig) -> list[FrameChoice]:
    """Hold out every n-th frame of each camera, then spread the training frames evenly.

    Raises:
        NoFramesError: When nothing is left to learn from.
    """
    found = [
        (episode, camera_id)
        for episode in sources.episodes
        for camera_id in rgbd_camera_ids(episode)
    ]
    train_share = max(1, config.max_train_frames // max(len(found), 1))
    holdout_share = max(1, config.max_holdout_frames // max(len(found), 1))
    choices = []
    for episode, camera_id in found:
        stamps, still = _stamps(episode, camera_id)
        held = stamps[config.holdout_every // 2 :: config.holdout_every]
        rest = np.setdiff1d(stamps, held)
        train_count = min(train_share, STILL_TRAIN_FRAMES) if still else train_share
        holdout_count = min(holdout_share, STILL_HOLDOUT_FRAMES) if still else holdout_share
        choices.append(
            FrameChoice(
                episode=episode,
                camera_id=camera_id,
                still=still,
                train_ns=frozenset(spread(rest, train_count).tolist()),
                holdout_ns=frozenset(spread(held, holdout_count).tolist()),
            )
        )
    if not any(choice.train_ns for choice in choices):
        message = "the cameras of this run have no frames to learn from. Record a longer scan."
        raise NoFramesError(message)
    return choices


def spread(values: np.ndarray, count: int) -> np.ndarray:
    """Pick at most ``count`` values at even distances, both ends included."""
    if len(values) <= count:
        return values
    return np.asarray(values[np.unique(np.linspace(0, len(values) - 1, count).round().astype(int))])


def _stamps(episode: Episode, camera_id: str) -> tuple[np.ndarray, bool]:
    """Source stamps of the frames that have both images, and whether the camera stands still."""
    stamps = np.array(list(_paired_stamps(episode, camera_id)), dtype=np.int64)
    tree = streams.transform_tree(episode)
    frame_id = streams.camera_info(episode, camera_id).frame_id
    poses = [tree.T_root_frame(frame_id, int(stamp)) for stamp in spread(stamps, 40)]
    still = all(same_pose(poses[0], T, distance_m=STILL_M, angle_rad=STILL_RAD) for T in poses)
    return stamps, still and len(stamps) > 1


def _paired_stamps(episode: Episode, camera_id: str) -> Iterator[int]:
    """Header stamps of colour images with a depth image nearby, as ``load`` will see them."""
    ending = f"/cam/{camera_id}/"
    colors, depths = (
        np.array(
            [
                read(message.type_name, message.data).stamp_ns
                for topic in episode.topics()
                if topic.endswith(f"{ending}{stream}/image") and not schema.is_truth(topic)
                for message in episode.messages([topic])
            ],
            dtype=np.int64,
        )
        for stream, read in (("color", color_from_message), ("depth", DepthImage.from_message))
    )
    for stamp in np.unique(colors).tolist() if len(depths) else ():
        if np.abs(depths - stamp).min() <= streams.PAIRING_TOLERANCE_NS:
            yield stamp


def load(choice: FrameChoice, stamps_ns: frozenset[int]) -> Iterator[RgbdFrame]:
    """Yield the frames of a choice that carry one of the stamps."""
    if not stamps_ns:
        return
    last = max(stamps_ns)
    for frame in streams.rgbd_frames(choice.episode, choice.camera_id):
        if frame.stamp_ns in stamps_ns:
            yield frame
        if frame.stamp_ns >= last:
            return
