"""Imported pushes: what was recorded of one, and where its box goes in the twin.

A push has a measured tool and a box on a table, and neither joints nor a plan (the record
``scripted_motion`` of its episode). ``executed`` lets the hand follow the measured tool,
``planned`` the joint schedule that the arm was given.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import object_pose_topics, pose_track
from bridge.episode.topics import TCP_POSE
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.scripted_motion import RECORD_NAME, ScriptedMotion
from twin.calibrate.motion import Arm, Motion, Seen
from twin.errors import TwinError
from twin.physics.config import PhysicsConfig
from twin.physics.push import PushWorld
from twin.replay.config import STATE_EVERY
from twin.robot.hand import Hand

Trajectory = Literal["planned", "executed"]
REST_S = (0.2, 1.0)
"""From when to when everything is at rest at the start of a recording; the first samples of a
motion capture jump by up to 10 mm."""
SMOOTH_S = 0.02
"""Standard deviation of the centred Gaussian that measured tool poses are smoothed by: positions
jump by up to 2 mm from one sample to the next, which would be knocks of 0.2 m/s."""
LONGEST_GAP_S = 0.1
"""A recording whose tool is lost for longer is not replayed."""
NEAR_M = 0.03
"""Physics runs while a hull of the hand may be nearer to the box than this, and for ``SETTLE_S``
afterwards."""
SETTLE_S = 1.0
LOOK_EVERY = 12
"""Steps between two looks whether the hand is near; it moves by some 10 mm meanwhile."""


class UnusablePushError(TwinError):
    """An imported recording that cannot be replayed."""


@dataclass(frozen=True, kw_only=True)
class Push:
    """One recorded run with its robot, ready to be replayed."""

    episode: str
    sha256: str
    task: str
    motion: ScriptedMotion
    hand: Hand
    tool: PoseTrajectory
    """As recorded."""
    T_hand_tool: Float[np.ndarray, "4 4"]
    """Estimated at the start, where all joints are zero."""
    T_world_box: Float[np.ndarray, "4 4"] | None
    """Where the box starts, upright; None: there is none, the tool alone moves."""
    box: str = ""
    """Its object id."""
    box_track: PoseTrajectory | None = None
    """As recorded."""


@dataclass(frozen=True, kw_only=True)
class PushResult:
    """States over time, world frame, on the clock of the recording."""

    stamps_ns: Int[np.ndarray, " num_states"]
    Ts_world_tool: Float[np.ndarray, "num_states 4 4"]
    Ts_world_box: Float[np.ndarray, "num_states 4 4"] | None


def motion_of(episode: Episode) -> ScriptedMotion | None:
    """Read what an imported recording's arm was told; None for any other episode."""
    if episode.info.kind != "imported":
        return None
    record = episode.record(RECORD_NAME)
    return ScriptedMotion.from_record(record) if record else None


def read_push(run: RunFolder, episode: Episode, motion: ScriptedMotion, hand: Hand) -> Push:
    """Read one recording."""
    name = episode.info.id
    topics = [
        topic for topic in episode.topics_of_type(schema.POSE_STAMPED) if topic.endswith(TCP_POSE)
    ]
    if not topics:
        raise UnusablePushError(
            f"{name} in {run.path}: no tool poses (a topic ending with {TCP_POSE})."
        )
    tool = pose_track(episode, topics[0])
    gap_s = float(np.diff(tool.stamps_ns).max(initial=0)) / NS_PER_S
    if gap_s > LONGEST_GAP_S:
        raise UnusablePushError(f"{name} in {run.path}: the tool is lost for {gap_s:.2f} s.")
    if len(motion.boxes) > 1:
        raise UnusablePushError(
            f"{name} in {run.path}: {len(motion.boxes)} boxes; one can be replayed."
        )
    T_world_hand = hand.T_base_hand(np.zeros(len(motion.joints)))
    T_world_hand[:3, 3] += motion.base_m
    box, T_world_box, track = "", None, None
    for box in motion.boxes:
        topic = object_pose_topics(episode).get(box)
        if topic is None:
            raise UnusablePushError(f"{name}: no poses of {box!r} were recorded.")
        track = pose_track(episode, topic)
        T_world_box = rest_pose(track)
        heading = np.arctan2(T_world_box[1, 0], T_world_box[0, 0])
        T_world_box[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, heading]))
    return Push(
        episode=name,
        sha256=episode.sha256(),
        task=episode.info.task,
        motion=motion,
        hand=hand,
        tool=tool,
        T_hand_tool=se3.invert(T_world_hand) @ rest_pose(tool),
        T_world_box=T_world_box,
        box=box,
        box_track=track,
    )


