"""Choose posed RGB-D frames of a run: some to train on, some held out.

A scan holds far more frames than a fit can use: they are taken at even distances along the
camera's path, so that one that pauses gives no more of them there.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32, Int

from bridge.episode import streams
from bridge.episode.metadata import RETRY
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.episode.topics import COLOR_IMAGE, COLOR_INFO, DEPTH_IMAGE, DEPTH_INFO, is_truth
from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.terminal import Output
from twin.errors import TwinError
from twin.scene.frames.camera_poses import CameraPoses, find_poses, never_moves
from twin.scene.frames.pairing import (
    UnusableCameraError,
    check_camera,
    has_depth,
    name_of,
    paired_stamps_ns,
)
from twin.scene.settings import FrameConfig
from twin.scene.store.calibration import Calibration

TURN_M_PER_RAD = 0.5
"""How much path a turn counts for: what a camera sees at this distance moves by as much."""


def pick(
    stamps_ns: Int[np.ndarray, " num_frames"], path_m: Float[np.ndarray, " num_frames"], count: int
) -> Int[np.ndarray, " num_picked"]:
    """The stamps of at most ``count`` frames at even distances along a path, in order."""
    places = np.linspace(path_m[0], path_m[-1], count)
    return np.asarray(stamps_ns[np.unique(np.searchsorted(path_m, places))])


def path_length_m(
    Ts_base_camera: Float[np.ndarray, "num_frames 4 4"],
) -> Float[np.ndarray, " num_frames"]:
    """How far the camera has come, turns included; grows a little even while it stands still."""
    if len(Ts_base_camera) < 2:
        return np.zeros(len(Ts_base_camera))
    before, after = Ts_base_camera[:-1], Ts_base_camera[1:]
    turn = se3.rotation_angle_rad(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    shift = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    steps = shift + TURN_M_PER_RAD * turn
    return np.concatenate([[0.0], np.cumsum(steps + max(1e-6, 1e-3 * float(steps.mean())))])


STATIONARY_TRAIN_FRAMES = 4
STATIONARY_HOLDOUT_FRAMES = 2
"""A camera that stands still shows the same again and again; this many frames are enough."""
QUIET = Output(quiet=True)
COLOR_ALONE, COLOR_AND_DEPTH = (COLOR_INFO,), (COLOR_INFO, DEPTH_IMAGE, DEPTH_INFO)
"""What a camera records beside its colour images."""


class NoFramesError(TwinError):
    """There is nothing to rebuild from."""

    exit_code = 2


@dataclass(frozen=True, kw_only=True)
class FrameChoice:
    """Stamps of one camera of one episode: what to learn from and what to hold out."""

    episode: Episode
    camera_id: str
    stationary: bool
    train_ns: frozenset[int]
    holdout_ns: frozenset[int]
    """Nothing is learnt from these, the objects' places included."""
    poses: CameraPoses
    spare_ns: frozenset[int] = frozenset()
    """Neither chosen nor held out: the background does not need them, the robot may."""
    estimated_m: Mapping[int, Float32[np.ndarray, "height width"]] = field(default_factory=dict)
    """Depth of images beside which none was recorded, at a whole fraction of their size; 0 where it
    is not known."""

    @property
    def has_depth(self) -> bool:
        """Whether depth was recorded."""
        return has_depth(self.episode, self.camera_id)


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """What is used of a run's cameras, and why others are not."""

    choices: list[FrameChoice]
    left_out: tuple[str, ...]
    """Why, for each camera that is not used."""


@dataclass(frozen=True, kw_only=True)
class Sources:
    """The episodes a scene is made from."""

    episodes: tuple[Episode, ...]
    remark: str
    """That there is no scan, and what could not be read; empty when there is nothing to say."""


def find_sources(run: RunFolder) -> Sources:
    """Take all scans; else what has posed RGB-D frames and is no trial; else the trials.

    An episode that cannot be read is passed over, with a remark. Colour images without depth count
    where there is nothing else.
    """
    usable: list[Episode] = []
    broken: list[BridgeError] = []
    for path in run.episodes():
        try:
            episode = Episode.open(path)
            if rgbd_camera_ids(episode, COLOR_ALONE):
                usable.append(episode)
        except BridgeError as error:
            broken.append(error)
    remarks = [f"passed over: {error}" for error in broken]
    usable = [episode for episode in usable if rgbd_camera_ids(episode)] or usable
    scans = [episode for episode in usable if episode.info.kind == "scan"]
    if scans:
        return Sources(episodes=tuple(scans), remark="; ".join(remarks))
    if broken and not usable:
        raise broken[0]
    if not usable:
        message = (
            f"no episode in {run.episodes_dir} has colour and depth images with intrinsics. "
            "Record a scan, or import a folder: robot-gst import rgbd FOLDER RUN."
        )
        raise NoFramesError(message)
    usable = [episode for episode in usable if episode.info.kind not in ("trial", RETRY)] or usable
    kinds = sorted({episode.info.kind for episode in usable})
    remarks.insert(
        0, f"no scan in this run: using {len(usable)} episode(s) of kind {', '.join(kinds)}"
    )
    return Sources(episodes=tuple(usable), remark="; ".join(remarks))


