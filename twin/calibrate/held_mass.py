"""What joint efforts say of the weight in an arm's hand, from one motion.

Effort = inverse dynamics of the arm as described + bias and drift of each sensor + friction and
motor inertia of each joint + what the description is off (zeros of the joints; mass, centre and
inertia of the links) + a weight at the tool while something is held, all a little late. That is
linear in what is unknown, so all is fitted at once with normal priors: free motion tells the arm
from the weight, and what it leaves open widens the interval.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from twin.calibrate.motion import Z_95, stays_alike
from twin.errors import TwinError
from twin.robot.model import RobotModel, without_dynamics

STEP_S, SMOOTH_S = 0.02, 0.04
"""Spacing of what is compared, and spread of the Gaussian that smooths joints and efforts alike."""
OF_EFFORT = (0.05, 0.02, 0.2, 0.1, 0.02)
"""Standard deviations beforehand in parts of a joint's largest effort: of its sensor's bias, of
that one's drift, of dry friction, of friction a rad/s and of the motor's inertia."""
ZERO_RAD, LATE_S, LINK, CENTRE_M = 0.003, 0.01, 0.05, 0.01
"""Of the joints' zeros and of the efforts' delay; of each link's mass and inertia, in parts of
them, and of where its weight lies."""
MASS_KG, HAND_M, LEVER = 5.0, 0.05, 0.005
"""Of the weight, of where it lies from the tool along each axis, and of how long levers are, in
parts of them."""
CREEP_RAD_S = 0.01
"""A joint that is slower may be held by its dry friction, either way."""
TAILS, ROUNDS, LEAST_NM = 4, 8, 1e-3
T_COSTS = (TAILS + 3) / (TAILS + 1)
"""Degrees of freedom of Student's t, which residuals have: fingers touch things. Fits, each with
weights from the residuals before; no joint is believed better than this. How much less such
residuals say than normal ones of their spread."""
FEWEST, SLOWEST_S = 20, 0.05
"""Samples of free motion, and with the weight; longest time between two readings."""
ALIKE = (0.7, 1.4)
"""Times what the description says; other efforts have another unit, sign or meaning."""
KNOWN, KNOWN_KG = 0.2, 0.02
"""Half of an interval, in parts of the mass or at least this, above which it is not determined."""

Rows = Float[np.ndarray, "_ num_joints"]
Which = Bool[np.ndarray, " _"]


class NoWeightError(TwinError):
    """Efforts do not say what is held; the message says why."""


@dataclass(frozen=True)
class Weight:
    """What is held, with half of each 95 % interval."""

    mass_kg: float
    half_kg: float
    centre_m: tuple[float, ...]
    """From the tool centre point, along its axes."""
    centre_half_m: tuple[float, ...]


@dataclass(frozen=True)
class Moved:
    """Joints of an arm and their efforts, ``STEP_S`` apart and smoothed alike."""

    times_s: Float[np.ndarray, " num_samples"]
    joints: tuple[Rows, Rows, Rows]
    """Positions, speeds and accelerations."""
    efforts_Nm: Rows
    changes: Rows
    """Of efforts, per second."""


def smoothed(times_s: Float[np.ndarray, " num_readings"], joints_rad: Rows, efforts: Rows) -> Moved:
    """Bring readings of an arm onto an even grid; raises NoWeightError where that cannot be."""
    if not np.isfinite(efforts).all():
        raise NoWeightError("efforts are no numbers")
    if np.ptp(efforts, axis=0).max(initial=0.0) < LEAST_NM:
        raise NoWeightError("efforts do not change: nobody measured them")
    step_s = float(np.median(np.diff(times_s)))
    if not 0 < step_s <= SLOWEST_S:
        raise NoWeightError(f"joints are read every {step_s:.2g} s only")
    even_s = np.arange(times_s[0], times_s[-1], step_s)

    def even(rows: Rows) -> Rows:
        columns = [np.interp(even_s, times_s, column) for column in rows.T]
        return np.asarray(gaussian_filter1d(np.stack(columns, axis=1), SMOOTH_S / step_s, axis=0))

    q, tau = even(joints_rad), even(efforts)
    v, changes = np.gradient(q, step_s, axis=0), np.gradient(tau, step_s, axis=0)
    a = np.gradient(v, step_s, axis=0)
    kept = slice(None, None, max(1, round(STEP_S / step_s)))
    return Moved(even_s[kept], (q[kept], v[kept], a[kept]), tau[kept], changes[kept])


def weight_of(robot: RobotModel, moved: Moved, free: Which, held: Which) -> Weight:
    """Find what is held in some samples, given others in which the arm moves freely.

    Raises NoWeightError, with the reason, where it is not determined.
    """
    lacking = next(without_dynamics(robot), "")
    if lacking:
        raise NoWeightError(f"the robot's description gives {lacking}")
    if min(free.sum(), held.sum()) < FEWEST:
        raise NoWeightError("too little free motion, or too little with it in the hand")
    fit = _Regression(robot, moved, np.flatnonzero(free | held), held)
    _refuse_other_efforts(fit.described[free[free | held]], moved.efforts_Nm[free])
    x, covariance = fit.solve()
    mass_kg, spread = float(x[-4]), np.sqrt(np.diag(covariance)[-4:])
    half_kg = Z_95 * float(np.hypot(spread[0], LEVER * mass_kg))
    if mass_kg - half_kg <= 0:
        raise NoWeightError(f"nothing that weighs is held: {mass_kg:.3f} +- {half_kg:.3f} kg")
    if half_kg > max(KNOWN * mass_kg, KNOWN_KG):
        raise NoWeightError(f"known to {half_kg:.2g} kg only: {mass_kg:.3f} kg")
    centre, halves = x[-3:] / mass_kg, Z_95 * spread[1:] / mass_kg
    return Weight(mass_kg, half_kg, tuple(centre.tolist()), tuple(halves.tolist()))


def _refuse_other_efforts(described: Rows, measured: Rows) -> None:
    """An arm's own weight is in its efforts, in Nm and with the sign of its joints."""
    power = (described**2).sum(axis=0)
    each = (measured * described).sum(axis=0) / (power + LEAST_NM)
    times = float(np.average(each, weights=power))
    turned = np.flatnonzero((each < -ALIKE[0]) & (power > 0.05 * power.max()))
    if len(turned):
        numbers = ", ".join(str(index + 1) for index in turned)
        raise NoWeightError(f"efforts have the other sign at joint {numbers}")
    if not ALIKE[0] <= times <= ALIKE[1]:
        words = "another unit than Nm, or without the arm's own weight"
        raise NoWeightError(f"efforts are {times:.3g} times the described arm's: {words}")


