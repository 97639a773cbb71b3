"""Where a camera sits in the hand, from its images of scans.

Images are laid onto each other in pairs by depth and brightness, which says how the camera moved
in between without asking the robot; the mounting makes the joints say the same. No target.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.reader import Episode
from bridge.geometry import se3
from twin.calibrate.hand_eye import ROUNDS, UndeterminedCameraError, misfits, solve_motions
from twin.robot.model import load_robot
from twin.robot.posture import posture_track
from twin.scene.frames.odometry import Aligner
from twin.scene.frames.selection import FrameChoice, Sources, choose_frames, load, spread
from twin.scene.settings import FrameConfig

MAX_PAIRS, MIN_PAIRS = 60, 16
"""Of each scan that are laid together; of all that meet, at least."""
NEAR_M, NEAR_RAD = 0.3, 0.8
"""Images farther apart than one of these hardly show the same."""
OUTLIER = 3.0
"""Pairs that disagree by so many times the median have no say."""
SEEN_SCALE = 0.007
"""A scale of depth nearer to 1 is left: joints that are 2 mrad off look like half a percent."""
BETTER = 0.8
"""Share of what the recorded place leaves, mean of m and rad, from which another counts."""

Motion = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Of the link by the joints, of the camera by its images, and the mounting as recorded."""


def find_carried_camera(episodes: Sequence[Episode], camera_id: str, link: str) -> dict[str, Any]:
    """Find where a camera sits on a link of the robot from scans whose ``/tf`` knows roughly.

    UndeterminedCameraError where too few images meet, or agree as well with the recorded place.
    """
    config = FrameConfig(poses="tf", max_train_frames=200)
    chosen = choose_frames(Sources(episodes=tuple(episodes), remark=""), config).choices
    own, aligner = [c for c in chosen if c.camera_id == camera_id], Aligner(config.max_depth_m)
    motions = [motion for choice in own for motion in _motions(choice, link, aligner)]
    if len(motions) < MIN_PAIRS:
        raise UndeterminedCameraError("too few of its images of scans meet to say where it sits")
    P, Q, recorded = np.array(motions).swapaxes(0, 1)
    X, scale = solve_motions(P, Q, scaled=True)
    for _ in range(ROUNDS):
        left = _left(P, Q, X, scale)
        kept = (left < OUTLIER * np.median(left, axis=0)).all(axis=1)
        X, scale = solve_motions(P[kept], Q[kept], scaled=True)
    after = np.median(_left(P, Q, X, scale), axis=0)
    before = np.median(_left(P, Q, recorded[0], 1.0), axis=0)
    if np.mean(after / before) > BETTER:
        raise UndeterminedCameraError("its images agree with its recorded place as well")
    change = se3.invert(recorded[0]) @ X
    return {
        "method": "motions between images of scans against those of the joints",
        "mount": "hand",
        "link": link,
        "stream": "depth",
        "T_link_camera": se3.pose_record(X),
        "depth_scale": scale if abs(scale - 1) > SEEN_SCALE else 1.0,
        "num_pairs": len(P),
        "residual_m": {"value": float(after[0])},
        "residual_rad": float(after[1]),
        "sources": [choice.episode.info.id for choice in own],
        "correction_m": float(np.linalg.norm(change[:3, 3])),
        "correction_rad": float(se3.rotation_angle_rad(change[:3, :3])),
    }


def _motions(choice: FrameChoice, link: str, aligner: Aligner) -> Iterator[Motion]:
    """Lay near images of a scan onto each other, beginning where ``/tf`` has them."""
    track = posture_track(choice.episode)
    robot, frames = load_robot(track.urdf), load(choice, choice.train_ns | choice.holdout_ns)
    looks = [aligner.look(frame) for frame in frames if track.covers(frame.stamp_ns)]
    near = []
    for pair in combinations(looks, 2):
        first, second = (look.small.T_base_depth for look in pair)
        T = se3.invert(second) @ first
        if np.linalg.norm(T[:3, 3]) < NEAR_M and se3.rotation_angle_rad(T[:3, :3]) < NEAR_RAD:
            near.append((*pair, T))
    for index in spread(np.arange(len(near)), MAX_PAIRS).tolist():
        step = aligner.lay(*near[index])
        if step is not None:
            stamps_ns = [look.small.stamp_ns for look in near[index][:2]]
            a, b = (robot.T_base_link(link, track.at(ns).joints_rad) for ns in stamps_ns)
            mounted = se3.invert(a) @ near[index][0].small.T_base_depth
            yield se3.invert(b) @ a, step.T_target_source, mounted


def _left(
    P: np.ndarray, Q: np.ndarray, X: np.ndarray, scale: float
) -> Float[np.ndarray, "num_pairs 2"]:
    """What is left between the two ways to each second image [m, rad]."""
    scaled = Q.copy()
    scaled[:, :3, 3] *= scale
    return np.asarray(np.linalg.norm(misfits(P, scaled, X, X).reshape(-1, 2, 3), axis=2))