def rgbd_camera_ids(episode: Episode, others: tuple[str, ...] = COLOR_AND_DEPTH) -> list[str]:
    """Cameras with colour and depth, both with intrinsics; never those of stand-in truth."""
    topics = {topic for topic in episode.topics() if not is_truth(topic)}
    stems = {topic.removesuffix(COLOR_IMAGE) for topic in topics if topic.endswith(COLOR_IMAGE)}
    return sorted(
        stem.split("/")[-1] for stem in stems if all(stem + ending in topics for ending in others)
    )


def choose_frames(
    sources: Sources,
    config: FrameConfig,
    output: Output = QUIET,
    calibration: Calibration | None = None,
) -> Chosen:
    """Hold out every n-th frame of each camera, then choose training frames from the others.

    Which frames are held out depends on their number alone, never on what they show.

    Args:
        calibration: Where cameras are mounted; None: they are where ``/tf`` or odometry says.
    """
    found = [
        (episode, camera_id)
        for episode in sources.episodes
        for camera_id in rgbd_camera_ids(episode) or rgbd_camera_ids(episode, COLOR_ALONE)
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
    kept, others = _in_one_frame(choices)
    left_out = (*(f"left out: {error}" for error in lost), *others)
    for reason in left_out:
        output.say(reason)
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
    others = [
        f"camera {choice.camera_id} of {choice.episode.info.id} is left out: its poses are in "
        f"frame {root_frame(choice)!r}, and nothing says where that is in {root!r}"
        for choice in choices
        if root_frame(choice) != root
    ]
    return kept, others


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
    held = stamps[config.holdout_every // 2 :: config.holdout_every]
    poses = find_poses(
        episode, camera_id, stamps, frozenset(held.tolist()), config, output, calibration
    )
    unposed = np.array(sorted(poses.unposed_ns), dtype=np.int64)
    posed, frame_id = (
        np.setdiff1d(stamps, unposed),
        streams.camera_info(episode, camera_id).frame_id,
    )
    stationary = len(posed) > 1 and never_moves(poses.tree, frame_id, posed)
    train_count, holdout_count = config.max_train_frames, config.max_holdout_frames
    if stationary:
        train_count = min(train_count, STATIONARY_TRAIN_FRAMES)
        holdout_count = min(holdout_count, STATIONARY_HOLDOUT_FRAMES)
    held = np.setdiff1d(held, unposed)
    rest = np.setdiff1d(stamps[:: max(config.train_every, 1)], np.concatenate([held, unposed]))
    train = spread(rest, train_count)
    if not config.train_every and len(rest) > train_count:
        path_m = path_length_m(poses.tree.Ts_root_frame(frame_id, rest))
        train = pick(rest, path_m, train_count)
    return FrameChoice(
        episode=episode,
        camera_id=camera_id,
        stationary=stationary,
        train_ns=frozenset(train.tolist()),
        holdout_ns=frozenset(spread(held, holdout_count).tolist()),
        poses=poses,
        spare_ns=frozenset(np.setdiff1d(rest, train).tolist()),
    )


def spread(values: np.ndarray, count: int) -> np.ndarray:
    """Pick at most ``count`` values at even distances, both ends included."""
    if len(values) <= count:
        return values
    return np.asarray(values[np.unique(np.linspace(0, len(values) - 1, count).round().astype(int))])


def load(choice: FrameChoice, stamps_ns: frozenset[int]) -> Iterator[RgbdFrame]:
    """Yield the frames of a choice that carry one of the stamps, with the poses it chose."""
    if not choice.has_depth:
        yield from _without_depth(choice, stamps_ns)
        return
    tree = choice.poses.tree
    for frame in streams.rgbd_frames(choice.episode, choice.camera_id, tree, stamps_ns):
        yield with_true_depth(frame, choice.poses)


def _without_depth(choice: FrameChoice, stamps_ns: frozenset[int]) -> Iterator[RgbdFrame]:
    """Colour images with the depth that was estimated for them, or none."""
    info = streams.camera_info(choice.episode, choice.camera_id)
    camera = info.camera
    nothing = np.zeros((camera.height, camera.width), dtype=np.float32)
    for color in streams.color_images(choice.episode, choice.camera_id):
        if color.stamp_ns in stamps_ns:
            depth_m = choice.estimated_m.get(color.stamp_ns, nothing)
            factor = camera.width // depth_m.shape[1]
            height, width = (side * factor for side in depth_m.shape)
            T = choice.poses.tree.T_root_frame(info.frame_id, color.stamp_ns)
            yield RgbdFrame(
                camera_id=choice.camera_id,
                stamp_ns=color.stamp_ns,
                image_u8=color.image_u8(),
                depth_m=depth_m,
                color_camera=camera,
                depth_camera=replace(camera, width=width, height=height).scaled(1 / factor),
                T_base_color=T,
                T_base_depth=T,
            )


def with_true_depth(frame: RgbdFrame, poses: CameraPoses) -> RgbdFrame:
    """A frame whose depth is what a calibration makes of what was measured."""
    if poses.depth_scale == 1.0:
        return frame
    return replace(frame, depth_m=frame.depth_m * np.float32(poses.depth_scale))
