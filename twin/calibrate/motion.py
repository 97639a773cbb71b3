"""What the motion of a tool, seen from outside, says of the arm that moved it.

tool(t) = T_frame_base x kinematics(q + zeros - compliance x gravity(q)) x T_hand_tool, with the
joints q at t - delay. All runs share base, zeros, compliance and tool; each has a delay of its own.
Unknowns are fitted together with normal priors about the description (least squares), so what the
motion does not show stays there, and its interval says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from bridge.errors import UsageError
from bridge.geometry import se3

AXES = ("x", "y", "z")
BASE_M, BASE_RAD = 0.03, float(np.deg2rad(3.0))
ZERO_RAD = float(np.deg2rad(2.0))
COMPLIANCE_RAD_NM = 0.005
WIDE_M, WIDE_RAD, DELAY_S = 1.0, 3.0, 2.0
"""Standard deviations beforehand; the wide ones hold nothing."""
KNOWN_S = 0.05
"""A delay that is known no better is not determined."""
RATE_HZ = 5.0
"""Poses that are compared."""
LONGEST_DELAY_S, DELAY_STEP_S, TURN_S = 4.0, 0.02, 0.2
ROUNDS = 3
"""Fits, each with weights from the residuals of the one before."""
FIRST = (0.005,) * 3 + (0.01,) * 3
"""Spread of residuals in the first of them [m, rad]."""
LEAST = 1e-5
FAR, SAME, TOGETHER = 3.0, 0.95, 0.3
"""A number farther off than so many standard deviations beforehand is not believed; one that is
known no better than this share of them was not seen; correlation from which another is named."""
Z_95 = 1.96
Poses = Float[np.ndarray, "num_poses 4 4"]
Joints = Float[np.ndarray, "num_poses num_joints"]
Numbers = Float[np.ndarray, " num_unknowns"]


class StillMotionError(UsageError):
    """Nothing moves, so nothing can be learned from its motion."""


@dataclass(frozen=True)
class Arm:
    """What a description says of an arm up to its hand."""

    joints: tuple[str, ...]
    T_base_hand: Callable[[Float[np.ndarray, " num_joints"]], Float[np.ndarray, "4 4"]]
    gravity_nm: Callable[[Float[np.ndarray, " num_joints"]], Float[np.ndarray, " num_joints"]]
    """Torque with which each joint holds the arm."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """One motion: joints on one clock, poses of the tool on another."""

    name: str
    times_s: Float[np.ndarray, " num_samples"]
    joints_rad: Float[np.ndarray, "num_samples num_joints"]
    seen_s: Float[np.ndarray, " num_poses"]
    Ts_frame_tool: Poses

    def joints_at(self, seen_s: Float[np.ndarray, " num_poses"], delay_s: float) -> Joints:
        """Joints that are seen at some instants; before and after, those at the ends."""
        at_s = seen_s - delay_s
        return np.stack([np.interp(at_s, self.times_s, q) for q in self.joints_rad.T], axis=1)

    def thinned(self) -> "Seen":
        """At most ``RATE_HZ`` poses a second."""
        wanted = np.arange(self.seen_s[0], self.seen_s[-1], 1 / RATE_HZ)
        ids = np.unique(np.searchsorted(self.seen_s, wanted))
        return Seen(
            **{**vars(self), "seen_s": self.seen_s[ids], "Ts_frame_tool": self.Ts_frame_tool[ids]}
        )


@dataclass(frozen=True, kw_only=True)
class Motion:
    """An arm as it was seen to move."""

    T_frame_base: Float[np.ndarray, "4 4"]
    T_hand_tool: Float[np.ndarray, "4 4"]
    zeros_rad: Float[np.ndarray, " num_joints"]
    compliance_rad_nm: Float[np.ndarray, " num_joints"]
    delay_s: float
    """By how much later than the joints the tool is seen; the median of several runs."""

    def Ts_frame_hand(self, arm: Arm, joints_rad: Joints) -> Poses:
        """Where the hand is at some joints."""
        return np.asarray(self.T_frame_base @ _hands(arm, self, joints_rad))

    def to_record(self) -> dict[str, Any]:
        """Plain numbers."""
        return {
            "T_frame_base": se3.pose_record(self.T_frame_base),
            "T_hand_tool": se3.pose_record(self.T_hand_tool),
            "zeros_rad": self.zeros_rad.tolist(),
            "compliance_rad_nm": self.compliance_rad_nm.tolist(),
            "delay_s": self.delay_s,
        }

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> "Motion":
        """Read plain numbers."""
        return Motion(
            T_frame_base=se3.pose_from_record(record["T_frame_base"]),
            T_hand_tool=se3.pose_from_record(record["T_hand_tool"]),
            zeros_rad=np.array(record["zeros_rad"], dtype=float),
            compliance_rad_nm=np.array(record["compliance_rad_nm"], dtype=float),
            delay_s=float(record["delay_s"]),
        )


def _hands(arm: Arm, motion: Motion, joints_rad: Joints) -> Poses:
    sag = motion.compliance_rad_nm * np.array([arm.gravity_nm(q) for q in joints_rad])
    return np.array([arm.T_base_hand(q) for q in joints_rad + motion.zeros_rad - sag])


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One number with its interval; ``why`` is empty where the motion determines it."""

    value: float
    low: float
    high: float
    unit: str
    why: str = ""