class _Regression:
    """Unknowns: five numbers a joint, zeros, delay, ten numbers a link, mass and mass x centre."""

    def __init__(self, robot: RobotModel, moved: Moved, ids: np.ndarray, held: Which) -> None:
        model, data, at = robot.model, robot.model.createData(), robot.arm_velocity_ids
        links = [model.getJointId(name) for name in robot.joints]
        tool, count = model.frames[robot.tcp_id], len(at)
        last = 10 * (tool.parentJoint - 1)
        to_link = np.zeros((10, 4))  # mass and mass x centre at the tool, as the link's numbers
        ball = pin.Inertia(1.0, tool.placement.translation, np.zeros((3, 3)))
        to_link[:, 0] = ball.toDynamicParameters()
        to_link[1:4, 1:] = tool.placement.rotation
        q, v, a = (rows[ids] for rows in moved.joints)
        speed, rise = np.zeros(model.nv), np.zeros(model.nv)
        time = np.linspace(-0.5, 0.5, len(moved.times_s))[ids]
        self.slow = 1 - np.abs(np.tanh(v / CREEP_RAD_S))
        self.described, matrices, one = np.zeros_like(q), [], np.eye(count)
        for row, index in enumerate(ids.tolist()):
            speed[at], rise[at] = v[row], a[row]
            posture = robot.configuration(q[row])
            self.described[row] = pin.rnea(model, data, posture, speed, rise)[at]
            by_link = pin.computeJointTorqueRegressor(model, data, posture, speed, rise)[at]
            zeros = pin.computeRNEADerivatives(model, data, posture, speed, rise)[0]
            sensors = (one, one * time[row], np.diag(np.tanh(v[row] / CREEP_RAD_S)))
            motors = (np.diag(v[row]), np.diag(a[row]), zeros[np.ix_(at, at)])
            own = [by_link[:, 10 * (link - 1) : 10 * link] for link in links]
            weight = held[index] * by_link[:, last : last + 10] @ to_link
            late = moved.changes[index][:, None]
            matrices.append(np.concatenate([*sensors, *motors, late, *own, weight], axis=1))
        self._X = np.array(matrices)
        self._y = moved.efforts_Nm[ids] - self.described
        most = model.effortLimit[at]
        parts = [share * most for share in OF_EFFORT]
        parts += [np.full(count, ZERO_RAD), np.array([LATE_S])]
        for link in links:
            mass, turning = model.inertias[link].mass, np.trace(model.inertias[link].inertia)
            parts.append(np.repeat([LINK * mass, CENTRE_M * mass, LINK * turning], (1, 3, 6)))
        self._beforehand = np.concatenate([*parts, [MASS_KG, *[HAND_M * MASS_KG] * 3]])
        self._dry = slice(2 * count, 3 * count)

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers and their covariance: iterated weights, residuals near in time counted once."""
        X, y, width = self._X, self._y, self._X.shape[2]
        spread, left = np.maximum(y.std(axis=0), LEAST_NM), np.zeros_like(y)
        stuck, alike = np.zeros(y.shape[1]), 1.0
        x, covariance = np.zeros(width), np.eye(width)
        for _ in range(ROUNDS):
            square = spread**2 + (self.slow * stuck) ** 2
            noise = np.sqrt(alike * square * (TAILS + left**2 / square) / (TAILS + 1))
            rows, values = (X / noise[:, :, None]).reshape(-1, width), (y / noise).ravel()
            covariance = np.linalg.inv(rows.T @ rows + np.diag(self._beforehand**-2.0))
            x = covariance @ (rows.T @ values)
            left, stuck = y - X @ x, np.abs(x[self._dry])
            spread = np.maximum(1.4826 * np.median(np.abs(left), axis=0), LEAST_NM)
            square = spread**2 + (self.slow * stuck) ** 2
            alike = stays_alike([np.clip(left / np.sqrt(square), -3, 3)])
            fitted = width - float((np.diag(covariance) * self._beforehand**-2.0).sum())
            alike *= T_COSTS / max(1 - fitted * alike / y.size, 0.1)
            self._beforehand[-3:] = HAND_M * max(x[-4], KNOWN_KG)
        return x, covariance
