"""What can be found out about contact, and its prior before any data.

Everything is searched for in units of the prior: 0 is the nominal value, 1 is one standard
deviation of the prior away from it. A posterior width is then a share of the prior's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.physics.config import PhysicsConfig

FINGER_FRICTION = "finger_pair_friction"
SURFACE_FRICTION = "surface_pair_friction"
MASS_SCALE = "mass_scale"
GRIP_FORCE = "grip_force_N"
BIAS = ("bias_x_m", "bias_y_m", "bias_yaw_rad")
REACH = 3.0
"""Values further from the nominal one than this many standard deviations are not tried."""


@dataclass(frozen=True, kw_only=True)
class PhysicsParameter:
    """One number and its prior."""

    name: str
    unit: str
    about: str
    nominal: float
    sigma: float
    """Standard deviation of the prior: of the logarithm where ``positive``, else of the value."""
    positive: bool
    low: float
    """Values below are not tried."""
    high: float

    def value(self, x: float) -> float:
        """From units of the prior to the quantity."""
        if self.positive:
            return self.nominal * float(np.exp(self.sigma * x))
        return self.nominal + self.sigma * x

    def units(self, value: float) -> float:
        """From the quantity to units of the prior."""
        if self.positive:
            return float(np.log(value / self.nominal)) / self.sigma
        return (value - self.nominal) / self.sigma

    @property
    def bounds(self) -> tuple[float, float]:
        """Limits in units of the prior."""
        return max(self.units(self.low), -REACH), min(self.units(self.high), REACH)


def rigid_parameters(config: PhysicsConfig) -> tuple[PhysicsParameter, ...]:
    """Parameters of a cell with rigid objects; nominal values are those of a configuration.

    Engines combine the coefficients of two surfaces differently (PyBullet multiplies), so what is
    searched for is the effective coefficient of each pair.
    """
    finger = config.finger_friction * config.object_friction
    surface = config.surface_friction * config.object_friction
    rows = (
        (FINGER_FRICTION, "1", "friction between finger pads and objects", finger, 0.4, 0.1, 1.6),
        (SURFACE_FRICTION, "1", "friction between objects and table", surface, 0.4, 0.05, 1.6),
        (MASS_SCALE, "1", "masses of the objects, times what the task says", 1.0, 0.4, 0.2, 5.0),
        (GRIP_FORCE, "N", "largest force of each finger", config.grip_force_N, 0.4, 2.0, 80.0),
    )
    positive = tuple(
        PhysicsParameter(
            name=name,
            unit=unit,
            about=about,
            nominal=nominal,
            sigma=sigma,
            positive=True,
            low=low,
            high=high,
        )
        for name, unit, about, nominal, sigma, low, high in rows
    )
    shifts = zip(BIAS, ("m", "m", "rad"), (0.005, 0.005, 0.03), strict=True)
    return positive + tuple(
        PhysicsParameter(
            name=name,
            unit=unit,
            about="what has to be added to localised poses to be where the robot believes to be",
            nominal=0.0,
            sigma=sigma,
            positive=False,
            low=-3 * sigma,
            high=3 * sigma,
        )
        for name, unit, sigma in shifts
    )


def values_of(
    parameters: Sequence[PhysicsParameter], x: Float[np.ndarray, " num_parameters"]
) -> dict[str, float]:
    """Name the quantities of a point in units of the prior.

    Args:
        x: The point, 0 at the nominal value and 1 a standard deviation of the prior away.
    """
    return {item.name: item.value(float(u)) for item, u in zip(parameters, x, strict=True)}


def apply_values(values: Mapping[str, float], config: PhysicsConfig) -> PhysicsConfig:
    """Put found values into a configuration; the objects' own coefficient stays.

    Args:
        values: Any of the names above; biases and masses do not belong into a configuration.
        config: Where everything else comes from.
    """
    changes: dict[str, float] = {}
    if FINGER_FRICTION in values:
        changes["finger_friction"] = values[FINGER_FRICTION] / config.object_friction
    if SURFACE_FRICTION in values:
        changes["surface_friction"] = values[SURFACE_FRICTION] / config.object_friction
    if GRIP_FORCE in values:
        changes["grip_force_N"] = values[GRIP_FORCE]
    return replace(config, **changes)  # type: ignore[arg-type]  # floats into float fields only


def shifted(
    T_base_object: Float[np.ndarray, "4 4"], shift: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Move a pose by a ``BIAS``: along x and y [m], turned about its own vertical axis [rad].

    Args:
        T_base_object: The pose before; it is not changed.
        shift: Along base x and y [m], and the turn [rad].
    """
    T = T_base_object.copy()
    T[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, shift[2]])) @ T[:3, :3]
    T[:2, 3] += shift[:2]
    return T
