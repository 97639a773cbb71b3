"""What the motion of a tool, seen from outside, says of the arm that moved it.

tool(t) = T_frame_base x kinematics(q + zeros - compliance x gravity(q)) x T_hand_tool, with the
joints q at t - delay. All runs share base, zeros, compliance and tool; each has a delay of its own.
Unknowns are fitted together with normal priors about the description (least squares), so what the
motion does not show stays there, and its interval says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from bridge.errors import UsageError
from bridge.geometry import se3

BASE_M, BASE_RAD, ZERO_RAD, COMPLIANCE_RAD_NM = 0.03, 0.0524, 0.0349, 0.005
WIDE_M, WIDE_RAD, DELAY_S, KNOWN_S = 1.0, 3.0, 2.0, 0.05
"""Standard deviations beforehand; the wide ones hold nothing. A number that is known no better than
half of the narrow ones, a delay than ``KNOWN_S``, is not determined."""
RATE_HZ = 5.0
"""Poses that are compared."""
LONGEST_DELAY_S = 4.0
ROUNDS = 3
"""Fits, each with weights from the residuals of the one before."""
FIRST = (0.005,) * 3 + (0.01,) * 3
"""Spread of residuals in the first of them [m, rad]."""
LEAST = 1e-5
FAR, SAME, TOGETHER = 3.0, 0.95, 0.3
"""A number farther off than so many standard deviations beforehand is not trusted; one that is
known no better than this share of them was not seen; correlation from which another is named."""
Z_95 = 1.96
Poses = Float[np.ndarray, "num_poses 4 4"]
Joints = Float[np.ndarray, "num_poses num_joints"]
Row = Float[np.ndarray, " num_joints"]
Numbers = Float[np.ndarray, " num_unknowns"]


@dataclass(frozen=True)
class Arm:
    """What a description says: pose of the hand, and the torque with which each joint holds."""

    joints: tuple[str, ...]
    T_base_hand: Callable[[Row], Float[np.ndarray, "4 4"]]
    gravity_nm: Callable[[Row], Row]


@dataclass(frozen=True)
class Seen:
    """One motion: joints [rad] on one clock, poses of the tool on another."""

    name: str
    times_s: Float[np.ndarray, " num_samples"]
    joints_rad: Float[np.ndarray, "num_samples num_joints"]
    seen_s: Float[np.ndarray, " num_poses"]
    Ts_frame_tool: Poses

    def joints_at(self, seen_s: Float[np.ndarray, " num_poses"], delay_s: float) -> Joints:
        """Joints that are seen at some instants; before and after, those at the ends."""
        return np.stack(
            [np.interp(seen_s - delay_s, self.times_s, q) for q in self.joints_rad.T], axis=1
        )

    def thinned(self) -> "Seen":
        """At most ``RATE_HZ`` poses a second."""
        wanted = np.arange(self.seen_s[0], self.seen_s[-1], 1 / RATE_HZ)
        ids = np.unique(np.searchsorted(self.seen_s, wanted))
        return replace(self, seen_s=self.seen_s[ids], Ts_frame_tool=self.Ts_frame_tool[ids])


@dataclass(frozen=True, kw_only=True)
class Motion:
    """An arm as it was seen to move."""

    T_frame_base: Float[np.ndarray, "4 4"]
    T_hand_tool: Float[np.ndarray, "4 4"]
    zeros_rad: Row
    compliance_rad_nm: Row
    delay_s: float
    """By how much later than the joints the tool is seen; the median of several runs."""

    def Ts_frame_hand(self, arm: Arm, joints_rad: Joints) -> Poses:
        """Where the hand is at some joints."""
        sag = self.compliance_rad_nm * np.array([arm.gravity_nm(q) for q in joints_rad])
        hands = [arm.T_base_hand(q) for q in joints_rad + self.zeros_rad - sag]
        return np.asarray(self.T_frame_base @ np.array(hands))

    def to_record(self) -> dict[str, Any]:
        """Plain numbers, of which ``from_record`` makes it again."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    @staticmethod
    def from_record(record: Mapping[str, Any], delay_s: float) -> "Motion":
        """Read plain numbers, with the delay of one task."""
        names = ("T_frame_base", "T_hand_tool", "zeros_rad", "compliance_rad_nm")
        return Motion(**{name: np.array(record[name]) for name in names}, delay_s=delay_s)


@dataclass(frozen=True, kw_only=True)
class Found:
    """What some runs say: ``why`` of a parameter is empty where the motion determines it."""

    motion: Motion
    parameters: Mapping[str, Mapping[str, Any]]
    """``value``, ``low``, ``high``, ``unit`` and ``why`` by name; from where the description is."""
    delays_s: Mapping[str, float]
    rms_m: float


