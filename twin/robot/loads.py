"""Inverse dynamics of an arm, alone and with what it holds at its tool."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from twin.robot.model import RobotModel

Times = Float[np.ndarray, " _"]
Rows = Float[np.ndarray, "_ _"]
NAMES = ("tool_speed_m_s", "elbow_speed_m_s", "momentum_kg_m_s", "power_W")
"""The settings of a robot file that limit what ``Loads`` finds."""


@dataclass(frozen=True, kw_only=True)
class Load:
    """What may be in the hand while the fingers are closed."""

    name: str
    mass_kg: float
    start_ns: int
    end_ns: int


class Loads:
    """Inverse dynamics of an arm, alone and with what it holds at its tool."""

    def __init__(self, robot: RobotModel, held: Sequence[Load]) -> None:
        """Take the arm alone, and once more with each load."""
        self._robot, self._held = robot, held
        self._elbow = robot.model.getJointId(robot.joints[(len(robot.joints) - 1) // 2])
        self._arms, tool = {0.0: robot.model}, robot.model.frames[robot.tcp_id]
        for mass_kg in {item.mass_kg for item in held if item.mass_kg > 0}:
            self._arms[mass_kg] = robot.model.copy()
            ball = pin.Inertia.FromSphere(mass_kg, 0.03)
            self._arms[mass_kg].appendBodyToJoint(tool.parentJoint, ball, tool.placement)
        self._data = {mass: model.createData() for mass, model in self._arms.items()}

    def along(
        self, times_s: Times, joints: Rows, speeds: Rows, accelerations: Rows
    ) -> dict[str, Any]:
        """Torques of the joints, and by the name of each setting what it limits."""
        robot = self._robot
        ids = robot.arm_velocity_ids
        masses = np.zeros(len(times_s))
        for item in self._held:
            during = (times_s >= item.start_ns * 1e-9) & (times_s <= item.end_ns * 1e-9)
            masses[during] = item.mass_kg
        v, a = np.zeros(robot.model.nv), np.zeros(robot.model.nv)
        torques, rows = np.zeros_like(joints), np.zeros((len(times_s), 4))
        for index, mass in enumerate(masses.tolist()):
            model, data = self._arms[mass], self._data[mass]
            q = robot.configuration(joints[index])
            v[ids], a[ids] = speeds[index], accelerations[index]
            pin.computeCentroidalMomentum(model, data, q, v)
            tool = pin.getFrameVelocity(model, data, robot.tcp_id, pin.LOCAL_WORLD_ALIGNED)
            elbow = pin.getVelocity(model, data, self._elbow, pin.LOCAL_WORLD_ALIGNED)
            torques[index] = pin.rnea(model, data, q, v, a)[ids]
            power = float(np.maximum(torques[index] * speeds[index], 0.0).sum())
            vectors = (tool.linear, elbow.linear, data.hg.linear)
            rows[index] = *(float(np.linalg.norm(each)) for each in vectors), power
        return {"torques": torques, **dict(zip(NAMES, rows.T, strict=True))}