def rest_pose(track: PoseTrajectory) -> Float[np.ndarray, "4 4"]:
    """Median position and mean rotation while everything is at rest at the start."""
    t_s = (track.stamps_ns - track.stamps_ns[0]) / NS_PER_S
    there = (t_s >= REST_S[0]) & (t_s <= REST_S[1])
    if not there.any():
        raise UnusablePushError(
            f"no pose from {REST_S[0]} s to {REST_S[1]} s after the start of a recording."
        )
    Ts = track.transforms()[there]
    R = se3.nearest_rotation(Ts[:, :3, :3].mean(axis=0))
    return se3.from_rotation(R, np.median(Ts[:, :3, 3], axis=0))


def arm_of(push: Push) -> Arm:
    """What the description says of a recording's arm."""
    return Arm(push.motion.joints, push.hand.T_base_hand, push.hand.gravity_nm)


def seen_of(push: Push) -> Seen:
    """Schedule and measured tool, both from the start of the recording."""
    seen_s = (push.tool.stamps_ns - push.tool.stamps_ns[0]) / NS_PER_S
    return Seen(push.episode, *push.motion.joint_path_rad(), seen_s, push.tool.transforms())


def described(push: Push) -> Motion:
    """The arm as it is described, with the tool as it is held at the start."""
    nothing, base = np.zeros(len(push.motion.joints)), np.eye(4)
    base[:3, 3] = push.motion.base_m
    return Motion(
        T_frame_base=base,
        T_hand_tool=push.T_hand_tool,
        zeros_rad=nothing,
        compliance_rad_nm=nothing,
        delay_s=0.0,
    )


def replay_push(
    push: Push,
    trajectory: Trajectory,
    config: PhysicsConfig,
    finger_rad: float = 0.0,
    motion: Motion | None = None,
) -> PushResult:
    """Let the hand follow a trajectory and the box go where it is pushed.

    Args:
        trajectory: ``executed``: the measured tool; ``planned``: the joint schedule.
        motion: The arm that follows the schedule; as described where None.
    """
    known = described(push) if motion is None or trajectory == "executed" else motion
    stamps_ns, Ts_world_hand = hand_path(push, trajectory, config.rate_hz, known)
    Ts_world_box = None
    if push.T_world_box is not None:
        hulls_m, T_start = push.hand.hulls_m(finger_rad), push.T_world_box
        Ts_world_box = _push_box(push, T_start, Ts_world_hand, config, hulls_m)
    kept = np.unique(np.append(np.arange(0, len(stamps_ns), STATE_EVERY), len(stamps_ns) - 1))
    return PushResult(
        stamps_ns=stamps_ns[kept],
        Ts_world_tool=Ts_world_hand[kept] @ known.T_hand_tool,
        Ts_world_box=None if Ts_world_box is None else Ts_world_box[kept],
    )