@dataclass(frozen=True, kw_only=True)
class Found:
    """What some runs say."""

    motion: Motion
    parameters: Mapping[str, Parameter]
    """By name; lengths and angles are from where the description has things."""
    delays_s: Mapping[str, float]
    rms_m: float
    rms_rad: float


def find_motion(
    arm: Arm,
    runs: Sequence[Seen],
    T_frame_base: Float[np.ndarray, "4 4"],
    base_m: float = BASE_M,
    base_rad: float = BASE_RAD,
) -> Found:
    """Fit base, tool, zeros, compliance and delays to what was seen of the tool.

    Args:
        T_frame_base: Where the description has the base, known to ``base_m`` and ``base_rad``.
    """
    problem = _Problem(arm, [run.thinned() for run in runs], T_frame_base, base_m, base_rad)
    x, left, scales, inflation = problem.start(), [], problem.first_scales(), 1.0
    J = np.zeros((0, len(x)))
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
        scales = problem.scales(x, left)
        inflation = stays_alike(
            [np.clip(each / scale, -3, 3) for each, scale in zip(left, scales, strict=True)]
        )
    covariance, every = np.linalg.inv(J.T @ J), np.concatenate(left)
    return Found(
        motion=problem.motion(x, float(np.median(problem.delays(x)))),
        parameters=problem.described(x, covariance),
        delays_s=dict(zip([run.name for run in runs], problem.delays(x).tolist(), strict=True)),
        rms_m=float(np.sqrt((every[:, :3] ** 2).sum(axis=1).mean())),
        rms_rad=float(np.sqrt((every[:, 3:] ** 2).sum(axis=1).mean())),
    )


