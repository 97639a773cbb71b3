"""Errors of a motion that no constant offset explains: of its joints, and of its single steps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from bridge.episode.streams import JointTrack
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.errors import UndefinedStatisticError


@dataclass(frozen=True, kw_only=True)
class JointErrors:
    """Joint angles of two motions at the same instants."""

    names: tuple[str, ...]
    """Joints that both know, in the recorded order."""
    stamps_ns: Int[np.ndarray, " num_samples"]
    error_rad: Float[np.ndarray, "num_samples num_joints"]
    """Recorded minus replayed, modulo a whole turn: -pi to pi."""

    def over_time_rad(self) -> Float[np.ndarray, " num_samples"]:
        """Root mean square over the joints at each instant."""
        return np.asarray(np.sqrt((self.error_rad**2).mean(axis=1)))


def joint_errors(recorded: JointTrack, replayed: JointTrack) -> JointErrors:
    """Compare at the recorded stamps inside the time both cover; the replay is interpolated.

    Angles that differ by a whole turn put the arm into the same place and count as equal.
    Range: 0 rad to pi, 0 is perfect. Undefined when: no joint or no instant is shared.

    Raises:
        UndefinedStatisticError: When the two share no joint, or no instant.
    """
    names = tuple(name for name in recorded.names if name in replayed.names)
    if not names:
        raise UndefinedStatisticError(
            statistic="joint error", reason="recorded and replayed joints have no name in common"
        )
    first = max(int(recorded.stamps_ns[0]), int(replayed.stamps_ns[0]))
    last = min(int(recorded.stamps_ns[-1]), int(replayed.stamps_ns[-1]))
    common = (recorded.stamps_ns >= first) & (recorded.stamps_ns <= last)
    if not common.any():
        raise UndefinedStatisticError(
            statistic="joint error", reason="recorded and replayed stamps do not overlap"
        )
    stamps = recorded.stamps_ns[common]
    mine = [recorded.names.index(name) for name in names]
    theirs = [replayed.names.index(name) for name in names]
    difference = recorded.position[common][:, mine] - replayed.at(stamps)[:, theirs]
    wrapped = difference - 2 * np.pi * np.round(difference / (2 * np.pi))
    return JointErrors(names=names, stamps_ns=stamps, error_rad=wrapped)


def relative_errors(
    recorded: PoseTrajectory, replayed: PoseTrajectory, step: int
) -> tuple[Float[np.ndarray, " num_steps"], Float[np.ndarray, " num_steps"]]:
    """Compare what each motion does within so many samples: relative pose error.

    The difference of the two relative motions from sample i to i + step, for every i: Sturm et
    al. (2012). A constant offset in front of either motion leaves it as it is.
    Range: 0 and up, 0 is perfect. Undefined when: there are not more samples than ``step``.

    Args:
        recorded: Poses at some instants.
        replayed: Poses at the same instants.
        step: Samples, at least 1.

    Returns:
        Length [m] and angle [rad] of the difference, one for each i.

    Raises:
        UndefinedStatisticError: When the motions are not longer than one step.
    """
    if len(recorded) <= step:
        raise UndefinedStatisticError(
            statistic="relative pose error",
            reason=f"{len(recorded)} samples; a step is {step} samples long",
        )
    moved = []
    for track in (recorded, replayed):
        Ts = track.transforms()
        moved.append(se3.invert(Ts[:-step]) @ Ts[step:])
    apart = se3.invert(moved[0]) @ moved[1]
    return (
        np.asarray(np.linalg.norm(apart[:, :3, 3], axis=1)),
        se3.rotation_angle_rad(apart[:, :3, :3]),
    )
