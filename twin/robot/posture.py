"""Recorded postures: joints at an instant, whether the robot stood still, whether time ran back."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.episode import schema
from bridge.episode.executions import whose
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack, joint_track, robot_description
from bridge.episode.topics import GRIPPER_STATE, ROBOT_DESCRIPTION
from bridge.errors import EpisodeError
from bridge.robots.robot import GRIPPER_WIDTH, Robot, robot_of
from twin.errors import TwinError
from twin.robot.model import RobotDescriptionError

BACK_NS = 20_000_000
"""Messages of several publishers may overtake each other by this much."""


class BackwardTimeError(TwinError):
    """Nobody knows in which order an execution happened."""


def check_clock(
    episode: Episode, endings: Sequence[str], start_ns: int, end_ns: int, plan_id: str
) -> None:
    """Raises BackwardTimeError where the source's clock went back, or no time passed."""
    if end_ns <= start_ns:
        raise BackwardTimeError(
            f"the execution of {whose(plan_id)} ended {(start_ns - end_ns) * 1e-9:.2f} s before it "
            "started; look at the clock of the events"
        )
    topics = [
        topic
        for topic in episode.topics_of_type(schema.JOINT_STATE)
        if any(topic.endswith(ending) for ending in endings)
    ]
    latest: dict[str, int] = {}
    inside: set[str] = set()
    for message in episode.messages(topics):
        stamp_ns = message.publish_time_ns
        before_ns = latest.get(message.topic, stamp_ns)
        jumped = before_ns - stamp_ns > BACK_NS
        if jumped and message.topic in inside and stamp_ns <= end_ns:
            raise BackwardTimeError(
                f"the time of {message.topic} goes back by {(before_ns - stamp_ns) * 1e-9:.2f} s "
                f"at {max(0, before_ns - start_ns) * 1e-9:.2f} s of {whose(plan_id)}; the "
                "execution is not known in its right order"
            )
        if start_ns <= stamp_ns <= end_ns:
            inside.add(message.topic)
        latest[message.topic] = stamp_ns if jumped else max(before_ns, stamp_ns)


BEFORE_NS, AFTER_NS = 100_000_000, 40_000_000
STILL_RAD = 0.002
"""A robot whose joints vary less than this from a tenth of a second before to 40 ms after an image
stands still; camera and joints then need not be synchronised better than that."""
APART_RAD = 0.15
"""Postures of which no joint differs by more tell nothing new."""
MAX_GAP_NS = 500_000_000
"""Joints farther away in time say nothing."""


@dataclass(frozen=True, kw_only=True)
class Posture:
    """One configuration of arm and gripper."""

    joints_rad: Float[np.ndarray, " num_joints"]
    """In the order of the robot's ``joints``."""
    width_m: float = 0.0
    """Opening of the gripper."""


@dataclass(frozen=True, kw_only=True)
class PostureTrack:
    """The robot's postures over the time of one episode."""

    urdf: str
    arm: JointTrack
    widths: JointTrack | None
    """None where nobody recorded the gripper; it then counts as closed."""

    def covers(self, stamp_ns: int) -> bool:
        """Whether joints were recorded around this instant."""
        index = int(np.searchsorted(self.arm.stamps_ns, stamp_ns))
        near = self.arm.stamps_ns[max(index - 1, 0) : index + 1]
        return bool(np.abs(near - stamp_ns).min() < MAX_GAP_NS)

    def at(self, stamp_ns: int) -> Posture:
        """Interpolate linearly."""
        stamps = np.array([stamp_ns])
        order = [self.arm.names.index(name) for name in robot_of(self.urdf).joints]
        width = 0.0 if self.widths is None else float(self.widths.at(stamps)[0, 0])
        return Posture(joints_rad=self.arm.at(stamps)[0, order], width_m=width)

    def is_stationary(self, stamp_ns: int) -> bool:
        """Whether joints were recorded, and hardly moved, around this instant."""
        if not self.covers(stamp_ns):
            return False
        around = self.arm.at(np.array([stamp_ns - BEFORE_NS, stamp_ns, stamp_ns + AFTER_NS]))
        return bool(np.ptp(around, axis=0).max() < STILL_RAD)


def distinct_postures(
    joints_rad: Float[np.ndarray, "num_postures num_joints"], count: int
) -> list[int]:
    """Choose at most so many postures far from each other, farthest first, until none is new."""
    chosen = [0]
    far = np.abs(joints_rad - joints_rad[0]).max(axis=1)
    while len(chosen) < count and far.max() > APART_RAD:
        chosen.append(int(np.argmax(far)))
        far = np.minimum(far, np.abs(joints_rad - joints_rad[chosen[-1]]).max(axis=1))
    return sorted(chosen)


def posture_track(episode: Episode) -> PostureTrack:
    """Read robot description, joint states and gripper width of an episode."""
    urdf = robot_description(episode)
    if urdf is None:
        raise RobotDescriptionError(
            f"is missing in episode {episode.info.id}",
            f"Record {ROBOT_DESCRIPTION}, or attach the URDF as robot.urdf.",
        )
    arm = joint_track(episode)
    robot = robot_of(urdf)
    check_joints(arm, f"episode {episode.info.id}", robot)
    try:
        widths: JointTrack | None = width_track(episode, robot)
    except EpisodeError:
        widths = None
    return PostureTrack(urdf=urdf, arm=arm, widths=widths)


def width_track(episode: Episode, robot: Robot) -> JointTrack:
    """Read the recorded distance between the fingers' pads [m].

    Where no gripper state was recorded, it follows from a finger among the joint states. A fixed
    tool has no width: 0 whenever the joints were recorded.
    """
    try:
        return joint_track(episode, GRIPPER_STATE)
    except EpisodeError:
        arm = joint_track(episode)
        widths_m = width_in(arm.names, arm.position, robot)
        if widths_m is None:
            raise
    return JointTrack(names=(GRIPPER_WIDTH,), stamps_ns=arm.stamps_ns, position=widths_m[:, None])


def width_in(
    names: Sequence[str], position: Float[np.ndarray, "num_rows num_joints"], robot: Robot
) -> Float[np.ndarray, " num_rows"] | None:
    """What joint states say of the width [m]; None where its fingers are not among them."""
    if GRIPPER_WIDTH in names:  # one vector holds all, as in LeRobot's state
        return position[:, names.index(GRIPPER_WIDTH)]
    fingers = robot.gripper.fingers
    finger = next((item for item in fingers if item.joint in names), None)
    if finger is not None:
        return np.asarray(finger.width(position[:, names.index(finger.joint)]))
    return None if fingers else np.zeros(len(position))


def check_joints(arm: JointTrack, source: str, robot: Robot) -> None:
    """See that joint states are of the robot that is meant."""
    missing = [name for name in robot.joints if name not in arm.names]
    if missing:
        raise RobotDescriptionError(
            f"does not fit {source}, which lacks {', '.join(missing)}",
            f"Its joint states have: {', '.join(arm.names)}.",
        )
