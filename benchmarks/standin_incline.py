"""The incline test in MuJoCo, with the contact settings of the stand-in cell.

On a slope of angle a a body slides with g (sin a - mu cos a), whatever an engine makes of the two
coefficients. The slope is made by tilting gravity, so that contact is found on level surfaces.
"""

from collections.abc import Callable

import mujoco
import numpy as np

from bridge.sources.standin.world import PAD_SOLIMP, PAD_SOLREF, STEP_S

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


def mujoco_friction(
    slab: float, ground: float, *, slab_priority: int = 0, pad: bool = False
) -> float:
    """Effective friction of a pair in MuJoCo.

    Args:
        slab_priority: Above 0, its coefficient alone counts, as that of the cell's objects.
    """

    def acceleration(slope_rad: float) -> float:
        model = _model(slab, ground, slab_priority, pad)
        data = mujoco.MjData(model)
        g = 9.81
        for _ in range(round(REST_S / STEP_S)):
            mujoco.mj_step(model, data)
        model.opt.gravity[:] = [g * np.sin(slope_rad), 0.0, -g * np.cos(slope_rad)]
        speeds = []
        for seconds in (LEAD_S, SLIDE_S):
            for _ in range(round(seconds / STEP_S)):
                mujoco.mj_step(model, data)
            speeds.append(float(data.qvel[0]))
        return (speeds[1] - speeds[0]) / SLIDE_S

    return effective_friction(acceleration)


def _model(slab: float, ground: float, priority: int, pad: bool) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.timestep = STEP_S
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    x, y, z = (extent / 2 for extent in SLAB_M)
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(
        type=box, size=[5, 5, 0.1], pos=[0, 0, -0.1], friction=[ground, 0.005, 0.0001]
    )
    body = spec.worldbody.add_body(name="slab", pos=[0, 0, z])
    hard = {"solref": PAD_SOLREF, "solimp": PAD_SOLIMP} if pad else {}
    body.add_geom(
        type=box,
        size=[x, y, z],
        mass=0.2,
        condim=4,
        priority=priority,
        friction=[slab, 0.005, 0.0001],
        **hard,
    )
    body.add_freejoint()
    return spec.compile()