def stays_alike(left: Sequence[np.ndarray]) -> float:
    """How many residuals say as much as one: those near in time, and at one time in several runs.

    1 + 2 x the sum of autocorrelations up to the first below 0.05, times 1 + (runs - 1) x the mean
    correlation between runs.
    """
    shortest = min(len(each) for each in left)
    grid = np.stack([each[:shortest] for each in left])
    power = (grid**2).mean() + 1e-30
    time = 1.0
    for lag in range(1, shortest // 2):
        rho = float((grid[:, lag:] * grid[:, :-lag]).mean() / power)
        if rho < 0.05:
            break
        time += 2 * rho
    count = len(grid)
    between = (count * (grid.mean(axis=0) ** 2).mean() / power - 1) / max(1, count - 1)
    return float(time * (1 + (count - 1) * np.clip(between, 0.0, 1.0)))


class _Problem:
    """Unknowns in a row: base, tool (turn, then shift), zeros, compliance, delays."""

    def __init__(
        self,
        arm: Arm,
        runs: Sequence[Seen],
        T_frame_base: Float[np.ndarray, "4 4"],
        base_m: float,
        base_rad: float,
    ) -> None:
        self._arm, self._runs, self._T_frame_base = arm, runs, T_frame_base
        self._n = len(arm.joints)
        delays = [delay_of_turning(arm, run) for run in runs]
        self._delays = np.array(delays)
        first = runs[0]
        T = T_frame_base @ arm.T_base_hand(first.joints_at(first.seen_s[:1], delays[0])[0])
        self._T_hand_tool = se3.invert(T) @ _middle(first.Ts_frame_tool[: round(RATE_HZ)])
        n, axes = self._n, [f"{axis}" for axis in AXES]
        rows = [(f"base turn {a}", "rad", base_rad, BASE_RAD / 2) for a in axes]
        rows += [(f"base {a}", "m", base_m, BASE_M / 2) for a in axes]
        rows += [(f"tool turn {a}", "rad", WIDE_RAD, BASE_RAD / 2) for a in axes]
        rows += [(f"tool {a}", "m", WIDE_M, BASE_M / 2) for a in axes]
        rows += [(f"zero of {joint}", "rad", ZERO_RAD, ZERO_RAD / 2) for joint in arm.joints]
        rows += [
            (f"compliance of {joint}", "rad/Nm", COMPLIANCE_RAD_NM, COMPLIANCE_RAD_NM / 2)
            for joint in arm.joints
        ]
        rows += [(f"delay of {run.name}", "s", DELAY_S, KNOWN_S) for run in runs]
        self._rows = rows
        self.beforehand = np.array([row[2] for row in rows])
        self._split = 12 + 2 * n
        self.least = np.where(["Nm" in row[1] for row in rows], -1e-9, -np.inf)
        self._hand_poses = lru_cache(maxsize=4 * len(runs))(self._hands)

    def start(self) -> Numbers:
        return np.zeros(len(self._rows))

    def delays(self, x: Numbers) -> Float[np.ndarray, " num_runs"]:
        return np.asarray(self._delays + x[self._split :])

    def motion(self, x: Numbers, delay_s: float) -> Motion:
        n = self._n
        return Motion(
            T_frame_base=self._T_frame_base @ _small(x[:6]),
            T_hand_tool=self._T_hand_tool @ _small(x[6:12]),
            zeros_rad=x[12 : 12 + n],
            compliance_rad_nm=x[12 + n : 12 + 2 * n],
            delay_s=delay_s,
        )

    def _hands(self, index: int, numbers: tuple[float, ...], delay_s: float) -> Poses:
        run = self._runs[index]
        motion = self.motion(np.array((0.0,) * 12 + numbers), delay_s)
        return _hands(self._arm, motion, run.joints_at(run.seen_s, delay_s))

    def residuals(self, x: Numbers) -> list[np.ndarray]:
        """Of each run: shift [m] and turn [rad] from where the tool should be, in its frame."""
        motion, numbers = self.motion(x, 0.0), tuple(x[12 : self._split].tolist())
        left = []
        for index, (run, delay_s) in enumerate(zip(self._runs, self.delays(x), strict=True)):
            hands = self._hand_poses(index, numbers, float(delay_s))
            T = se3.invert(motion.T_frame_base @ hands @ motion.T_hand_tool) @ run.Ts_frame_tool
            left.append(np.concatenate([T[:, :3, 3], se3.vector_from_rotation(T[:, :3, :3])], 1))
        return left

    def first_scales(self) -> list[np.ndarray]:
        return [np.tile(FIRST, (len(run.seen_s), 1)) for run in self._runs]

    def scales(self, x: Numbers, left: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Spread of each residual: that of the slowest quarter, and how late it is times speed."""
        parts = []
        for k in (slice(0, 3), slice(3, 6)):
            squares = [(each[:, k] ** 2).mean(axis=1) for each in left]
            speeds = [self._speed(index, x, k) for index in range(len(left))]
            square, speed = np.concatenate(squares), np.concatenate(speeds)
            slow = speed <= np.quantile(speed, 0.25)
            still = np.median(square[slow]) + LEAST**2
            late = np.median(square[~slow] / (speed[~slow] ** 2 + LEAST**2))
            parts.append([np.sqrt(still + late * each**2) for each in speeds])
        return [np.repeat(np.stack(pair, axis=1), 3, axis=1) for pair in zip(*parts, strict=True)]

    def _speed(self, index: int, x: Numbers, k: slice) -> Float[np.ndarray, " num_poses"]:
        """How fast the hand moves [m/s] or turns [rad/s] where each pose was seen."""
        delay_s = float(self.delays(x)[index])
        numbers = tuple(x[12 : self._split].tolist())
        later, before = (self._hand_poses(index, numbers, delay_s + d) for d in (-0.05, 0.05))
        T = se3.invert(before) @ later
        way = T[:, :3, 3] if k.start == 0 else se3.vector_from_rotation(T[:, :3, :3])
        return np.asarray(np.linalg.norm(way, axis=1) / 0.1)

    def weighed(
        self, x: Numbers, weights: Sequence[np.ndarray]
    ) -> Float[np.ndarray, " num_residuals"]:
        left = self.residuals(x)
        every = [(each * w).ravel() for each, w in zip(left, weights, strict=True)]
        return np.concatenate([*every, x / self.beforehand])

    def described(
        self, x: Numbers, covariance: Float[np.ndarray, "num_unknowns num_unknowns"]
    ) -> dict[str, Parameter]:
        sigma = np.sqrt(np.diag(covariance))
        alike = np.abs(covariance / np.outer(sigma, sigma) - np.eye(len(x)))
        values = x + np.append(np.zeros(self._split), self._delays)
        found = {}
        for index, (name, unit, beforehand, useful) in enumerate(self._rows):
            value, half = float(values[index]), Z_95 * float(sigma[index])
            partner, why = int(alike[index].argmax()), ""
            if abs(x[index]) > FAR * beforehand:
                why = "farther off than a description is: it takes up something else"
            elif sigma[index] > useful and alike[index, partner] > TOGETHER:
                why = f"only together with {self._rows[partner][0]}"
            elif sigma[index] > SAME * beforehand:
                why = "nothing that moves shows it"
            elif sigma[index] > useful:
                why = f"known to {half:.2g} {unit} only"
            found[name] = Parameter(
                value=value, low=value - half, high=value + half, unit=unit, why=why
            )
        return found


def delay_of_turning(arm: Arm, run: Seen) -> float:
    """Delay [s] at which joints turn the hand as fast as the tool is seen to turn.

    How fast something turns does not depend on where base and tool are.
    """
    at_s = np.arange(run.seen_s[0] + TURN_S, run.seen_s[-1], DELAY_STEP_S)
    seen = _turning(run.Ts_frame_tool, run.seen_s, at_s)
    longest = LONGEST_DELAY_S
    told_s = np.arange(at_s[0] - longest, at_s[-1] + longest, DELAY_STEP_S)
    hands = np.array([arm.T_base_hand(q) for q in run.joints_at(told_s, 0.0)])
    told = _turning(hands, told_s, told_s)
    if max(seen.max(), told.max()) < 1e-3 or told.max() < 1e-3:
        message = f"{run.name}: nothing turns. Move the arm by 20 degrees or more."
        raise StillMotionError(message)
    delays = np.arange(-longest, longest, DELAY_STEP_S)
    costs = [float(((seen - np.interp(at_s - d, told_s, told)) ** 2).mean()) for d in delays]
    return float(delays[int(np.argmin(costs))])


def _turning(
    Ts: Poses, stamps_s: Float[np.ndarray, " num_poses"], at_s: Float[np.ndarray, " num_times"]
) -> Float[np.ndarray, " num_times"]:
    """Angle turned within ``TURN_S`` before each of some instants."""
    now = np.clip(np.searchsorted(stamps_s, at_s), 0, len(Ts) - 1)
    before = np.clip(np.searchsorted(stamps_s, at_s - TURN_S), 0, len(Ts) - 1)
    R = np.swapaxes(Ts[before, :3, :3], 1, 2) @ Ts[now, :3, :3]
    return np.asarray(se3.rotation_angle_rad(R))


def _middle(Ts: Poses) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, 3] = np.median(Ts[:, :3, 3], axis=0)
    T[:3, :3] = se3.nearest_rotation(Ts[:, :3, :3].mean(axis=0))
    return T


def _small(numbers: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(numbers[:3])
    T[:3, 3] = numbers[3:]
    return T
