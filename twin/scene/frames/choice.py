"""Choose posed RGB-D frames of a run: some to learn from, some held out."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from bridge.episode import schema, streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.errors import BridgeError
from bridge.terminal import Output
from twin.errors import TwinError
from twin.scene.frames import select
from twin.scene.frames.camera_poses import CameraPoses, find_poses
from twin.scene.frames.pairs import frames_at, paired_stamps_ns
from twin.scene.frames.stated import STILL_M, STILL_RAD
from twin.scene.frames.still import same_pose
from twin.scene.frames.usable import UnusableCameraError, check_camera, name_of
from twin.scene.settings import FrameConfig
from twin.scene.store.calibration import Calibration

STILL_TRAIN_FRAMES = 4
STILL_HOLDOUT_FRAMES = 2
"""A camera that stands still shows the same again and again; this many frames are enough."""
QUIET = Output(quiet=True)


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
    poses: CameraPoses
    spare_ns: frozenset[int] = frozenset()
    """Neither chosen nor held out: the background does not need them, the robot may."""
    corrections: Mapping[int, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """``T_new_old`` in the root frame for frames whose pose was improved, by stamp."""


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """What is used of a run's cameras, and why others are not."""

    choices: list[FrameChoice]
    left_out: tuple[str, ...]
    """A sentence about each camera that is not used."""


@dataclass(frozen=True, kw_only=True)
class Sources:
    """The episodes a scene is made from."""

    episodes: tuple[Episode, ...]
    remark: str
    """That there is no scan, and what could not be read; empty when there is nothing to say."""


def find_sources(run: RunFolder) -> Sources:
    """Take all scans; without a scan, every episode that has posed RGB-D frames.

    An episode that cannot be read is passed over, with a remark.

    Raises:
        NoFramesError: When no episode has a camera with colour, depth and intrinsics.
        EpisodeError: When there is none that can be read, but one that cannot.
    """
    usable: list[Episode] = []
    broken: list[BridgeError] = []
    for path in run.episodes():
        try:
            episode = Episode.open(path)
            if rgbd_camera_ids(episode):
                usable.append(episode)
        except BridgeError as error:
            broken.append(error)
    remarks = [f"passed over: {error}" for error in broken]
    scans = [episode for episode in usable if episode.info.kind == "scan"]
    if scans:
        return Sources(episodes=tuple(scans), remark="; ".join(remarks))
    if broken and not usable:
        raise broken[0]
    if not usable:
        message = (
            f"no episode in {run.episodes_dir} has colour and depth images with intrinsics. "
            "Record a scan, or import an RGB-D folder: robot-gst import rgbd FOLDER RUN."
        )
        raise NoFramesError(message)
    kinds = sorted({episode.info.kind for episode in usable})
    remarks.insert(
        0, f"no scan in this run: using {len(usable)} episode(s) of kind {', '.join(kinds)}"
    )
    return Sources(episodes=tuple(usable), remark="; ".join(remarks))


def rgbd_camera_ids(episode: Episode) -> list[str]:
    """Cameras with colour and depth, both with intrinsics; never those of stand-in truth."""
    topics = {topic for topic in episode.topics() if not schema.is_truth(topic)}
    tails = ("color/image", "color/info", "depth/image", "depth/info")
    stems = {topic.removesuffix(tails[0]) for topic in topics if topic.endswith("/" + tails[0])}
    return sorted(
        stem.split("/")[-2] for stem in stems if all(stem + tail in topics for tail in tails)
    )


def choose_frames(
    sources: Sources,
    config: FrameConfig,
    output: Output = QUIET,
    calibration: Calibration | None = None,
) -> list[FrameChoice]:
    """The choices of ``choose_with_reasons``; raises as it does."""
    return choose_with_reasons(sources, config, output, calibration).choices