def find_motion(arm: Arm, runs: Sequence[Seen], T_frame_base: Float[np.ndarray, "4 4"]) -> Found:
    """Fit base, tool, zeros, compliance and delays to what was seen of the tool.

    Cauchy's loss: a third of the time may be elsewhere, as where a joint did not get where it was
    told to go. Residuals in motion count by speed. ``T_frame_base`` is the description's.
    """
    problem = _Problem(arm, [run.thinned() for run in runs], T_frame_base)
    x, J = np.zeros(len(problem.rows)), np.zeros((0, len(problem.rows)))
    scales, inflation, left = [np.array(FIRST)] * len(runs), 1.0, problem.residuals(x)
    for _ in range(ROUNDS):
        weights = [1 / (np.sqrt(inflation) * each) for each in scales]
        fit = least_squares(
            lambda y, w=weights: problem.weighed(y, w),
            x,
            x_scale=problem.beforehand,
            bounds=(problem.least, np.inf),
            loss="cauchy",
            ftol=1e-6,
            xtol=1e-6,
        )
        x, J, left = fit.x, fit.jac, problem.residuals(fit.x)
        scales = problem.scales(left)
        inflation = stays_alike(
            [np.clip(each / scale, -3, 3) for each, scale in zip(left, scales, strict=True)]
        )
    delays = problem.delays(x)
    return Found(
        motion=problem.motion(x, float(np.median(delays))),
        parameters=problem.described(x, np.linalg.inv(J.T @ J)),
        delays_s=dict(zip([run.name for run in runs], delays.tolist(), strict=True)),
        rms_m=float(np.sqrt((np.concatenate(left)[:, :3] ** 2).sum(axis=1).mean())),
    )


