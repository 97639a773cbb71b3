"""How unsure we are of what a replay assumes; imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from bridge.errors import refuse_outside

FRICTIONS = ("object_friction", "finger_friction", "surface_friction")
"""Fields of ``PhysicsConfig`` that are frictions."""
GRIP_FORCE = "grip_force_N"
RIGID_MASSES = "masses of rigid objects"
"""Beside fields of ``PhysicsConfig`` among what a calibration found."""


@dataclass(frozen=True, kw_only=True)
class VariationConfig:
    """Priors that samples are drawn from; where calibration knows better, its spread counts.

    Factors are log-normal around the value the nominal replay uses: a spread of 0.2 means that two
    of three samples lie within 20 %.
    """

    pose_scale: float = 1.0
    """Times the standard deviations that localisation states for each object."""
    unknown_pose_m: float = 0.005
    """Standard deviation along x and y of an object whose localisation states none [m]."""
    unknown_pose_rad: float = 0.05
    """Standard deviation about the vertical of such an object [rad]."""
    friction_log: float = 0.2
    """Spread of the logarithm of each friction coefficient."""
    grip_force_log: float = 0.15
    """Spread of the logarithm of the grip force."""
    mass_log: float = 0.2
    """Spread of the logarithm of each movable object's mass."""
    young_log: float = 0.3
    """Spread of the logarithm of each soft object's Young's modulus."""
    grip_delay_s: float = 0.1
    """The gripper lags behind the arm by up to this long, evenly drawn [s]."""
    calibrated: Annotated[tuple[tuple[str, float], ...], Parameter(parse=False)] = ()
    """Fields of ``PhysicsConfig``, and the masses of rigid objects, with the spread of their
    logarithm that calibration found; they replace the priors above. No flag: read from the scene's
    calibration."""

    def __post_init__(self) -> None:
        """Refuse spreads that are none."""
        most = 2.0
        refuse_outside(
            self,
            {
                "pose_scale": (0, 100),
                "unknown_pose_m": (0, most),
                "unknown_pose_rad": (0, most),
                "friction_log": (0, most),
                "grip_force_log": (0, most),
                "mass_log": (0, most),
                "young_log": (0, most),
                "grip_delay_s": (0, most),
            },
        )

    def physics_spreads(self) -> dict[str, float]:
        """Spread of the logarithm per field of ``PhysicsConfig``, in a fixed order.

        What a calibration finds of fingers and surfaces is found together with the objects: their
        own coefficient is then not varied once more.
        """
        spreads = dict.fromkeys(FRICTIONS, self.friction_log) | {GRIP_FORCE: self.grip_force_log}
        known = dict(self.calibrated)
        if known.keys() & set(FRICTIONS[1:]):
            spreads[FRICTIONS[0]] = 0.0
        known.pop(RIGID_MASSES, None)
        return {**spreads, **{name: known[name] for name in sorted(known)}}

    def mass_spread(self, *, soft: bool) -> float:
        """Spread of the logarithm of an object's mass; calibration weighs rigid ones only."""
        return self.mass_log if soft else dict(self.calibrated).get(RIGID_MASSES, self.mass_log)
