"""Effective friction of a pair of surfaces, measured alike in every engine: slide down an incline.

Engines combine the coefficients of two bodies differently. PyBullet multiplies them; MuJoCo takes
the larger one, or that of the geometry with the higher priority. What can be compared is what a
body does: on a slope of angle a it slides with g (sin a - mu cos a). The slope is made by tilting
gravity, so that contact is found on level surfaces in every engine.
"""

from collections.abc import Callable

import numpy as np

from twin.physics.config import PhysicsConfig
from twin.physics.engine import pybullet

SLOPE_RAD = np.deg2rad(45.0)
STEEPER_RAD = np.deg2rad(4.0)
"""The slope that is measured on is this much steeper than the one that would just hold: slow enough
that what an engine does to fast contact does not count."""
TURNS = 6
SLAB_M = (0.10, 0.10, 0.02)
"""Flat, so that it slides instead of tipping over."""
REST_S, LEAD_S, SLIDE_S = 0.3, 0.15, 0.2
"""At rest; sliding until contact has found its new load; sliding while it is measured."""


def effective_friction(acceleration: Callable[[float], float], gravity_m_s2: float = 9.81) -> float:
    """Friction of a pair from how fast a slab speeds up on a slope on which it hardly slides.

    Args:
        acceleration: Of a slab on a slope of an angle [rad], once contact is steady [m/s^2].
        gravity_m_s2: Downward acceleration.
    """
    slope, found = SLOPE_RAD, 0.0
    for _ in range(TURNS):
        found = np.tan(slope) - acceleration(slope) / (gravity_m_s2 * np.cos(slope))
        slope = np.arctan(found) + STEEPER_RAD
    return float(found)


def pybullet_friction(first: float, second: float, config: PhysicsConfig) -> float:
    """Effective friction of two surfaces in PyBullet, solved as in the replays.

    Args:
        first: Coefficient of the slab.
        second: Coefficient of what it lies on.
        config: Rate, iterations and gravity.
    """

    def acceleration(slope_rad: float) -> float:
        client = pybullet.connect(pybullet.DIRECT)
        try:
            return _slide(client, slope_rad, first, second, config)
        finally:
            pybullet.disconnect(physicsClientId=client)

    return effective_friction(acceleration, config.gravity_m_s2)


def _slide(
    client: int, slope_rad: float, first: float, second: float, config: PhysicsConfig
) -> float:
    g = config.gravity_m_s2
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / config.rate_hz,
        numSolverIterations=config.solver_iterations,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    x, y, z = (extent / 2 for extent in SLAB_M)
    bodies = []
    for mass, half, height, mu in (
        (0.0, [5.0, 5.0, 0.1], -0.1, second),
        (0.2, [x, y, z], z, first),
    ):
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client
        )
        body = pybullet.createMultiBody(mass, shape, -1, [0, 0, height], physicsClientId=client)
        pybullet.changeDynamics(
            body,
            -1,
            lateralFriction=mu,
            frictionAnchor=1,
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=client,
        )
        bodies.append(body)
    pybullet.setGravity(0, 0, -g, physicsClientId=client)
    for _ in range(round(REST_S * config.rate_hz)):
        pybullet.stepSimulation(physicsClientId=client)
    down = g * np.sin(slope_rad)
    pybullet.setGravity(down, 0, -g * np.cos(slope_rad), physicsClientId=client)
    speeds = []
    steps = round(SLIDE_S * config.rate_hz)
    for count in (round(LEAD_S * config.rate_hz), steps):
        for _ in range(count):
            pybullet.stepSimulation(physicsClientId=client)
        velocity, _ = pybullet.getBaseVelocity(bodies[1], physicsClientId=client)
        speeds.append(float(velocity[0]))
    return (speeds[1] - speeds[0]) * config.rate_hz / steps
