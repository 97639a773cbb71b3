"""How long after its command the arm gets where it was told to be."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar
from scipy.stats import t as student

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.task.robot import ARM_JOINTS

LONGEST_S = 0.5
FIRST_S = 3.0
"""Later, controllers that wait for the gripper run behind the plan for other reasons."""
MOVES_RAD = 0.05
FEWEST = 3
"""Episodes from which an interval can be given."""


@dataclass(frozen=True, kw_only=True)
class Delay:
    """The delay over episodes, with a 95 % interval of its mean."""

    value_s: float
    low_s: float
    high_s: float
    num_episodes: int


def delay_of(episode: Episode) -> float | None:
    """Shift that lays the recorded joints best over those of the executed plan [s].

    None where the plan has no joints of its own, was not executed, or hardly moves.
    """
    for _, plan in streams.plans(episode):
        interval = streams.executed_interval_ns(episode, plan.id)
        if interval is None or any(item.joints_rad is None for item in plan.tau):
            continue
        track = streams.joint_track(episode)
        if set(ARM_JOINTS) - set(track.names):
            return None
        told = np.array([item.joints_rad for item in plan.tau], dtype=np.float64)
        end_s = min((interval[1] - interval[0]) * 1e-9, FIRST_S)
        times_s = np.arange(0.0, end_s, 0.008)
        stamps = interval[0] + np.rint(times_s * 1e9).astype(np.int64)
        seen = track.at(stamps)[:, [track.names.index(name) for name in ARM_JOINTS]]
        return best_shift_s(plan.times_ns() * 1e-9, told, times_s, seen)
    return None


def best_shift_s(
    told_s: Float[np.ndarray, " num_waypoints"],
    told_rad: Float[np.ndarray, "num_waypoints num_joints"],
    seen_s: Float[np.ndarray, " num_samples"],
    seen_rad: Float[np.ndarray, "num_samples num_joints"],
) -> float | None:
    """Delay with the least squared distance between two tracks; None when nothing moves."""
    if len(seen_s) < 2 or float(np.ptp(seen_rad, axis=0).max()) < MOVES_RAD:
        return None

    def cost(delay_s: float) -> float:
        columns = [np.interp(seen_s - delay_s, told_s, column) for column in told_rad.T]
        return float(np.mean((np.stack(columns, axis=1) - seen_rad) ** 2))

    return float(minimize_scalar(cost, bounds=(0.0, LONGEST_S), method="bounded").x)


def mean_delay(delays_s: list[float]) -> Delay | None:
    """Mean of several episodes; None with too few for an interval."""
    if len(delays_s) < FEWEST:
        return None
    values = np.array(delays_s)
    mean = float(values.mean())
    half = float(student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return Delay(value_s=mean, low_s=mean - half, high_s=mean + half, num_episodes=len(values))