def hand_path(
    push: Push, trajectory: Trajectory, rate_hz: int, known: Motion
) -> tuple[Int[np.ndarray, " num_steps"], Float[np.ndarray, "num_steps 4 4"]]:
    """Where the hand link is at every physics step, world frame."""
    first_ns = int(push.tool.stamps_ns[0])
    if trajectory == "planned":
        told = seen_of(push)
        whole_s = told.times_s[-1] + max(0.0, known.delay_s)
        at_s = np.arange(round(whole_s * rate_hz) + 1) / rate_hz
        Ts = known.Ts_frame_hand(arm_of(push), told.joints_at(at_s, known.delay_s))
        return first_ns + np.rint(at_s * NS_PER_S).astype(np.int64), Ts
    last_ns = int(push.tool.stamps_ns[-1])
    count = round((last_ns - first_ns) / NS_PER_S * rate_hz)
    stamps_ns = first_ns + np.rint(np.arange(count + 1) * NS_PER_S / rate_hz).astype(np.int64)
    track = push.tool.at(stamps_ns)
    sigma = SMOOTH_S * rate_hz
    q = track.q_wxyz * np.where((track.q_wxyz @ track.q_wxyz[0]) < 0, -1.0, 1.0)[:, None]
    signs = np.cumprod(np.append(1.0, np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0)))
    q = gaussian_filter1d(q * signs[:, None], sigma, axis=0, mode="nearest")
    p = gaussian_filter1d(track.p_m, sigma, axis=0, mode="nearest")
    Ts_world_tool = se3.transform_from(q / np.linalg.norm(q, axis=1, keepdims=True), p)
    return stamps_ns, np.asarray(Ts_world_tool @ se3.invert(push.T_hand_tool))


def _push_box(
    push: Push,
    T_start: Float[np.ndarray, "4 4"],
    Ts_world_hand: Float[np.ndarray, "num_steps 4 4"],
    config: PhysicsConfig,
    hulls_m: list[Float[np.ndarray, "num_points 3"]],
) -> Float[np.ndarray, "num_steps 4 4"]:
    box = push.motion.boxes[push.box]
    size_m = np.array(box.size_m)
    velocity = np.diff(Ts_world_hand[:, :3, 3], axis=0) * config.rate_hz
    R = Ts_world_hand[:, :3, :3]
    turning = se3.vector_from_rotation(R[1:] @ np.swapaxes(R[:-1], 1, 2)) * config.rate_hz
    q_hand, p_hand = se3.split(Ts_world_hand)
    pose = np.concatenate([T_start[:3, 3], se3.split(T_start)[0]])
    states = [pose]
    left = 0
    with PushWorld(
        config,
        hulls_m=hulls_m,
        size_m=size_m,
        mass_kg=box.mass_kg,
        T_world_box=T_start,
        table_height_m=float(T_start[2, 3] - size_m[2] / 2),
    ) as world:
        corners = np.concatenate(hulls_m)
        first_ids = np.cumsum([0, *(len(points) for points in hulls_m[:-1])])
        for step in range(len(velocity)):
            left = max(left - 1, 0)
            if step % LOOK_EVERY == 0 and _near(
                corners, first_ids, Ts_world_hand[step], pose, size_m
            ):
                left = round(SETTLE_S * config.rate_hz)
            if left:
                pose = world.step(p_hand[step], q_hand[step], velocity[step], turning[step])
            states.append(pose)
    all_states = np.stack(states)
    return se3.transform_from(all_states[:, 3:], all_states[:, :3])


def _near(
    corners_m: Float[np.ndarray, "num_points 3"],
    first_ids: Int[np.ndarray, " num_hulls"],
    T_world_hand: Float[np.ndarray, "4 4"],
    pose: Float[np.ndarray, "7"],
    size_m: Float[np.ndarray, "3"],
) -> bool:
    """Whether a hull may be within ``NEAR_M`` of the box: its bounds along the box's axes are."""
    T_box_hand = se3.invert(se3.transform_from(pose[3:], pose[:3])) @ T_world_hand
    there = corners_m @ T_box_hand[:3, :3].T + T_box_hand[:3, 3]
    reach = size_m / 2 + NEAR_M
    low, high = np.minimum.reduceat(there, first_ids), np.maximum.reduceat(there, first_ids)
    return bool(((low < reach) & (high > -reach)).all(axis=1).any())
