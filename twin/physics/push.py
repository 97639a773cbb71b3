"""A hand whose motion is given pushes a box across a table, in PyBullet.

The hand's hulls are put where they were measured at every step and have the measured velocity, at
a mass beside which that of the box is nothing: contact and friction meet a body that moves as
measured, whatever it pushes. Engine settings and friction anchors are those of ``World``.
"""

from collections.abc import Sequence
from types import TracebackType

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.physics.config import PhysicsConfig
from twin.physics.engine import give_client_back, open_client, pybullet
from twin.physics.world import FrictionAnchors

_HAND_MASS_KG = 1e4
_TABLE_M = (4.0, 4.0, 0.4)


class PushWorld:
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
        self._config = config
        self._client = open_client(config)
        T_table = np.eye(4)
        T_table[2, 3] = table_height_m - _TABLE_M[2] / 2
        table = self._body(self._box(np.array(_TABLE_M)), 0.0, T_table, config.surface_friction)
        self._object = self._body(self._box(size_m), mass_kg, T_world_box, config.object_friction)
        self._anchors = FrictionAnchors(self._client)
        self._anchors.add(self._object)
        away = np.eye(4)
        away[2, 3] = 10.0
        self._hand = [
            self._body(self._hull(points), _HAND_MASS_KG, away, config.finger_friction)
            for points in hulls_m
        ]
        for index, body in enumerate(self._hand):
            for other in (table, *self._hand[:index]):
                pybullet.setCollisionFilterPair(
                    body, other, -1, -1, 0, physicsClientId=self._client
                )

    def _box(self, size_m: Float[np.ndarray, "3"]) -> int:
        return int(
            pybullet.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=(size_m / 2).tolist(), physicsClientId=self._client
            )
        )

    def _hull(self, points_m: Float[np.ndarray, "num_points 3"]) -> int:
        return int(
            pybullet.createCollisionShape(
                pybullet.GEOM_MESH, vertices=points_m.tolist(), physicsClientId=self._client
            )
        )

    def _body(
        self, shape: int, mass_kg: float, T: Float[np.ndarray, "4 4"], friction: float
    ) -> int:
        position, orientation = _bullet_pose(T)
        body = int(
            pybullet.createMultiBody(
                baseMass=mass_kg,
                baseCollisionShapeIndex=shape,
                basePosition=position,
                baseOrientation=orientation,
                physicsClientId=self._client,
            )
        )
        pybullet.changeDynamics(
            body,
            -1,
            lateralFriction=friction,
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=self._client,
        )
        return body

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
        velocity[2] += self._config.gravity_m_s2 / self._config.rate_hz  # which the step takes away
        turning = turning_rad_s.tolist()
        for body in self._hand:
            pybullet.resetBasePositionAndOrientation(
                body, position, orientation, physicsClientId=self._client
            )
            pybullet.resetBaseVelocity(body, velocity, turning, physicsClientId=self._client)
        self._anchors.refresh()
        pybullet.stepSimulation(physicsClientId=self._client)
        p, (x, y, z, w) = pybullet.getBasePositionAndOrientation(
            self._object, physicsClientId=self._client
        )
        return np.array([*p, w, x, y, z])

    def __enter__(self) -> "PushWorld":
        """Use as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Give the client back."""
        give_client_back(self._client)


def _bullet_pose(T: Float[np.ndarray, "4 4"]) -> tuple[list[float], list[float]]:
    q, p = se3.split(T)
    w, x, y, z = np.asarray(q).tolist()
    return np.asarray(p).tolist(), [x, y, z, w]
