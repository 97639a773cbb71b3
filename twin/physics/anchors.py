"""Friction that holds where it held: PyBullet's friction anchors, with fresh contact normals.

Without anchors friction acts against velocities only, and what the solver leaves of them adds up to
a creep that takes hundreds of iterations to keep small. With an anchor a contact point stays where
it took hold while its force is within Coulomb's cone, and is let go when it is not. The engine then
keeps all of the point, also its normal in the world, which goes wrong when what is held turns. So a
body that has turned by a little takes hold anew. docs/decisions/0046-friction-anchors.md.
"""

from math import cos

from twin.physics.engine import pybullet

TURN_RAD = 0.03
"""A body that has turned by this much takes hold anew."""
EVERY_STEPS = 4
"""How often bodies are asked; the fastest joint turns by 0.05 rad meanwhile."""
_DYNAMIC, _ALL = 1, -1
"""PyBullet's collision group and mask of bodies that move."""


class FrictionAnchors:
    """The anchors of the rigid bodies that move freely in one PyBullet client."""

    def __init__(self, client: int) -> None:
        """Start without bodies.

        Args:
            client: PyBullet's number of the world.
        """
        self._client = client
        self._held: dict[int, tuple[float, ...]] = {}
        self._steps = 0

    def add(self, body: int) -> None:
        """Let a body's contacts hold from now on."""
        self._held[body] = self._orientation(body)
        pybullet.changeDynamics(body, -1, frictionAnchor=1, physicsClientId=self._client)

    def refresh(self) -> bool:
        """Let bodies that have turned take hold anew in the next step; whether any does.

        Call once per step.
        """
        self._steps += 1
        if self._steps % EVERY_STEPS:
            return False
        anew = False
        for body, (x0, y0, z0, w0) in self._held.items():
            x, y, z, w = now = self._orientation(body)
            if abs(x * x0 + y * y0 + z * z0 + w * w0) < cos(TURN_RAD / 2):
                self._held[body] = now
                # Setting the group that it has already is how PyBullet drops contact points.
                pybullet.setCollisionFilterGroupMask(
                    body, -1, _DYNAMIC, _ALL, physicsClientId=self._client
                )
                anew = True
        return anew

    def _orientation(self, body: int) -> tuple[float, ...]:
        _, q = pybullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
        return tuple(q)
