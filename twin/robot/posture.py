"""Where the robot's joints were at an instant of an episode, and whether it stood still."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack, joint_track, robot_description
from bridge.errors import EpisodeError
from bridge.task.robot import ARM_JOINTS
from twin.robot.description import RobotDescriptionError

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
    """In the order of ``bridge.task.robot.ARM_JOINTS``."""
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
        order = [self.arm.names.index(name) for name in ARM_JOINTS]
        width = 0.0 if self.widths is None else float(self.widths.at(stamps)[0, 0])
        return Posture(joints_rad=self.arm.at(stamps)[0, order], width_m=width)

    def is_still(self, stamp_ns: int) -> bool:
        """Whether joints were recorded, and hardly moved, around this instant."""
        if not self.covers(stamp_ns):
            return False
        around = self.arm.at(np.array([stamp_ns - BEFORE_NS, stamp_ns, stamp_ns + AFTER_NS]))
        return bool(np.ptp(around, axis=0).max() < STILL_RAD)


def far_apart(joints_rad: Float[np.ndarray, "num_postures num_joints"], count: int) -> list[int]:
    """Choose at most so many postures far from each other, farthest first, until none is new."""
    chosen = [0]
    far = np.abs(joints_rad - joints_rad[0]).max(axis=1)
    while len(chosen) < count and far.max() > APART_RAD:
        chosen.append(int(np.argmax(far)))
        far = np.minimum(far, np.abs(joints_rad - joints_rad[chosen[-1]]).max(axis=1))
    return sorted(chosen)


def posture_track(episode: Episode) -> PostureTrack:
    """Read robot description, joint states and gripper width of an episode.

    Raises:
        EpisodeError: No joint states.
        RobotDescriptionError: No robot description, or joint states of another robot.
    """
    urdf = robot_description(episode)
    if urdf is None:
        raise RobotDescriptionError(
            found=f"is missing in episode {episode.info.id}",
            hint="Record /robot_description, or attach the URDF as robot.urdf.",
        )
    arm = joint_track(episode)
    check_joints(arm, f"episode {episode.info.id}")
    try:
        widths = joint_track(episode, "/gripper/state")
    except EpisodeError:
        widths = None
    return PostureTrack(urdf=urdf, arm=arm, widths=widths)


def check_joints(arm: JointTrack, source: str) -> None:
    """See that joint states are of the robots that are known here.

    Raises:
        RobotDescriptionError: A joint of the arm is missing in what a source sent.
    """
    missing = [name for name in ARM_JOINTS if name not in arm.names]
    if missing:
        raise RobotDescriptionError(
            found=f"does not fit {source}, which lacks {', '.join(missing)}",
            hint=f"Its joint states have: {', '.join(arm.names)}.",
        )
