"""A cell's controller in the twin: how late, how softly and how fast it follows what it is sent.

Joints follow targets that are a delay old, each with a lag of the first order, and pull like
springs: an arm that is pressed gives way. Fingers begin after a delay and go at one speed.
``twin.policies.identify`` finds the numbers in recorded trials.
"""

import math
from collections import deque
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from twin.robot.model import RobotModel

FINGERS_S = 0.04
"""The twin's own fingers are so far behind a command that moves."""


@dataclass(frozen=True, kw_only=True)
class Response:
    """How a controller follows its targets; by itself at once and stiffly."""

    delay_s: float = 0.0
    lags_s: tuple[float, ...] = ()
    """Of each joint; empty: none."""
    stiffness_Nm_rad: tuple[float, ...] = ()
    """Of each joint, infinite where nobody knows; empty: of all."""
    grip_delay_s: float = 0.0
    grip_speed_m_s: float = math.inf
    """Of the distance between the pads."""

    def to_record(self) -> dict[str, Any]:
        """For JSON, which has no infinity."""
        stiffness = [k if math.isfinite(k) else None for k in self.stiffness_Nm_rad]
        speed_m_s = self.grip_speed_m_s if math.isfinite(self.grip_speed_m_s) else None
        return asdict(self) | {
            "lags_s": list(self.lags_s),
            "stiffness_Nm_rad": stiffness,
            "grip_speed_m_s": speed_m_s,
        }

    def describe(self) -> str:
        """In a line."""
        if not self.lags_s:
            return "the arm follows at once: no trial says what the controller was sent"
        soft = [k for k in self.stiffness_Nm_rad if math.isfinite(k)]
        gives = f", {len(soft)} joints give way" if soft else ""
        return (
            f"the arm follows after {1e3 * self.delay_s:.0f} ms with lags of "
            f"{1e3 * min(self.lags_s):.0f} to {1e3 * max(self.lags_s):.0f} ms{gives}; the "
            f"fingers after {1e3 * self.grip_delay_s:.0f} ms at {self.grip_speed_m_s:.2g} m/s, as "
            "the cell's"
        )


AT_ONCE = Response()


class Controller:
    """What the motors are told, step by step."""

    def __init__(
        self,
        response: Response,
        joints_rad: Float[np.ndarray, " num_joints"],
        width_m: float,
        rate_hz: int,
    ) -> None:
        """Rest in a posture."""
        late = round(response.delay_s * rate_hz) + 1
        grips_late = round(max(0.0, response.grip_delay_s - FINGERS_S) * rate_hz) + 1
        self._sent = deque([joints_rad] * late, maxlen=late)
        self._widths = deque([width_m] * grips_late, maxlen=grips_late)
        self._lags_s = np.array(response.lags_s or (0.0,) * len(joints_rad))
        with np.errstate(divide="ignore"):
            self._share = -np.expm1(-1.0 / (rate_hz * self._lags_s))
        self._stiffness = np.array(response.stiffness_Nm_rad)
        self._most_m = response.grip_speed_m_s / rate_hz
        self._rate_hz = rate_hz
        self._seen_rad = self.joints_rad = joints_rad
        self.velocity_rad_s = np.zeros_like(joints_rad)
        self.width_m = width_m

    def step(self, joints_rad: Float[np.ndarray, " num_joints"], width_m: float) -> None:
        """One period on, with what is sent now."""
        self._sent.append(joints_rad)
        self._widths.append(width_m)
        step_rad = self._share * (self._sent[0] - self.joints_rad)
        self.joints_rad = self.joints_rad + step_rad
        self.velocity_rad_s = step_rad * self._rate_hz
        way_m = self._widths[0] - self.width_m
        self.width_m += min(max(way_m, -self._most_m), self._most_m)

    @property
    def is_soft(self) -> bool:
        """Whether its motors give way before they are at their end."""
        return bool(np.isfinite(self._stiffness).any())

    def strength_Nm(
        self, seen_rad: Float[np.ndarray, " num_joints"]
    ) -> Float[np.ndarray, " num_joints"]:
        """What its springs pull with, at most: from where the joints are seen in each period.

        The spring's torque and the damper's that makes the lag, both as if they pulled one way: at
        rest that is the spring's, and an arm that moves can brake.
        """
        speed_rad_s = np.abs(seen_rad - self._seen_rad) * self._rate_hz
        self._seen_rad = seen_rad
        off_rad = np.abs(self._sent[0] - seen_rad) + self._lags_s * speed_rad_s
        stiff = np.isinf(self._stiffness)
        return np.where(stiff, np.inf, np.where(stiff, 0.0, self._stiffness) * off_rad)


def carrying_Nm(
    robot: RobotModel, joints_rad: Float[np.ndarray, " num_joints"]
) -> Float[np.ndarray, " num_joints"]:
    """Torques that carry the arm's own weight."""
    data, q = robot.model.createData(), robot.configuration(joints_rad)
    return np.array(pin.computeGeneralizedGravity(robot.model, data, q)[robot.arm_velocity_ids])


def largest_Nm(robot: RobotModel) -> Float[np.ndarray, " num_joints"]:
    """The motors' largest torques."""
    return np.array(robot.model.effortLimit[robot.arm_velocity_ids])
