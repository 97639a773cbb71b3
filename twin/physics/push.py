"""A hand whose motion is given pushes a box across a table, in PyBullet.

The hand's hulls are put where they were measured at every step and have the measured velocity, at
a mass beside which that of the box is nothing: contact and friction meet a body that moves as
measured, whatever it pushes. Engine settings and friction anchors are those of ``World``.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from twin.physics.config import PhysicsConfig
from twin.physics.engine import pybullet
from twin.physics.world import TABLE_M, Bodies

_HAND_MASS_KG = 1e4


class PushWorld(Bodies):
    """One box on a table and the hulls of a hand. A context manager."""

    def __init__(
        self,
        config: PhysicsConfig,
        *,
        hulls_m: Sequence[Float[np.ndarray, "num_points 3"]],
        size_m: Float[np.ndarray, "3"],
        mass_kg: float,
        T_world_box: Float[np.ndarray, "4 4"],
        table_height_m: float,
    ) -> None:
        """Put table, box and hand into an empty world."""
        super().__init__(config)
        T_table, away = np.eye(4), np.eye(4)
        T_table[2, 3], away[2, 3] = table_height_m - TABLE_M[2] / 2, 10.0
        table = self._box(np.array(TABLE_M), 0.0, T_table)
        self._set_friction(table, config.surface_friction)
        self._object = self._box(size_m, mass_kg, T_world_box)
        self._set_friction(self._object, config.object_friction)
        self._undamp(self._object)
        self._anchors.add(self._object)
        self._hand: list[int] = []
        for points_m in hulls_m:
            shape = self.client.createCollisionShape(pybullet.GEOM_MESH, vertices=points_m.tolist())
            body = self._body(shape, _HAND_MASS_KG, away)
            self._set_friction(body, config.finger_friction)
            self._undamp(body)
            for other in (table, *self._hand):
                self.client.setCollisionFilterPair(body, other, -1, -1, 0)
            self._hand.append(body)

    def step(
        self,
        p_hand_m: Float[np.ndarray, "3"],
        q_hand_wxyz: Float[np.ndarray, "4"],
        velocity_m_s: Float[np.ndarray, "3"],
        turning_rad_s: Float[np.ndarray, "3"],
    ) -> Float[np.ndarray, "7"]:
        """Advance by one step from a pose of the hand; returns the box: position [m], wxyz."""
        w, x, y, z = q_hand_wxyz.tolist()
        position, orientation = p_hand_m.tolist(), [x, y, z, w]
        velocity = velocity_m_s.tolist()
        velocity[2] += self.config.gravity_m_s2 / self.config.rate_hz  # which the step takes away
        turning = turning_rad_s.tolist()
        for body in self._hand:
            self.client.resetBasePositionAndOrientation(body, position, orientation)
            self.client.resetBaseVelocity(body, velocity, turning)
        self._anchors.refresh()
        self.client.stepSimulation()
        p, (x, y, z, w) = self.client.getBasePositionAndOrientation(self._object)
        return np.array([*p, w, x, y, z])