def stays_alike(left: Sequence[np.ndarray]) -> float:
    """How many residuals say as much as one: those near in time, and at one time in several runs.

    1 + 2 x the sum of autocorrelations up to the first below 0.05, times 1 + (runs - 1) x the mean
    correlation between runs.
    """
    shortest = min(len(each) for each in left)
    grid = np.stack([each[:shortest] for each in left])
    power, time = (grid**2).mean() + 1e-30, 1.0
    for lag in range(1, shortest // 2):
        rho = float((grid[:, lag:] * grid[:, :-lag]).mean() / power)
        if rho < 0.05:
            break
        time += 2 * rho
    others = len(grid) - 1
    between = (len(grid) * (grid.mean(axis=0) ** 2).mean() / power - 1) / max(1, others)
    return float(time * (1 + others * np.clip(between, 0.0, 1.0)))


class _Problem:
    """Unknowns in a row: base, tool (turn, then shift), zeros, compliance, delays."""

    def __init__(
        self, arm: Arm, runs: Sequence[Seen], T_frame_base: Float[np.ndarray, "4 4"]
    ) -> None:
        self._arm, self._runs, self._T_frame_base = arm, runs, T_frame_base
        self._delays = np.array([delay_of_turning(arm, run) for run in runs])
        first, n = runs[0], len(arm.joints)
        T = T_frame_base @ arm.T_base_hand(first.joints_at(first.seen_s[:1], self._delays[0])[0])
        self._T_hand_tool = se3.invert(T) @ first.Ts_frame_tool[len(first.seen_s) // 50]
        turn, shift = ("rad", BASE_RAD / 2), ("m", BASE_M / 2)
        self.rows = [
            *((f"base turn {axis}", BASE_RAD, *turn) for axis in "xyz"),
            *((f"base {axis}", BASE_M, *shift) for axis in "xyz"),
            *((f"tool turn {axis}", WIDE_RAD, *turn) for axis in "xyz"),
            *((f"tool {axis}", WIDE_M, *shift) for axis in "xyz"),
            *((f"zero of {joint}", ZERO_RAD, "rad", ZERO_RAD / 2) for joint in arm.joints),
            *(
                (f"compliance of {joint}", COMPLIANCE_RAD_NM, "rad/Nm", COMPLIANCE_RAD_NM / 2)
                for joint in arm.joints
            ),
            *((f"delay of {run.name}", DELAY_S, "s", KNOWN_S) for run in runs),
        ]
        self._parts = (12, 12 + n, 12 + 2 * n)
        self.beforehand = np.array([row[1] for row in self.rows])
        self.least = np.where([row[2] == "rad/Nm" for row in self.rows], -1e-9, -np.inf)
        self._hands = lru_cache(maxsize=4 * len(runs))(self._hands_of)
        self._speeds = [
            [
                np.linalg.norm(np.gradient(T[:, :3, 3], t, axis=0), axis=1),
                np.interp(t, *turning(T, t)),
            ]
            for T, t in ((run.Ts_frame_tool, run.seen_s) for run in runs)
        ]

    def delays(self, x: Numbers) -> Float[np.ndarray, " num_runs"]:
        return np.asarray(self._delays + x[self._parts[2] :])

    def motion(self, x: Numbers, delay_s: float) -> Motion:
        zeros, compliance = np.split(x, self._parts)[1:3]
        return Motion(
            T_frame_base=self._T_frame_base @ se3.small_motion(x[:6]),
            T_hand_tool=self._T_hand_tool @ se3.small_motion(x[6:12]),
            zeros_rad=zeros,
            compliance_rad_nm=compliance,
            delay_s=delay_s,
        )

    def _hands_of(self, index: int, joint_numbers: bytes, delay_s: float) -> Poses:
        x, run = np.append(np.zeros(12), np.frombuffer(joint_numbers)), self._runs[index]
        motion = self.motion(x, delay_s)
        return motion.Ts_frame_hand(self._arm, run.joints_at(run.seen_s, delay_s))

    def residuals(self, x: Numbers) -> list[np.ndarray]:
        """Of each run: shift [m] and turn [rad] from where the tool should be, in its frame."""
        numbers, left = x[12 : self._parts[2]].tobytes(), []
        T = self._T_frame_base
        base, tool = T @ se3.small_motion(x[:6]) @ se3.invert(T), se3.small_motion(x[6:12])
        for index, (run, delay_s) in enumerate(zip(self._runs, self.delays(x), strict=True)):
            hands = self._hands(index, numbers, float(delay_s))
            T = se3.invert(base @ hands @ self._T_hand_tool @ tool) @ run.Ts_frame_tool
            left.append(np.concatenate([T[:, :3, 3], se3.vector_from_rotation(T[:, :3, :3])], 1))
        return left

    def scales(self, left: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Spread of each residual: that of the slowest quarter, and how late it is times speed."""
        parts = []
        for k, part in enumerate((slice(0, 3), slice(3, 6))):
            square = np.concatenate([(each[:, part] ** 2).mean(axis=1) for each in left])
            speed = np.concatenate([each[k] for each in self._speeds])
            slow = speed <= np.quantile(speed, 0.25)
            rest = np.median(square[slow]) + LEAST**2
            late = np.median(square[~slow] / (speed[~slow] ** 2 + LEAST**2))
            parts.append([np.sqrt(rest + late * each[k] ** 2) for each in self._speeds])
        return [np.repeat(np.stack(pair, axis=1), 3, axis=1) for pair in zip(*parts, strict=True)]

    def weighed(
        self, x: Numbers, weights: Sequence[np.ndarray]
    ) -> Float[np.ndarray, " num_residuals"]:
        left = zip(self.residuals(x), weights, strict=True)
        return np.concatenate([*((each * w).ravel() for each, w in left), x / self.beforehand])

    def described(
        self, x: Numbers, covariance: Float[np.ndarray, "num_unknowns num_unknowns"]
    ) -> dict[str, dict[str, Any]]:
        sigma = np.sqrt(np.diag(covariance))
        alike = np.abs(covariance / np.outer(sigma, sigma) - np.eye(len(x)))
        values = x + np.append(np.zeros(self._parts[2]), self._delays)
        found = {}
        for index, (name, beforehand, unit, useful) in enumerate(self.rows):
            value, half = float(values[index]), Z_95 * float(sigma[index])
            partner, why = int(alike[index].argmax()), ""
            if abs(x[index]) > FAR * beforehand:
                why = "farther off than a description is: it takes up something else"
            elif sigma[index] > useful and alike[index, partner] > TOGETHER:
                why = f"only together with {self.rows[partner][0]}"
            elif sigma[index] > SAME * beforehand:
                why = "nothing that moves shows it"
            elif sigma[index] > useful:
                why = f"known to {half:.2g} {unit} only"
            ends = {"value": value, "low": value - half, "high": value + half}
            found[name] = {**ends, "unit": unit, "why": why}
        return found


def delay_of_turning(arm: Arm, run: Seen) -> float:
    """Delay [s] at which joints turn the hand as fast as the tool is seen to turn.

    How fast something turns does not depend on where base and tool are.
    """
    told = turning(np.array([arm.T_base_hand(q) for q in run.joints_rad]), run.times_s)
    seen_s, seen = turning(run.Ts_frame_tool, run.seen_s)
    if told[1].max() < 1e-2:
        raise UsageError(f"{run.name}: nothing turns. Move the arm by 20 degrees or more.")
    delays = np.arange(-LONGEST_DELAY_S, LONGEST_DELAY_S, 0.02)
    told_there = [np.interp(seen_s - d, *told, left=0.0, right=0.0) for d in delays]
    return float(delays[int(np.argmin(((np.array(told_there) - seen) ** 2).mean(axis=1)))])


def turning(Ts: Poses, stamps_s: Float[np.ndarray, " num_poses"]) -> tuple[np.ndarray, np.ndarray]:
    """How fast something turns [rad/s] from each pose to the next, and when [s]."""
    R = np.swapaxes(Ts[:-1, :3, :3], 1, 2) @ Ts[1:, :3, :3]
    speed = se3.rotation_angle_rad(R) / np.diff(stamps_s)
    return (stamps_s[1:] + stamps_s[:-1]) / 2, speed
