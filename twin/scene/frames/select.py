"""Pick training frames: one for each stretch of the camera's path, the stillest and sharpest.

A scan holds far more frames than a fit can use. Frames a camera took while it moved fast are
smeared, and their pose is as wrong as the clocks of camera and robot differ.
"""

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from bridge.episode import streams
from bridge.episode.cdr.messages import color_from_message
from bridge.episode.reader import Episode
from bridge.episode.transforms import TransformTree
from bridge.errors import EpisodeError
from bridge.geometry import se3

TURN_M_PER_RAD = 0.5
"""How much path a turn counts for: what a camera sees at this distance moves by as much."""
MOTION_WINDOW_NS = 20_000_000
"""Motion is the difference of poses this long before and after an image."""
TYPICAL_DEPTH_M = 0.7
EXPOSURE_S = 0.01
SMEAR_PX = 0.5
"""Smear in one exposure below this cannot be seen."""
UNKNOWN_PX = 1e6
"""Instead of a smear that cannot be known."""
MOTION_SLACK = 1.5
"""Frames this many times as fast as the slowest of a stretch are still considered."""
MAX_LOOKS = 3
"""Images decoded per stretch."""
BLURRED = 0.25
"""A frame with less than this share of its neighbours' sharpness is left out."""
MIN_KEPT = 5

Sharpness = Callable[[Collection[int]], Mapping[int, float]]
"""Stamps [ns] in, sharpness of each image out."""


def pick(
    stamps_ns: Int[np.ndarray, " num_frames"],
    path_m: Float[np.ndarray, " num_frames"],
    smear_px: Float[np.ndarray, " num_frames"],
    count: int,
    sharpness_of: Sharpness,
) -> Int[np.ndarray, " num_picked"]:
    """Return the stamps of at most ``count`` frames, in order; the same input picks the same.

    The path is cut into stretches of equal length, as many as give at most ``count`` that hold
    a frame. Of the frames of a stretch that smear least, the sharpest is taken: seen from nearly
    the same place, texture does not decide. Frames far blurrier than their neighbours are left
    out, unless hardly any would remain.

    Args:
        stamps_ns: Source stamps in order.
        path_m: Distance the camera has come since the first frame, see ``path_length_m``.
        smear_px: How far the image moves during one exposure.
        count: How many are wanted.
        sharpness_of: Asked once, for the frames that come into question.
    """
    if len(stamps_ns) == 0 or count < 1:
        return stamps_ns[:0]
    stretch = _stretches(path_m, count)
    looks = [_shortlist(np.flatnonzero(stretch == k), smear_px) for k in np.unique(stretch)]
    sharpness = sharpness_of([int(stamps_ns[i]) for look in looks for i in look])
    best = [max(look, key=lambda i: (sharpness[int(stamps_ns[i])], -i)) for look in looks]
    values = np.array([sharpness[int(stamps_ns[i])] for i in best])
    sharp = np.asarray(values >= BLURRED * _around(values))
    kept = np.array(best)[sharp if sharp.sum() >= min(MIN_KEPT, len(best)) else slice(None)]
    return np.asarray(stamps_ns[kept])


def path_length_m(
    Ts_base_camera: Float[np.ndarray, "num_frames 4 4"],
) -> Float[np.ndarray, " num_frames"]:
    """How far the camera has come, turns included; grows a little even while it stands still."""
    if len(Ts_base_camera) < 2:
        return np.zeros(len(Ts_base_camera))
    steps = _steps_m(Ts_base_camera[:-1], Ts_base_camera[1:])
    return np.concatenate([[0.0], np.cumsum(steps + max(1e-6, 1e-3 * float(steps.mean())))])


def smear_px(
    tree: TransformTree, frame_id: str, stamps_ns: Int[np.ndarray, " num_frames"], focal_px: float
) -> Float[np.ndarray, " num_frames"]:
    """How far the image of something at a typical distance moves during one exposure [px]."""
    with np.errstate(invalid="ignore"):  # a pose beside one that is not finite: motion unknown
        before = tree.Ts_root_frame(frame_id, stamps_ns - MOTION_WINDOW_NS)
        after = tree.Ts_root_frame(frame_id, stamps_ns + MOTION_WINDOW_NS)
        turn = se3.rotation_angle_rad(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
        shift = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1) / TYPICAL_DEPTH_M
    found = focal_px * (turn + shift) * EXPOSURE_S / (2e-9 * MOTION_WINDOW_NS)
    return np.asarray(np.nan_to_num(found, nan=UNKNOWN_PX, posinf=UNKNOWN_PX))


def robot_smear_px(
    episode: Episode, stamps_ns: Int[np.ndarray, " num_frames"], focal_px: float
) -> Float[np.ndarray, " num_frames"]:
    """The same for a robot in front of a camera that stands still, by its fastest joint.

    0 where no joints were recorded.
    """
    try:
        track = streams.joint_track(episode)
    except EpisodeError:
        return np.zeros(len(stamps_ns))
    change = track.at(stamps_ns + MOTION_WINDOW_NS) - track.at(stamps_ns - MOTION_WINDOW_NS)
    fastest = np.abs(change).max(axis=1, initial=0.0)
    return np.asarray(focal_px * fastest * EXPOSURE_S / (2e-9 * MOTION_WINDOW_NS))


def sharpness_at(episode: Episode, camera_id: str, stamps_ns: Collection[int]) -> dict[int, float]:
    """Decode the colour images with these stamps and rate each."""
    topic = streams.find_camera_topic(episode, camera_id, "color/image")
    wanted = set(stamps_ns)
    found: dict[int, float] = {}
    for message in episode.messages([topic] if topic else []):
        image = color_from_message(message.type_name, message.data)
        if image.stamp_ns in wanted:
            found[image.stamp_ns] = sharpness(image.image_u8())
    return found


def sharpness(image_u8: UInt8[np.ndarray, "height width 3"]) -> float:
    """Variance of the Laplacian at half size, where noise and compression count less."""
    height, width = (side // 2 * 2 for side in image_u8.shape[:2])
    grey = image_u8[:height, :width].astype(np.float32).mean(axis=2)
    grey = grey.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    inner = 4 * grey[1:-1, 1:-1]
    laplacian = inner - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
    return float(laplacian.var()) if laplacian.size else 0.0


def _steps_m(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    turn = se3.rotation_angle_rad(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    shift = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    return np.asarray(shift + TURN_M_PER_RAD * turn)


def _stretches(path_m: np.ndarray, count: int) -> np.ndarray:
    """Number the stretch of each frame, so that at most ``count`` stretches hold any."""
    total = max(float(path_m[-1]), 1e-12)
    if len(path_m) <= count:
        return np.arange(len(path_m))
    best = np.zeros(len(path_m), dtype=np.int64)
    for parts in range(count, 4 * count + 1, max(1, count // 16)):
        stretch = np.minimum((path_m / total * parts).astype(np.int64), parts - 1)
        if len(np.unique(stretch)) > count:
            break
        best = stretch
    return best


def _shortlist(members: np.ndarray, smear_px: np.ndarray) -> Sequence[int]:
    """Frames of one stretch that are still enough, a few of them."""
    limit = max(SMEAR_PX, MOTION_SLACK * float(smear_px[members].min()))
    calm = members[smear_px[members] <= limit]
    places = np.unique(np.linspace(0, len(calm) - 1, min(MAX_LOOKS, len(calm))).round())
    return [int(calm[int(place)]) for place in places]


def _around(values: np.ndarray) -> np.ndarray:
    """Median of each value and its two neighbours to each side."""
    padded = np.pad(values, 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1))
