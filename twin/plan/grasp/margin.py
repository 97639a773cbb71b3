"""How many standard deviations of an object's pose a grasp bears.

Each way in which a grasp can miss has a slack: how far the object may be from where it was
localised. It is compared with the standard deviation of the pose along that way, which the
covariance of the localisation gives, widened by what the robot and the surface are off. The chances
of missing are added up, and their sum is told as the standard deviations of one normal variable.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import log_ndtr, logsumexp, ndtri_exp

from twin.plan.grasp.open_hand import OpenHand
from twin.plan.grasp.pairs import SampledSurface
from twin.plan.problem import Covariance, Flags, Ids, Numbers, Points, Pose, Poses

SHIFTS_M = (0.002, 0.004, 0.006, 0.009, 0.012, 0.016, 0.020, 0.025, 0.030)
"""How far a closing line is shifted over the surface to see where the pads lose it."""
_OUTSIDE_M = 0.004
"""A shifted line starts so far outside the pads' contacts."""
_STEP_M = 0.004
"""Where a shifted line meets a surface deeper than this, a pad no longer lies against it."""
_PATCH_M = 0.002
"""Of a pad that must at least lie against the object."""
_ANGLE_FLOOR_RAD = 0.01
_LEAST_SIGMA_M = 1e-5

WAYS = ("across", "along", "shallow", "palm", "table", "angle", "lever")
"""In which a grasp can miss: a finger comes down on the object; the pads slip off its side, or off
its top; the hand or the tips are stopped; the contact leaves the friction cone; it turns about the
closing line under its own weight."""


@dataclass(frozen=True, kw_only=True)
class Lines:
    """Closing lines with the hands on them, object frame."""

    Ts_object_tcp: Poses
    middles_m: Points
    """Half way between the contacts."""
    widths_m: Numbers
    cosines: Numbers
    """Of the larger angle between line and normal."""

    def chosen(self, which: Flags | Ids) -> "Lines":
        """Some of them."""
        return Lines(**{name: value[which] for name, value in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class Doubt:
    """What is not known exactly."""

    covariance: Covariance
    """Of the object's pose: x, y, z and rotation about them, base frame."""
    other_m: float
    """Of robot and surface together, in every direction."""
    robot_m: float
    """Of the robot alone: the table does not move with the object."""
    middle_m: float


def reaches_along(
    surface: SampledSurface, lines: Lines, axis: int, sign: float, cone_rad: float
) -> Numbers:
    """How far a closing line may be shifted until the surface leaves the friction cone [m]."""
    y = lines.Ts_object_tcp[:, :3, 1]
    along = sign * lines.Ts_object_tcp[:, :3, axis]
    num, count = len(y), len(SHIFTS_M)
    starts = lines.middles_m - y * (lines.widths_m / 2 + _OUTSIDE_M)[:, None]
    points = (starts[:, None] + np.array(SHIFTS_M)[:, None] * along[:, None]).reshape(-1, 3)
    directions = np.repeat(y, count, axis=0)
    entry_m, first = surface.leave(points, directions)
    least = np.cos(cone_rad)
    good = -np.einsum("ni,ni->n", first, directions) >= least
    good &= np.abs(entry_m - _OUTSIDE_M) <= _STEP_M
    inside = points + directions * (np.where(good, entry_m, 0.0) + 1e-5)[:, None]
    across_m, second = surface.leave(inside, directions)
    good &= np.einsum("ni,ni->n", second, directions) >= least
    good &= np.abs(entry_m + across_m - _OUTSIDE_M - np.repeat(lines.widths_m, count)) <= _STEP_M
    # The last shift before the first that fails.
    kept = np.logical_and.accumulate(good.reshape(num, count), axis=1).sum(axis=1)
    return np.asarray(np.array([0.0, *SHIFTS_M])[kept])


def slacks(
    surface: SampledSurface,
    lines: Lines,
    hand: OpenHand,
    points_m: Float[np.ndarray, "3 num_grasps num_points"],
    *,
    over_table_m: Numbers,
    cone_rad: float,
    lever_m: float,
) -> Float[np.ndarray, "num_grasps num_ways"]:
    """How far the object may be off in each of ``WAYS`` [m, for the angle rad].

    Args:
        points_m: Of the surface, in the tool frame of each grasp; x, y and z one after the other.
        over_table_m: Height of the lowest point of each hand over the table.
        lever_m: At what distance from the closing line the weight still cannot turn the object.
    """
    x, y, z = points_m
    column = (np.abs(x) < hand.pad_half_m) & (z < hand.tip_m) & (z > -hand.depth_m)
    widest = np.where(column, np.abs(y), 0.0).max(axis=1)
    across = hand.open_m / 2 - np.maximum(widest, lines.widths_m / 2)
    sides = [reaches_along(surface, lines, 0, sign, cone_rad) for sign in (-1.0, 1.0)]
    above = reaches_along(surface, lines, 2, -1.0, cone_rad)
    from_tcp = np.einsum(
        "nij,ni->nj",
        lines.Ts_object_tcp[:, :3, :3],
        lines.middles_m - lines.Ts_object_tcp[:, :3, 3],
    )
    shallow = hand.tip_m - from_tcp[:, 2] - _PATCH_M + above
    palm = z.min(axis=1) + hand.depth_m
    angle = cone_rad - np.arccos(np.clip(lines.cosines, -1.0, 1.0))
    # Only what lies beside the closing line turns the object about it.
    middle = points_m.mean(axis=2).T - from_tcp
    lever = lever_m - np.hypot(middle[:, 0], middle[:, 2])
    rows = [across, np.minimum(*sides), shallow, palm, over_table_m, angle, lever]
    return np.stack(rows, axis=1)


def margins(
    slack: Float[np.ndarray, "num_grasps num_ways"], lines: Lines, T_base_object: Pose, doubt: Doubt
) -> Numbers:
    """Standard deviations that grasps bear, all ways of missing together."""
    R = T_base_object[:3, :3] @ lines.Ts_object_tcp[:, :3, :3]
    arm = lines.middles_m @ T_base_object[:3, :3].T
    x, y, z = (
        np.sqrt(_variance(R[:, :, axis], arm, doubt.covariance) + doubt.other_m**2)
        for axis in range(3)
    )
    turn = [
        np.einsum("ni,ij,nj->n", u, doubt.covariance[3:, 3:], u) for u in (R[:, :, 0], R[:, :, 2])
    ]
    angle = np.sqrt(np.maximum(*turn)) + _ANGLE_FLOOR_RAD
    ones = np.ones(len(R))
    sigma = [y, x, z, z, ones * doubt.robot_m, angle, ones * doubt.middle_m]
    each = slack / np.maximum(np.stack(sigma, axis=1), _LEAST_SIGMA_M)
    missing_log = np.minimum(logsumexp(log_ndtr(-each), axis=1), 0.0)  # the chances add up
    return np.asarray(-ndtri_exp(missing_log))


def _variance(u: Points, arm_m: Points, covariance: Covariance) -> Numbers:
    """Of the place of a point of the object along directions."""
    row = np.concatenate([u, np.cross(arm_m, u)], axis=1)
    return np.asarray(np.einsum("ni,ij,nj->n", row, covariance, row))