def choose_with_reasons(
    sources: Sources, config: FrameConfig, output: Output, calibration: Calibration | None
) -> Chosen:
    """Hold out every n-th frame of each camera, then choose training frames from the others.

    Which frames are held out depends on their number alone, never on what they show.

    Raises:
        NoFramesError: When nothing is left to learn from.
        UnusableCameraError: When no camera can be used: the first one's reason.
    """
    found = [
        (episode, camera_id)
        for episode in sources.episodes
        for camera_id in rgbd_camera_ids(episode)
    ]
    shared = replace(
        config,
        max_train_frames=max(1, config.max_train_frames // max(len(found), 1)),
        max_holdout_frames=max(1, config.max_holdout_frames // max(len(found), 1)),
    )
    choices: list[FrameChoice] = []
    lost: list[UnusableCameraError] = []
    for episode, camera_id in found:
        try:
            check_camera(episode, camera_id)
            choices.append(_choose(episode, camera_id, shared, output, calibration))
        except UnusableCameraError as error:
            lost.append(error)
    if lost and not choices:
        raise lost[0]
    kept, apart = _in_one_frame(choices)
    left_out = (*(f"left out: {reason}" for reason in lost), *apart)
    for sentence in left_out:
        output.say(sentence)
    if not any(choice.train_ns for choice in kept):
        message = "the cameras of this run have no frames to learn from. Record a longer scan."
        raise NoFramesError(message)
    return Chosen(choices=kept, left_out=left_out)


def _in_one_frame(choices: list[FrameChoice]) -> tuple[list[FrameChoice], list[str]]:
    """Keep the cameras whose poses share a root frame with the first, recorded poses first.

    And say of each of the others where it is.
    """
    ordered = sorted(choices, key=lambda choice: choice.poses.source == "odometry")
    if not ordered:
        return choices, []
    root = root_frame(ordered[0])
    kept = [choice for choice in choices if root_frame(choice) == root]
    apart = [
        f"camera {choice.camera_id} of {choice.episode.info.id} is left out: its poses are in "
        f"frame {root_frame(choice)!r}, and nothing says where that is in {root!r}"
        for choice in choices
        if root_frame(choice) != root
    ]
    return kept, apart


def root_frame(choice: FrameChoice) -> str:
    """Name of the frame a choice's poses are in.

    Odometry of every recording starts anew, so its frames carry the recording's name.
    """
    frame_id = streams.camera_info(choice.episode, choice.camera_id).frame_id
    return choice.poses.tree.root_of(frame_id)


def _choose(
    episode: Episode,
    camera_id: str,
    config: FrameConfig,
    output: Output,
    calibration: Calibration | None,
) -> FrameChoice:
    stamps = paired_stamps_ns(episode, camera_id)
    if len(stamps) == 0:
        message = (
            f"no colour image of {name_of(episode, camera_id)} has a depth image within "
            f"{streams.PAIRING_TOLERANCE_NS * 1e-6:g} ms: clocks that differ, or one of the two "
            "was not recorded. Record them synchronised."
        )
        raise UnusableCameraError(message)
    held = stamps[config.first_holdout :: config.holdout_every]
    poses = find_poses(
        episode, camera_id, stamps, frozenset(held.tolist()), config, output, calibration
    )
    unposed = np.array(sorted(poses.unposed_ns), dtype=np.int64)
    still = _stands_still(episode, camera_id, poses, np.setdiff1d(stamps, unposed))
    train_count, holdout_count = config.max_train_frames, config.max_holdout_frames
    if still:
        train_count = min(train_count, STILL_TRAIN_FRAMES)
        holdout_count = min(holdout_count, STILL_HOLDOUT_FRAMES)
    held = np.setdiff1d(held, unposed)
    if config.train_every:
        rest = np.setdiff1d(stamps[:: config.train_every], np.concatenate([held, unposed]))
        train = spread(rest, train_count)
    else:
        rest = np.setdiff1d(stamps, np.concatenate([held, unposed]))
        train = _pick(episode, camera_id, poses, rest, train_count, still=still)
    return FrameChoice(
        episode=episode,
        camera_id=camera_id,
        still=still,
        train_ns=frozenset(train.tolist()),
        holdout_ns=frozenset(spread(held, holdout_count).tolist()),
        poses=poses,
        spare_ns=frozenset(np.setdiff1d(rest, train).tolist()),
    )


def _pick(
    episode: Episode,
    camera_id: str,
    poses: CameraPoses,
    stamps: Int[np.ndarray, " num_frames"],
    count: int,
    *,
    still: bool,
) -> Int[np.ndarray, " num_picked"]:
    if len(stamps) == 0:
        return stamps
    info = streams.camera_info(episode, camera_id)
    if still:
        smear = select.robot_smear_px(episode, stamps, info.camera.fx)
    else:
        smear = select.smear_px(poses.tree, info.frame_id, stamps, info.camera.fx)
    path = select.path_length_m(poses.tree.Ts_root_frame(info.frame_id, stamps))
    return select.pick(
        stamps,
        path,
        smear,
        count,
        lambda wanted: select.sharpness_at(episode, camera_id, wanted),
    )


def spread(values: np.ndarray, count: int) -> np.ndarray:
    """Pick at most ``count`` values at even distances, both ends included."""
    if len(values) <= count:
        return values
    return np.asarray(values[np.unique(np.linspace(0, len(values) - 1, count).round().astype(int))])


def _stands_still(
    episode: Episode, camera_id: str, poses: CameraPoses, stamps: Int[np.ndarray, " num_frames"]
) -> bool:
    frame_id = streams.camera_info(episode, camera_id).frame_id
    Ts = poses.tree.Ts_root_frame(frame_id, spread(stamps, 40))
    still = all(same_pose(Ts[0], T, distance_m=STILL_M, angle_rad=STILL_RAD) for T in Ts)
    return still and len(stamps) > 1


def load(choice: FrameChoice, stamps_ns: frozenset[int]) -> Iterator[RgbdFrame]:
    """Yield the frames of a choice that carry one of the stamps, with the poses it chose."""
    for frame in frames_at(choice.episode, choice.camera_id, choice.poses.tree, stamps_ns):
        yield _corrected(frame, choice)


def _corrected(frame: RgbdFrame, choice: FrameChoice) -> RgbdFrame:
    if choice.poses.depth_scale != 1.0:
        frame = replace(frame, depth_m=frame.depth_m * choice.poses.depth_scale)
    T_new_old = choice.corrections.get(frame.stamp_ns)
    if T_new_old is None:
        return frame
    return replace(
        frame,
        T_base_color=T_new_old @ frame.T_base_color,
        T_base_depth=T_new_old @ frame.T_base_depth,
    )
